"""The reference of an approach to a target that is measured (``capture.measured``).

A camera or lidar measures poses of the target, and a filter (``target_filter``) estimates its
motion. The planned approach is moved as one rigid body, with rotation vector c_r and translation
c_p, to the estimated pose of the target at the grasp. At each new plan, a polynomial of fifth order
brings c, c' and c'' from their present values to the new ones. At the last plan, three standard
deviations of the pose are compared with the envelope of the gripper.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.common.so3 import matrix_of, quaternion_of, turn_between
from ffsm_drake.plugins.capture.displacement import displaced, displacement, quintic
from ffsm_drake.plugins.capture.floating_approach import FloatingApproach
from ffsm_drake.plugins.capture.free_body import SIZE, Target
from ffsm_drake.plugins.capture.target_filter import Estimate, Path, TargetFilter, observed
from ffsm_drake.scenario import Capture, Scenario
from ffsm_drake.scenario.target_sensing import Measured, TargetTracker
from ffsm_drake.spacecraft.orbit import Orbit
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import STEPS, Signal, View
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import FrameMotion, make_frame_motion, make_motion
from ffsm_drake.systems.sampled import Arrays, Now, Sampled
from ffsm_drake.systems.setup import BlockSetup

_SHOWN = 12  # groups of the estimate's errors: rotation, rate, position, velocity
_NAMES = tuple(
    f"{name}_{axis}" for name in ("rotation", "rate", "position", "velocity") for axis in "xyz"
)
_UNITS = [unit for unit in ("rad", "rad/s", "m", "m/s") for _ in "xyz"]
_SIGMAS = 3.0
# Largest changes of the target by the gripper's touch: rad, rad/s, m, m/s.
_TOUCH = np.repeat([0.1, 0.1, 0.1, 0.1, 0.0, 0.0], [3, 3, 3, 3, 3, 5])
_ROW = 21  # columns of ``Target.as_row``
_SIZES = {
    "target_estimate": 13,
    "target_error": _SHOWN,
    "target_deviation": _SHOWN,
    "target_nees": 1,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Approached:
    """Goal of the approach in a phase."""

    begin: float  # s; of the approach, from which on it follows the estimate
    contact: float  # s; when the gripper closes
    meets: float  # s; of the grasp
    motion: np.ndarray  # (13) of the target then, as planned


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TrackedTarget(Part):
    """The reference that follows a target's estimate."""

    title = "Target estimate"
    section = "Target estimate"
    about = "Errors of the estimated target at the time of the last image, and 3 deviations."

    scenario: Scenario  # of the run
    grasp: Capture  # settings in it
    measured: Measured
    path: np.ndarray  # (n, 13) motion of the true target at the control samples
    expected: Target  # at the start
    motion: PlannedMotion | None  # what is displaced; None: the scenario's own motion
    approached: Approached | None  # goal of the displacement; None: nothing is displaced
    sees: bool  # whether there are images

    def build(self, setup: BlockSetup) -> Any:
        """The block, whose Drake system is made around it."""
        own = self.motion or make_motion(setup.mission, setup.grip)
        frame = make_frame_motion(setup.mission, setup.nominal, own)
        floating = None
        if setup.scenario.undriven:
            floating = FloatingApproach(mission=setup.mission, motion=own)
        return TrackedReference(part=self, motion=own, frame=frame, floating=floating)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """The estimate at the last image, its errors and their deviations."""
        panels = dict(zip(_NAMES, _UNITS, strict=True))
        return (
            Signal(
                name="target_estimate",
                unit="1, m, rad/s, m/s",
                meaning="[quaternion, p_WP; w_WP, v_WP] of the target at the last image, estimated",
                components=("qw", "qx", "qy", "qz", *(f"{n}_{a}" for n in "pwv" for a in "xyz")),
                heading="",
            ),
            Signal(
                name="target_error",
                unit="rad, rad/s, m, m/s",
                meaning="true minus estimated: rotation and rate in the axes of the target",
                components=_NAMES,
                dimension="target_component",
                panels=panels,
                heading="Errors of the estimated target and 3 standard deviations",
                chart=STEPS,
            ),
            Signal(
                name="target_deviation",
                unit="rad, rad/s, m, m/s",
                meaning="standard deviations of target_error, by the filter",
                components=_NAMES,
                dimension="target_component",
                heading="",
            ),
            Signal(
                name="target_nees",
                unit="1",
                meaning=f"squared error of all {SIZE} estimated numbers in their covariance",
                panel="NEES",
                heading="NEES of the target's estimate",
                chart=STEPS,
            ),
        )

    def metrics(self) -> Sequence[Metric]:
        """Consistency of the estimate, and its last errors."""
        return (
            Metric(
                key="target.nees",
                unit="1",
                label="Mean NEES of the target's estimate",
                of=_mean_nees,
            ),
            Metric(
                key="target.position_error",
                unit="m",
                label="Error of the target's estimated position at the last image",
                of=lambda run: float(np.linalg.norm(run["target_error"][-1, 6:9])),
            ),
            Metric(
                key="target.rotation_error",
                unit="rad",
                label="Error of the target's estimated attitude at the last image",
                of=lambda run: float(np.linalg.norm(run["target_error"][-1, :3])),
            ),
        )


