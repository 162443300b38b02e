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
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission, planned
from ffsm_drake.scenario import WHOLE, Grip, Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.blend import Blend, make_impulses
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.duration import shortest_duration
from ffsm_drake.systems.frame_path import FRAME_SIZE, goal_frame
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import UNIT, Signal, state_signals
from ffsm_drake.systems.plan import load_plan
from ffsm_drake.systems.planned_motion import InTurn, PathMotion, PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.setup import BlockSetup
from ffsm_drake.systems.start import velocity_at_start

# Variables of the record.
REFERENCE_SIGNALS = (
    *state_signals("desired_state", "desired_", "reference q_d", "reference v_d"),
    Signal(
        name="desired_acceleration", unit=f"{UNIT} per s^2", meaning="reference acceleration",
        dimension="coordinate", held=False,
    ),
)  # fmt: skip


class Follower(Protocol):
    """Returns a motion whose other coordinates follow the given one, with a nominal model.

    Raises ScenarioError: no motion follows it.
    """

    def __call__(
        self, motion: PlannedMotion, mission: Mission, model: PlantModel
    ) -> PlannedMotion: ...


# By the key that prescribes what is followed.
FOLLOWERS = Registry[Follower]("followers")


def make_motion(mission: Mission, grip: Grip = WHOLE) -> PlannedMotion:
    """Return the planned motion of a mission, or of its phase with a grip.

    With a capture it starts at the velocity after the grasp of the nominal payload; without one,
    with the goal ``stop``, at ``initial_velocity``. Undriven
    coordinates follow by conservation of momentum. With an empty gripper it ends at the grasp.

    Raises:
      ModelError, ScenarioError: no grasp of the target, or no motion within the limits, can be
        computed, or the plan cannot be read.
    """
    return _motion_of(mission, grip)


@planned
def _motion_of(mission: Mission, grip: Grip) -> PlannedMotion:
    scenario = mission.scenario
    for name, posture in scenario.postures.items():
        mission.craft.coordinates.check_names(posture.joints, key=f"{name}.joints")
    if scenario.grasp_time == 0.0:
        return _from_start(mission, grip)
    approach = GRASPINGS.only("capture.approach").approach(mission)
    if not grip.holds:
        return approach
    stop = _from_start(mission, grip)
    return InTurn(
        [(0.0, approach), (approach.end, stop)],
        begin=approach.end,
        end=approach.end + stop.end,
        sample_time=scenario.sample_time,
    )


def _from_start(mission: Mission, grip: Grip) -> PlannedMotion:
    """Return the motion from the start of a mission, or from its grasp on."""
    scenario, nominal = mission.scenario, mission.craft.nominal(grip)
    reference, coordinates = scenario.reference, mission.craft.coordinates
    if reference.kind == "optimal":
        plan = load_plan(reference.plan or "", coordinates)
        path = PathMotion(plan, coordinates=coordinates, sample_time=scenario.sample_time)
        return followed(mission, nominal, path)
    velocity = velocity_at_start(mission, nominal) if scenario.starts_moving else None

    @functools.cache
    def motion_in(duration: float) -> PlannedMotion:
        polynomial = PolynomialMotion(
            coordinates=coordinates,
            start=scenario.initial_posture,
            target=None if reference.goal == "stop" else scenario.target_posture,
            blend=Blend(reference, duration),
            base_rotation=reference.base_rotation,
            sample_time=scenario.sample_time,
            velocity=velocity,
        )
        return followed(mission, nominal, polynomial)

    duration = reference.duration
    if duration is None:
        shaped_by = make_impulses(reference.shaper).length
        duration = shortest_duration(mission, motion_in, shaped_by=shaped_by)
    return motion_in(duration)


def followed(mission: Mission, nominal: PlantModel, motion: PlannedMotion) -> PlannedMotion:
    """Return a motion along a prescribed frame path: joints follow the frame, undriven coordinates
    the conservation of momentum. Those of a closed chain follow its target or frame.
    """
    scenario, keys = mission.scenario, list[str]()
    leads = scenario.reference.frame is not None and scenario.reference.kind != "optimal"
    if len(scenario.contacts) > 1:
        keys.append("contacts")
    elif leads:
        keys.append("reference.frame")
    if scenario.undriven and not leads:
        keys.append("actuation.driven")
    for key in keys:
        motion = FOLLOWERS.load(key, key)(motion, mission, nominal)
    return motion


def timed(mission: Mission, grip: Grip = WHOLE) -> Mission:
    """Return the mission with a duration of ``auto`` replaced by seconds; errors as
    ``make_motion``.
    """
    scenario = mission.scenario
    if scenario.reference.duration is not None:
        return mission
    motion = make_motion(mission, grip)
    duration = motion.end - motion.begin
    # whole samples: restores the exact number after a difference
    if scenario.reference.kind != "optimal":
        duration = round(duration / scenario.sample_time) * scenario.sample_time
    reference = dataclasses.replace(scenario.reference, duration=duration)
    return mission.flown_by(reference=reference)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedReference(Part):
    """The section ``reference``."""

    def build(self, setup: BlockSetup) -> "AlongMotion":
        """Return the block of the planned motion."""
        motion = make_motion(setup.mission, setup.grip)
        frame = make_frame_motion(setup.mission, setup.nominal, motion)
        return AlongMotion(motion=motion, frame=frame)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlongMotion(Continuous):
    """The reference of a motion, a function of time only, and of a frame whose pose is prescribed.

    Outputs: ``desired_state`` [q_d; v_d] (nq + nv); ``desired_acceleration``, the time derivative
    of v_d (nv); ``desired_frame``, a row of ``FrameMotion`` (19), with a frame.
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
    mission: Mission, nominal: PlantModel, motion: PlannedMotion
) -> "FrameMotion | None":
    """Return the motion of the frame whose pose is prescribed, along a planned motion; None: no
    pose is.
    """
    return FrameMotion(motion, mission, nominal) if prescribes_frame(mission.scenario) else None


class FrameMotion(PlannedMotion):
    """The desired motion of a frame: along its path, and without a path as the coordinates move it.

    Rows: see ``PlantModel.calc_frame_motion``.
    """

    def __init__(self, motion: PlannedMotion, mission: Mission, nominal: PlantModel) -> None:
        self._motion, self._nominal = motion, nominal
        self._frame = goal_frame(mission.scenario, nominal.plant)
        period = mission.scenario.sample_time
        super().__init__(coordinates=motion.coordinates, sample_time=period, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """Rows (n, 19) at times (n,)."""
        return self._motion.frame_rows(times, self.moved)

    def moved(self, rows: np.ndarray) -> np.ndarray:
        """Rows (n, 19) of the frame as the rows (n, nq + 2 nv) of a motion move it."""
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        q, v, a = np.split(rows, [nq, nq + nv], axis=-1)
        return self._nominal.calc_frame_motion(q, v, a, self._frame)


def prescribes_frame(scenario: Scenario) -> bool:
    """Whether a scenario prescribes the path of a frame."""
    return scenario.reference.frame is not None and scenario.reference.frame.task != "none"
