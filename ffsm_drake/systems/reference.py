"""The planned motion, with exact rates and accelerations: a plan from a file, or a polynomial.

Position and joints follow q(t) = q_0 + (q_T - q_0) s(t/T). The base turns about the eigenaxis, the
fixed axis of the rotation from its first to its last attitude, by an angle with the same
blend; or, as in the paper, its roll, pitch and yaw follow it. Angular velocity and acceleration are
exact either way. With zero boundary rates and accelerations the blend is s(x) = 10 x^3 - 15 x^4 + 6
x^5 (Section 4 of the paper; peak speed 1.875 D/T, peak acceleration 5.7735 D/T^2); ``blend`` has
the others, and input shaping.

After the grasp of a moving target the motion begins at the velocity v_0 after the grasp, brought to
rest by g(x) = T x (1 - x)^3 (1 + 3 x): q(t) = q_0 + (q_T - q_0) s + v_0 g. The base's attitude
follows the same polynomial for a rotation vector from its first attitude, world frame; with zero
v_0 this is the eigenaxis turn.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import numpy as np

from ffsm_drake.common.registrations import SERVICES
from ffsm_drake.scenario import WHOLE, Grip, Posture, Scenario, planned_part
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant
from ffsm_drake.spacecraft.plant import files_read
from ffsm_drake.spacecraft.start import velocity_at_start
from ffsm_drake.systems.blend import Blend, make_impulses
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.duration import shortest_duration
from ffsm_drake.systems.frame_path import FRAME_SIZE, goal_frame, make_frame_path
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import UNIT, Signal, state_signals
from ffsm_drake.systems.plan import load_plan
from ffsm_drake.systems.planned_motion import InTurn, PathMotion, PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup

# Variables of the record.
SIGNALS = (
    *state_signals("desired_state", "desired_", "reference q_d", "reference v_d"),
    Signal(
        name="desired_acceleration", unit=f"{UNIT} per s^2", meaning="reference acceleration",
        dimension="coordinate", held=False,
    ),
)  # fmt: skip


def make_motion(scenario: Scenario, coordinates: Coordinates, grip: Grip = WHOLE) -> PlannedMotion:
    """Return the planned motion of a scenario, or of its phase with a grip.

    With a capture it starts at the velocity after the grasp of the nominal payload; without one,
    with the goal ``stop``, at ``initial_velocity``. Undriven
    coordinates follow by conservation of momentum. With an empty gripper it ends at the grasp.

    Raises:
      ModelError, ScenarioError: no grasp of the target, or no motion within the limits, can be
        computed, or the plan cannot be read.
    """
    for name, posture in scenario.postures.items():
        coordinates.check_names(posture.joints, key=f"{name}.joints")
    reference, period = scenario.reference, scenario.sample_time
    approach: PlannedMotion | None = None
    if scenario.grasp_time > 0.0:
        approach = SERVICES.load("planned_approach", "capture.approach")(scenario)
        if not grip.holds:
            return approach
    nominal = functools.cache(lambda: make_nominal_plant(scenario, grip))  # few motions need it
    target = None if reference.goal == "stop" else scenario.target_posture

    def polynomial(
        blend: Blend, posture: Posture | None, velocity: np.ndarray | None
    ) -> PolynomialMotion:
        return PolynomialMotion(
            coordinates=coordinates,
            start=scenario.initial_posture,
            target=posture,
            blend=blend,
            base_rotation=reference.base_rotation,
            sample_time=period,
            velocity=velocity,
        )

    velocity = velocity_at_start(scenario, nominal()) if scenario.starts_moving else None
    duration = reference.duration
    stop: PlannedMotion
    if reference.kind == "optimal":
        plan = load_plan(reference.plan or "", coordinates)
        stop = PathMotion(plan, coordinates=coordinates, sample_time=period)
    else:
        if duration is None:
            duration = shortest_duration(
                scenario,
                lambda duration: _follow(
                    scenario, nominal, polynomial(Blend(reference, duration), target, velocity)
                ),
                shaped_by=make_impulses(reference.shaper).length,
            )
        stop = polynomial(Blend(reference, duration), target, velocity)
    stop = _follow(scenario, nominal, stop)
    if approach is None:
        return stop
    grasp, end = approach.end, approach.end + stop.end
    return InTurn([(0.0, approach), (grasp, stop)], begin=grasp, end=end, sample_time=period)


def _follow(
    scenario: Scenario, make_nominal: Callable[[], PlantModel], motion: PlannedMotion
) -> PlannedMotion:
    """Return a motion along a prescribed frame path: joints follow the frame, undriven coordinates
    the conservation of momentum. A closed chain's follow its target.
    """
    if len(scenario.contacts) > 1:
        chain: PlannedMotion = SERVICES.load("closed_chain_motion", "contacts")(
            motion, scenario, make_nominal()
        )
        return chain
    if scenario.reference.frame is None and not scenario.undriven:
        return motion
    plain, nominal = Scenario(), make_nominal()
    part = dataclasses.replace(
        planned_part(scenario),
        duration=plain.duration,
        sample_time=plain.sample_time,
        divergence_speed=plain.divergence_speed,
        clearance=plain.clearance,
        planning=plain.planning,
    )
    # All inputs of the quantities derived from the motion.
    content, period = (part, files_read(scenario), motion.end), scenario.sample_time
    if scenario.reference.frame is None:
        follow = SERVICES.load("free_motion", "actuation.driven")
        followed: PlannedMotion = follow(motion, model=nominal, sample_time=period, content=content)
        return followed
    resolved: PlannedMotion = SERVICES.load("resolved_motion", "reference.frame")(
        motion,
        path=make_frame_path(scenario, nominal, duration=motion.end),
        goal=scenario.reference.frame,
        frame=goal_frame(scenario, nominal.plant),
        model=nominal,
        sample_time=period,
        content=content,
    )
    return resolved


def timed(scenario: Scenario, grip: Grip = WHOLE) -> Scenario:
    """Return the scenario with a duration of ``auto`` replaced by seconds; errors as
    ``make_motion``.
    """
    if scenario.reference.duration is not None:
        return scenario
    motion = make_motion(scenario, make_nominal_plant(scenario).coordinates, grip)
    duration = motion.end - motion.begin
    # whole samples: restores the exact number after a difference
    if scenario.reference.kind != "optimal":
        duration = round(duration / scenario.sample_time) * scenario.sample_time
    reference = dataclasses.replace(scenario.reference, duration=duration)
    return dataclasses.replace(scenario, reference=reference)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedReference(Part):
    """The section ``reference``."""

    def build(self, setup: BlockSetup) -> "AlongMotion":
        """Return the block of the planned motion."""
        planned = make_motion(setup.scenario, setup.coordinates, setup.grip)
        frame = make_frame_motion(setup.scenario, setup.nominal, planned)
        return AlongMotion(motion=planned, frame=frame)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlongMotion(Continuous):
    """The reference of a motion, a function of time only, and of a frame whose pose is prescribed.

    Outputs: ``desired_state`` [q_d; v_d] (nq + nv); ``desired_acceleration``, the time derivative
    of v_d (nv); ``desired_frame``, rows of ``make_frame_path`` (19), with a frame.
    """

    motion: PlannedMotion
    frame: PlannedMotion | None = None

    def __post_init__(self) -> None:
        self.motion.row(0.0)  # raises its errors before a run

    @property
    def inputs(self) -> Mapping[str, int]:
        """See Continuous."""
        return {"time": 1}

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Continuous."""
        nv = len(self.motion.coordinates.names)
        sizes = {"desired_state": 2 * nv + 1, "desired_acceleration": nv}
        return sizes if self.frame is None else {**sizes, "desired_frame": FRAME_SIZE}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """See Continuous."""
        time = inputs["time"].item()
        desired, acceleration = np.split(self.motion.row(time), [self.outputs["desired_state"]])
        found = {"desired_state": desired, "desired_acceleration": acceleration}
        return found if self.frame is None else {**found, "desired_frame": self.frame.row(time)}, {}


def make_frame_motion(
    scenario: Scenario, nominal: PlantModel, planned: PlannedMotion
) -> PlannedMotion | None:
    """Return the path of the frame whose pose is prescribed along a planned motion, if one is."""
    if not prescribes_frame(scenario):
        return None
    path = make_frame_path(scenario, nominal, duration=planned.end - planned.begin)
    return PathMotion(path, coordinates=planned.coordinates, sample_time=scenario.sample_time)


def prescribes_frame(scenario: Scenario) -> bool:
    """Whether a scenario prescribes the path of a frame."""
    return scenario.reference.frame is not None and scenario.reference.frame.task != "none"
