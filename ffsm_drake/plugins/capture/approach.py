"""Where the approach to a tumbling target begins (``capture.approach.start``)."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable

import numpy as np

from ffsm_drake.common.errors import LimitError, ScenarioError
from ffsm_drake.common.steps import step
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.capture.contact import planned_contact, target_path
from ffsm_drake.plugins.capture.floating import Backwards, floated
from ffsm_drake.plugins.capture.phases.own import phases_before, with_phases
from ffsm_drake.plugins.capture.postures import posture_of
from ffsm_drake.runs.exceeded_limits import not_measured
from ffsm_drake.scenario import EMPTY, Posture
from ffsm_drake.scenario.capture import Approach
from ffsm_drake.spacecraft.clearance import shapes_of
from ffsm_drake.spacecraft.grasp import Contact
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.mission_limits import DIRECTIONS, actuation_limit
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion

_LENGTHS = (0.3, 0.6, 1.0)  # m; from the base at the grasp
_INSTANTS, _CLOSER = 40, 200
_SPREAD = 0.618034  # multiples of it modulo one are far apart
_GROWTH, _LONGEST = 1.15, 300.0  # growth factor of a tried duration; longest, s
# Largest shares of the limits of force; the first candidate below the small one and wide of the
# target is taken.
_MOST, _LITTLE, _WIDE = 0.5, 0.2, 0.05  # the last in m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Margins:
    """Margins of a planned approach to a free target."""

    distance: float  # m; smallest distance of parts
    share: float  # largest share of the limits of force, with an empty gripper
    nearest: str = ""  # the parts at this distance, as text


def approach_posture(mission: Mission) -> Posture:
    """Where the approach of a mission begins.

    Raises LimitError: ``capture.approach.start`` is "clear", and no place tried is.
    """
    return given_approach(mission).posture


def given_approach(mission: Mission) -> Approach:
    """The approach of a mission with its start given; errors as ``approach_posture``."""
    approach = mission.scenario.approach
    assert approach is not None
    if approach.start == "given":
        return approach
    return dataclasses.replace(approach, posture=_clear_start(mission), start="given")


@planned
@step("searching for a start without contact")
def _clear_start(mission: Mission) -> Posture:
    scenario, approach = mission.scenario, mission.scenario.approach
    assert approach is not None
    model = mission.craft.nominal()
    contact = planned_contact(mission, model)
    X_WP, path = target_path(scenario, model, contact)
    end = np.array(scenario.initial_posture.base_position)
    for line in not_measured(scenario):
        raise LimitError("capture.approach.start", line, limit="clearance")
    best, kept, least, told = -np.inf, approach.posture, np.inf, ""
    needed = scenario.clearance + approach.margin
    wide, share_of = max(_WIDE, needed), shares_of(mission)
    away, within = outwards(end - X_WP.translation()), f" within {_LENGTHS[-1]:g} m"
    places = [end + length * each for each in away for length in _LENGTHS]
    if scenario.undriven:  # momentum places the base
        places, within = [end], " with the joints of posture or of the grasp"
    for joints, place in itertools.product((kept.joints, scenario.initial_posture.joints), places):
        posture = dataclasses.replace(kept, base_position=place.tolist(), joints=joints)
        motion = approach_motion(mission, model, contact, posture)
        # one that is nearer at any instant is neither the best nor returned
        margins = functools.partial(
            margins_of, mission, motion, path[:, :7], most=_MOST, share_of=share_of,
            enough=min(best, math.nextafter(wide, -math.inf)),
        )  # fmt: skip
        found = margins(instants=_INSTANTS)
        if found.distance > best:  # worth a closer look
            found = margins(instants=_CLOSER)
        least = min(least, found.share)
        if found.distance > best:
            best, widest, told = found.distance, posture, f"the best one has {found.nearest}"
        if found.distance >= wide and found.share <= _LITTLE:
            return posture
    if best < needed:
        told = told or f"each needs {100.0 * least:.0f} % or more"
        raise LimitError(
            "capture.approach.start",
            f"no start{within} keeps {needed:g} m from the target with "
            f"{100.0 * _MOST:g} % of the force limits: {told}; change capture.approach.duration "
            "or margin",
            limit="clearance",
        )
    return widest


def outwards(away: np.ndarray) -> np.ndarray:
    """Directions (26, 3) to the faces, edges and corners of a cube, those along ``away`` first."""
    first: np.ndarray = DIRECTIONS[np.argsort(-(DIRECTIONS @ away), kind="stable")]
    return first


def approach_motion(
    mission: Mission, model: PlantModel, contact: Contact, posture: Posture
) -> PlannedMotion:
    """The way from the grasp back to a posture, as a function of the time before the grasp.

    Undriven coordinates keep the momentum that the servicer has at the grasp.
    """
    scenario = mission.scenario
    duration = scenario.approach.duration if scenario.approach else 0.0
    start = scenario.initial_posture
    if len(scenario.contacts) > 1:  # with all hands at their places
        start = posture_of(contact.q, model.coordinates)
    motion = PolynomialMotion(
        coordinates=model.coordinates,
        start=start,
        target=posture,
        blend=Blend(scenario.reference, duration, backwards=True),
        base_rotation=scenario.reference.base_rotation,
        sample_time=scenario.sample_time,
        velocity=-contact.velocity,
    )
    return floated(motion, mission)


@planned
def planned_approach(mission: Mission) -> PlannedMotion:
    """The motion of a mission up to the grasp; errors as ``approach_posture``, ``with_phases``."""
    scenario, model = mission.scenario, mission.craft.nominal()
    capture = scenario.capture
    if scenario.undriven and capture is not None and capture.retreat is not None:
        problem = (
            "moves the base, on which no force acts; remove it, or set actuation.driven: [all]"
        )
        raise ScenarioError("capture.retreat", problem)
    phases_before(mission)  # before a search for a start, which takes longer
    contact, posture = planned_contact(mission, model), approach_posture(mission)
    motion = approach_motion(mission, model, contact, posture)
    approach = Backwards(motion, sample_time=scenario.sample_time)
    return with_phases(mission, approach) if scenario.blocks.phases else approach


def margins_of(
    mission: Mission,
    backwards: PlannedMotion,
    target: np.ndarray,
    *,
    instants: int,
    most: float = np.inf,
    enough: float = -np.inf,
    share_of: Callable[[np.ndarray], float] | None = None,
) -> Margins:
    """Margins of an approach, given backwards from the grasp, with the target at poses (n, 7) at
    the n control samples before it. Beyond ``most`` of the limits no distance is measured, and none
    after one that is as small as ``enough`` (m). ``share_of``: see ``shares_of``; default: made.
    """
    scenario = mission.scenario
    samples = np.unique(np.linspace(0, len(target) - 1, instants).round().astype(int))
    rows = backwards.rows(scenario.sample_time * (len(target) - samples))
    share = (share_of or shares_of(mission))(rows)
    if share > most:
        return Margins(distance=-np.inf, share=share)
    shapes = shapes_of(scenario, apart=True)
    q = rows[:, : len(backwards.coordinates.position_names)]
    if not shapes.pairs:
        return Margins(distance=np.inf, share=share)
    spread = np.argsort(np.modf(_SPREAD * np.arange(len(samples)))[0])  # soon near any instant
    nearest = shapes.along(np.hstack([q, target[samples]])[spread], enough=enough).nearest
    return Margins(distance=nearest.distance, share=share, nearest=str(nearest))


def shares_of(mission: Mission) -> Callable[[np.ndarray], float]:
    """A function that gives the largest share of the limits of force that a motion [q_d; v_d;
    dv_d/dt] (n, nq + 2 nv) takes with an empty gripper; the same in either direction but for
    damping.
    """
    model = mission.craft.nominal(EMPTY)
    limit = actuation_limit(mission.scenario, model.coordinates).upper
    return functools.partial(force_share, model, limit=limit)


def force_share(model: PlantModel, rows: np.ndarray, limit: np.ndarray) -> float:
    """The largest share of limits (nv) of force that a motion [q_d; v_d; dv_d/dt] (n, nq + 2 nv)
    takes.
    """
    nq = len(model.coordinates.position_names)
    force = model.calc_tracking_force(*np.split(rows, [nq, nq + limit.size], axis=1))
    return float((np.abs(force) / limit).max())


def gentle_duration(
    mission: Mission, motion_in: Callable[[float], PlannedMotion], shortest: float
) -> float:
    """The first of a shortest duration (s), 1.15 times, 1.15^2 times as long, and so on, in whole
    samples, whose motion takes at most half of the limits of force with an empty gripper; else the
    longest tried.
    """
    period = mission.scenario.sample_time
    while True:
        samples = math.ceil(shortest / period - 1e-9)
        duration = samples * period
        if duration > _LONGEST or is_gentle(mission, motion_in(duration)):
            return duration
        shortest *= _GROWTH


def is_gentle(mission: Mission, motion: PlannedMotion) -> bool:
    """Whether a motion takes at most half of the limits of force with an empty gripper."""
    return shares_of(mission)(motion.rows(np.linspace(0.0, motion.end, _INSTANTS))) <= _MOST