def _mean_nees(run: View) -> float:
    """Over the images with an estimate."""
    found = np.asarray(run["target_nees"]).ravel()
    at_images = found[np.flatnonzero(np.diff(found, prepend=0.0))]
    return float(at_images.mean()) if at_images.size else float("nan")


def drawn_path(
    scenario: Scenario, settings: TargetTracker, motion: np.ndarray
) -> tuple[np.ndarray, Target]:
    """The true motion (13) at the start of a target that is expected in another, drawn from the
    scenario's seed; and the target as it is expected, with nominal mass properties.
    """
    random = np.random.default_rng([scenario.random_seed, 1])
    truth = Target.from_motion(motion, scenario.payload.truth)
    nominal = Target.from_motion(motion, scenario.payload.nominal)
    expected = dataclasses.replace(nominal, velocity=truth.velocity)
    true = dataclasses.replace(
        truth,
        rate=truth.rate + settings.rate_deviation * random.normal(size=3),
        velocity=truth.velocity + settings.velocity_deviation * random.normal(size=3),
    )
    return true.motion, expected


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackedReference(Sampled):
    """The block, which has no inputs. Outputs: those of a reference, the part's signals, and
    ``abort_request``. They depend only on the time and the memory before a sample.
    """

    traced: ClassVar = False
    part: TrackedTarget
    motion: PlannedMotion  # which is displaced
    frame: FrameMotion | None  # whose pose is prescribed
    floating: FloatingApproach | None  # of a base that is not driven

    @functools.cached_property
    def _filter(self) -> TargetFilter:
        environment = self.part.scenario.environment
        orbit = None if environment is None else Orbit.of(environment)
        return TargetFilter(self.part.measured.filter, self.part.expected, orbit)

    @property
    def _period(self) -> float:
        return self.part.scenario.sample_time

    @property
    def outputs(self) -> Mapping[str, int]:
        """See Sampled."""
        nq, nv = len(self.motion.coordinates.position_names), len(self.motion.coordinates.names)
        own = {"desired_state": nq + nv, "desired_acceleration": nv}
        own |= {} if self.frame is None else {"desired_frame": FRAME_SIZE}
        return {**own, **_SIZES, "abort_request": 1}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """See Sampled."""
        return {
            # time, whether there is one, poses that fitted, target, covariance
            "estimate": np.zeros(3 + _ROW + SIZE * SIZE),
            # begin and end, s, whether it is the last, coefficients of the displacement
            "plan": np.zeros(3 + 36 if self.floating is None else self.floating.size),
            "shown": np.zeros(sum(_SIZES.values())),
            "abort": np.zeros(1),
        }

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        row, nx = self.motion.row(now.time), self.outputs["desired_state"]
        of_frame = None if self.frame is None else self.frame.row(now.time)
        if self.part.approached is not None and memory["plan"][1]:
            if self.floating is None:
                c = _displacement(memory["plan"], now.time)
                row = displaced(row, c, nx - self.outputs["desired_acceleration"])
            else:
                row = self.floating.row(memory["plan"], now.time)
            of_frame = None if self.frame is None else self.frame.moved(row)
        outputs = {"desired_state": row[:nx], "desired_acceleration": row[nx:]}
        outputs |= {} if of_frame is None else {"desired_frame": of_frame}
        shown = np.split(memory["shown"], np.cumsum([*_SIZES.values()])[:-1])
        outputs |= dict(zip(_SIZES, shown, strict=True))
        return outputs | {"abort_request": memory["abort"]}, {**memory, **self._seen(memory, now)}

    def _seen(self, memory: Arrays, now: Now) -> dict[str, np.ndarray]:
        """The memory that changes with an image at a sample."""
        sample, sensor = round(now.time / self._period), self.part.measured.sensor
        image, approached = sample - sensor.latency, self.part.approached
        if not self.part.sees or image < 0 or image % sensor.period:
            return {}
        found = self._looked(_estimate(memory), image)
        if found is None:
            late = approached is not None and self._is_last(now.time, approached)
            return {"abort": np.array([float(late)])}
        after = {"estimate": _as_row(found), "shown": self._compared(found, image)}
        if approached is not None:
            after |= self._follow(memory["plan"], now.time, found, approached)
        return after

    def known_path(self, memory: Arrays, first: int, samples: int) -> Path:
        """Return the estimated motion of the target from a control sample."""
        time = first * self._period
        return self._filter.path(_estimate(memory), time, self._period, samples)

    def renewed(self, memory: Arrays, time: float, *, touched: bool) -> dict[str, np.ndarray]:
        """Return a memory at a time (s) without the displacement; and, if the gripper touched the
        target, without its certain motion.
        """
        fresh = self.start()
        after = {**memory, "plan": fresh["plan"], "abort": fresh["abort"]}
        found = _estimate(memory)
        if touched and found is not None:
            found = self._filter.predicted(found, time)
            covariance = found.covariance + np.diag(_TOUCH**2)
            after["estimate"] = _as_row(dataclasses.replace(found, covariance=covariance))
        return after

    def _looked(self, before: Estimate | None, image: int) -> Estimate | None:
        """The estimate at an image (control sample)."""
        random = np.random.default_rng([self.part.scenario.random_seed, 2, image])
        time = image * self._period
        place = self.motion.row(time)[4:7]
        pose, given = observed(self.part.measured.sensor, self._true(image), place, random)
        if before is None:
            return self._filter.first(time, pose) if given else None
        # if a phase ended between an image and its pose, the estimate is later than the image
        time = max(time, before.time)
        return self._filter.updated(self._filter.predicted(before, time), pose, given)

    def _true(self, sample: int) -> Target:
        return Target.from_motion(self.part.path[sample], self.part.scenario.payload.truth)

    def _compared(self, found: Estimate, image: int) -> np.ndarray:
        """Signals of an estimate."""
        error = found.target.error(self._true(image))
        nees = error @ np.linalg.solve(found.covariance, error)
        shown = found.target.motion, error[:_SHOWN], found.deviation[:_SHOWN], [nees]
        return np.concatenate(shown)

    def _follow(
        self, plan: np.ndarray, time: float, found: Estimate, approached: Approached
    ) -> dict[str, np.ndarray]:
        """The memory with a new plan of the displacement; empty if none is due."""
        is_last = self._is_last(time, approached)
        due = time >= plan[0] + self.part.measured.replan - 1e-9 or plan[1] <= plan[0]
        if time < approached.begin - 1e-9 or plan[2] or not (due or is_last):
            return {}
        after, meets = dict[str, np.ndarray](), approached.meets
        if is_last:
            found = self._filter.predicted(found, meets)
            target = found.target
        else:
            target = self._filter.moved(found.target, found.time, meets)
        if self.floating is None:
            goal, missed = self._goal(target.motion, approached), np.zeros(2)
            coefficients = quintic(_displacement(plan, time), goal, meets - time)
            row = np.concatenate([[time, meets, is_last], coefficients.ravel()])
        else:
            row, missed = self.floating.planned(plan, time, target.motion, approached.motion, meets)
            row[2] = is_last
        if is_last:
            envelope = self.part.grasp.envelope
            sizes = missed + _SIGMAS * np.array(found.pose_deviation)
            bounds = zip(sizes, (envelope.angle, envelope.position), strict=True)
            unsure = any(most is not None and size > most for size, most in bounds)
            after["abort"] = np.array([float(unsure)])
        return after | {"plan": row}

    def _is_last(self, time: float, approached: Approached) -> bool:
        """True if the plan at a time, s, is the last one."""
        return time >= approached.contact - self.part.measured.last - 1e-9

    def _goal(self, motion: np.ndarray, approached: Approached) -> np.ndarray:
        """[c; c'; c''] (3, 6) with which the arm meets a target in a motion (13)."""
        planned, v = approached.motion, len(self.motion.coordinates.position_names)
        q = self.motion.row(approached.meets - self._period)
        turn = matrix_of(planned[:4]) @ turn_between(planned[:4], motion[:4])
        R = matrix_of(quaternion_of(turn))
        arm, goal = R @ (q[4:7] - planned[4:7]), np.zeros((3, 6))
        goal[0] = np.concatenate([turn, motion[4:7] + arm - q[4:7]])
        if self.part.grasp.servicer.startswith("track"):
            dw = motion[7:10] - R @ planned[7:10]
            goal[1, :3] = dw - 0.5 * np.cross(turn, dw)
            goal[1, 3:] = motion[10:] - R @ planned[10:] + np.cross(dw, arm)
        goal[1, 3:] += (R - np.eye(3)) @ q[v + 3 : v + 6]
        return goal


def _displacement(plan: np.ndarray, time: float) -> np.ndarray:
    """[c; c'; c''] (3, 6) at a time, s; at the end of its polynomial it goes on evenly."""
    begin, end, _, *coefficients = plan
    if end <= begin:
        return np.zeros((3, 6))
    x, late = min(time, end) - begin, max(time - end, 0.0)
    return displacement(np.reshape(coefficients, (6, 6)), x, late)


def _estimate(memory: Arrays) -> Estimate | None:
    """The estimate of the target in a memory; None before the first pose."""
    row = memory["estimate"]
    if not row[1]:
        return None
    return Estimate(
        time=row[0],
        target=Target.from_row(row[3 : 3 + _ROW].copy()),
        covariance=row[3 + _ROW :].reshape(SIZE, SIZE).copy(),
        fitted=np.array(int(row[2])),
    )


def _as_row(found: Estimate) -> np.ndarray:
    """An estimate as a vector."""
    head = [found.time, 1.0, float(found.fitted)]
    return np.concatenate([head, found.target.as_row(), found.covariance.ravel()])
