"""The largest forces: of limits, URDFs and the base's actuators."""

import dataclasses
import itertools

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.joint_limits import joint_limits
from ffsm_drake.spacecraft.plant import coordinates_of
from ffsm_drake.systems.actuation import SECTIONS

# Axes, edges and corners of a cube.
_DIRECTIONS = np.array(
    [each for each in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(each)]
)
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1)[:, None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseLimits:
    """The largest torque (N m) and force (N) that a base's actuators give alone; infinite where
    they are ideal.
    """

    torque: float  # in any direction
    most_torque: float  # in the best
    force: float
    most_force: float
    named: str  # what gives it beside actuation.limit, in words


def base_limits(scenario: Scenario) -> BaseLimits:
    """What the actuators of a scenario give; ScenarioError as for ``make_actuation``."""
    torque = force = np.full(len(_DIRECTIONS), np.inf)
    names = []
    for of in SECTIONS.values() if scenario.blocks.actuation is None else ():
        part = of(scenario)
        most = None if part is None else part.most(scenario, _DIRECTIONS)
        if part is not None and most is not None:  # torque of what comes last is what counts
            torque, force = most.get("torque", torque), most.get("force", force)
            names.append(part.title.lower())
    return BaseLimits(
        torque=float(torque.min()),
        most_torque=float(torque.max()),
        force=float(force.min()),
        most_force=float(force.max()),
        named=f" or what {' and '.join(names)} give" if names else "",
    )


def force_limits(scenario: Scenario, plant: MultibodyPlant) -> np.ndarray:
    """The largest force of each coordinate (nv), N m or N, infinite where there is none.

    That of ``actuation.limit``, the URDFs' efforts, and what the base's actuators give in
    any direction.

    Raises ScenarioError, ModelError: the limit names an unknown coordinate, or a URDF cannot be
    read.
    """
    coordinates = coordinates_of(plant)
    force = coordinates.vector(
        scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
    )
    joints, base = (
        slice(len(coordinates.names) - len(coordinates.joints), None),
        base_limits(scenario),
    )
    force[joints] = np.minimum(force[joints], joint_limits(scenario.model, plant).effort)
    for group, largest in (("base_rotation", base.torque), ("base_position", base.force)):
        part = coordinates.groups[group]
        force[part] = np.minimum(force[part], largest)
    return force
