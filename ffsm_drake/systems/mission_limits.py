"""The limits of a scenario: of its URDFs, of ``actuation.limit``, and of its actuators."""

import dataclasses
import itertools
from collections.abc import Iterable

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import FORCE, Limit
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.registry import base_actuators, section_parts

# Axes, edges and corners of a cube.
DIRECTIONS = np.array([each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseLimits:
    """The largest torque (N m) and force (N) of a base's actuators, each alone, in directions to
    the faces, edges and corners of a cube; infinite where they are ideal.
    """

    torque: np.ndarray  # by direction (n)
    helped: np.ndarray  # torque including the temporary help of thrusters for wheels
    force: np.ndarray
    named: str  # the actuators, in words that follow actuation.limit


def base_limits(scenario: Scenario) -> BaseLimits:
    """Return the limits of a scenario's base actuators. Raises the errors of ``make_actuation``."""
    torque = helped = force = np.full(len(DIRECTIONS), np.inf)
    names = list[str]()
    for part in base_actuators(scenario).values():
        most = part.most(scenario, DIRECTIONS)
        # the torque of the last one counts, where it gives any itself
        own = most.get("torque", torque)
        own = np.where(np.isfinite(own), own, torque)
        helped = own + torque if part.is_helped and names else own
        torque, force = own, most.get("force", force)
        names.append(part.title.lower())
    envelope = ", ".join(filter(None, (_span(torque, "N m"), _span(force, "N"))))
    named = f" or what {' and '.join(names)} give (by direction {envelope})" if names else ""
    return BaseLimits(torque=torque, helped=helped, force=force, named=named)


def _span(most: np.ndarray, unit: str) -> str:
    """Return the envelope over all directions (n), in words; empty if there is none."""
    known = most[np.isfinite(most)]
    return f"{known.min():.3g} to {known.max():.3g} {unit}" if known.size else ""


def limits_of(
    mission: Mission, parts: Iterable[Part] | None = None, *, helped: bool = False
) -> list[Limit]:
    """Return the limits of a mission, one for each source; ``tightest`` joins the limits of a
    quantity.

    ``parts`` default to the scenario's own actuators; ``helped``: see ``actuation_limit``.

    Raises ScenarioError, ModelError: a limit names an unknown coordinate, or a URDF cannot be
    read.
    """
    force = actuation_limit(mission.scenario, mission.craft.coordinates, helped=helped)
    return [*joint_limits(mission, parts), force]


def joint_limits(mission: Mission, parts: Iterable[Part] | None = None) -> list[Limit]:
    """``limits_of`` without the actuators' limits of force: limits without enforcement; ``parts``
    default to those of all the scenario's own sections.
    """
    given = section_parts(mission.scenario).values() if parts is None else parts
    own = (limit for part in given for limit in part.limits(mission.craft.coordinates))
    return [*mission.craft.limits, *own]


def actuation_limit(scenario: Scenario, coordinates: Coordinates, *, helped: bool = False) -> Limit:
    """Return the largest forces within ``actuation.limit`` and the capability of the base's
    actuators in any direction; ``helped``: for a while, wheels with the thrusters' help. Raises the
    errors of ``limits_of``.
    """
    key, base = "actuation.limit", base_limits(scenario)
    force = coordinates.vector(scenario.actuation.limit or {}, key=key, default=np.inf)
    torque = base.helped if helped else base.torque
    force[:6] = np.minimum(force[:6], np.repeat([torque.min(), base.force.min()], 3))
    return Limit.of_coordinates(FORCE, key + base.named, coordinates, force)
