"""The task ``mobile_debris_capture`` of the Space Robotics Bench, by a controller without learning.

    python benchmarks/mobile_debris_capture.py --draws 500 --force 400

A draw is the initial state of the task (version 0.0.6, as its source has it). The servicer catches
the debris with its hand within the 60 s of the task: it moves along a polynomial that ends at the
debris with its velocity, under the proposed control law, within limits of force. The task has
rewards, and no success; success here: the hand closes around the debris, which moves little in it
(``capture.envelope``), limits and clearance are kept all along, and at the end base and debris are
at rest to each other, within the widths of the task's rewards (0.01 m/s, 0.03 rad/s). The inertial
frame is that which moves with the debris. Times are processor time.
"""

import argparse
import collections
import dataclasses
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.stats import beta

from ffsm_drake.common.so3 import matrix_of, quaternion_of, rotation_vector_motion, turned_by
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.capture.approach import Backwards, margins_of, shares_of
from ffsm_drake.plugins.design.limits_left import limits_left
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import EMPTY, Posture, Scenario, load_scenario
from ffsm_drake.scenario.capture import Approach
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import find_frame
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import AlongMotion, PlannedReference
from ffsm_drake.systems.setup import BlockSetup

HERE = Path(__file__).parent / "venus_express"
EPISODE, STOP = 60.0, 2.0  # s
TIMES = np.geomspace(4.0, EPISODE - STOP - 1.0, 24)  # s, of the grasp, tried in turn
HOME = np.array([0.0, 0.0, 0.0, -0.5, 0.0, 0.5, 0.25]) * np.pi  # the task's
READY = np.array([0.8, 0.95, 0.1, -2.1, -2.05, 1.35, -0.3])  # hand outwards, far from singular
TURN = 2.0  # s, in which the arm takes up the debris' rotation
SHARE, CLEARANCE = 0.8, 0.005  # of the limits of force; m
MASS, REACH = 1286.8, 2.5  # kg; m, from the base's centre to the debris, at most
LEVER = 0.7  # m; the largest torque of the base over its force
REST = (0.03, 0.01)  # rad/s, m/s; widths of the task's rewards for motion to each other


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Draw:
    """An initial state, in the task's world axes."""

    base: RigidTransform
    base_twist: np.ndarray  # [w; v]
    joints: np.ndarray
    debris: RigidTransform
    debris_twist: np.ndarray


def draw(rng: np.random.Generator) -> Draw:
    """An initial state of the task.

    Isaac Lab adds what it samples to the default state: the debris starts 5 m ahead of the range.
    """
    rate = np.deg2rad(10.0)

    def pose(low: list[float], high: list[float]) -> RigidTransform:
        rpy = rng.uniform(-np.pi, np.pi, 3)
        return RigidTransform(RollPitchYaw(rpy), rng.uniform(low, high))

    def twist(low: list[float], high: list[float]) -> np.ndarray:
        return np.concatenate([rng.uniform(-rate, rate, 3), rng.uniform(low, high)])

    return Draw(
        base=pose([-0.2] * 3, [0.2] * 3),
        base_twist=twist([-0.2] * 3, [0.2] * 3),
        joints=HOME + np.deg2rad(rng.uniform(-5.0, 5.0, 7)),
        debris=pose([7.0, -1.0, -1.0], [9.0, 1.0, 1.0]),
        debris_twist=twist([-2.0, -0.5, -0.5], [-0.5, 0.5, 0.5]),
    )


class Meeting(PlannedMotion):
    """From a moving start to a moving end: rotation vector of the base, position and joints by
    polynomials of the fifth degree; the joints' last velocity grows over the last ``TURN``.
    """

    def __init__(
        self, ends: list[np.ndarray], quaternion: np.ndarray, model: PlantModel, **how: Any
    ):
        """Args: value, rate at the start and at the end (nv each); first attitude of the base."""
        self._ends, self._first = ends, quaternion
        super().__init__(coordinates=model.coordinates, **how)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        start, v_start, goal, v_end = self._ends
        length = np.where(np.arange(start.size) < 6, self.end, min(TURN, self.end))
        x = np.clip(times / self.end, 0.0, 1.0)[:, None]
        y = np.clip(1.0 - (self.end - times[:, None]) / length, 0.0, 1.0)
        value, rate, acceleration = (
            blend * (goal - start) / self.end**k
            + leave * v_start * self.end ** (1 - k)
            + arrive * v_end * length ** (1 - k)
            for k, (blend, leave, arrive) in enumerate(
                zip(
                    _powers(x, 10, -15, 6),
                    _powers(x, -6, 8, -3, 1),
                    _powers(y, -4, 7, -3),
                    strict=True,
                )
            )
        )
        value += start
        quaternion, w, alpha = rotation_vector_motion(
            self._first, value[:, :3], rate[:, :3], acceleration[:, :3]
        )
        return np.hstack([quaternion, value[:, 3:], w, rate[:, 3:], alpha, acceleration[:, 3:]])


def _powers(x: np.ndarray, a: float, b: float, c: float, first: float = 0.0) -> list[np.ndarray]:
    """first x + a x^3 + b x^4 + c x^5, and its two derivatives."""
    found = np.polynomial.Polynomial([0.0, first, 0.0, a, b, c])
    return [found(x), found.deriv()(x), found.deriv(2)(x)]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """A draw's mission, and how near its plan comes to limits."""

    scenario: Scenario
    motion: Meeting
    share: float  # of the limits of force
    distance: float  # m


class Planner:
    """Plans the meeting of a draw."""

    def __init__(self, force: float) -> None:
        scenario = load_scenario(HERE / "scenario.yaml")
        limit = {"base_position": force, "base_rotation": LEVER * force}
        actuation = dataclasses.replace(
            scenario.actuation, limit={**(scenario.actuation.limit or {}), **limit}
        )
        self.scenario = dataclasses.replace(scenario, actuation=actuation)
        self.model = make_nominal_plant(scenario, EMPTY)
        self.names = [f"joint_{k}" for k in range(1, 8)]
        # the hand as the base sees it, in the posture of the grasp, and its Jacobian there
        q = np.concatenate([[1.0], np.zeros(6), READY])
        frame = find_frame(self.model.plant, "servicer::grip", key="model.end_effector")
        self.jacobian = self.model.calc_jacobian(q, frame)[:, 6:]
        self.X_BH = RigidTransform(frame.CalcPoseInWorld(self.model.context))

    def plan(self, drawn: Draw) -> Plan | str:
        """The first meeting within the limits and clear of the debris; else what is in the way."""
        least, nearest = np.inf, -np.inf
        for end in TIMES:
            end = round(float(end), 1)
            tried = [self._meeting(drawn, end, grip) for grip in _GRIPS]
            turn_of = [np.linalg.norm(motion._ends[2][:3]) for _, motion in tried]
            for scenario, motion in (tried[k] for k in np.argsort(turn_of)[:4]):
                share = shares_of(make_mission(scenario))(motion.rows(np.linspace(0.0, end, 40)))
                least = min(least, share)
                if share > SHARE:
                    continue
                path = _path(drawn, motion)
                found = margins_of(
                    make_mission(scenario), Backwards(motion, sample_time=0.01), path, instants=60
                )
                nearest = max(nearest, found.distance)
                if found.distance >= CLEARANCE:
                    return Plan(
                        scenario=scenario, motion=motion, share=share, distance=found.distance
                    )
        return "force" if least > SHARE else "clearance"

    def _meeting(self, drawn: Draw, end: float, grip: RotationMatrix) -> tuple[Scenario, Meeting]:
        """A meeting at a time, with the hand turned to the cube as one of ``_GRIPS`` has it."""
        w, v = np.split(drawn.debris_twist, 2)
        turned = RotationMatrix(matrix_of(quaternion_of(w * end))) @ drawn.debris.rotation()
        X_WP = RigidTransform(turned @ grip, drawn.debris.translation())  # in its moving frame
        X_WB = X_WP @ self.X_BH.inverse()
        R_WB = X_WB.rotation().matrix()
        rates = np.linalg.pinv(self.jacobian) @ np.concatenate([R_WB.T @ w, np.zeros(3)])
        turn = (X_WB.rotation() @ drawn.base.rotation().inverse()).ToAngleAxis()
        ends = [
            np.concatenate([np.zeros(3), drawn.base.translation(), drawn.joints]),
            np.concatenate([drawn.base_twist - [*np.zeros(3), *v], np.zeros(7)]),
            np.concatenate([turn.angle() * turn.axis(), X_WB.translation(), READY]),
            np.concatenate([np.zeros(6), rates]),
        ]
        motion = Meeting(
            ends, drawn.base.rotation().ToQuaternion().wxyz(), self.model, sample_time=0.01, end=end
        )
        names = self.model.coordinates.names
        assert self.scenario.capture is not None
        capture = dataclasses.replace(
            self.scenario.capture,
            rate=w.tolist(),
            servicer_velocity=dict(zip(names, ends[3].tolist(), strict=True)),
            approach=Approach(duration=end, posture=self._posture(drawn.base, drawn.joints)),
        )
        scenario = dataclasses.replace(
            self.scenario,
            duration=end + STOP + 1.0,
            capture=capture,
            initial_posture=self._posture(X_WB, READY),
            initial_velocity=dict(zip(names, ends[1].tolist(), strict=True)),
        )
        return scenario, motion

    def _posture(self, base: RigidTransform, joints: np.ndarray) -> Posture:
        return Posture(
            base_position=base.translation().tolist(),
            base_rpy=base.rotation().ToRollPitchYaw().vector().tolist(),
            joints=dict(zip(self.names, joints.tolist(), strict=True)),
        )


def _path(drawn: Draw, motion: Meeting) -> np.ndarray:
    """Poses (n, 7) of the debris at the samples before the grasp, in its moving frame."""
    times = 0.01 * np.arange(round(motion.end / 0.01))
    quaternions = turned_by(
        times[:, None] * drawn.debris_twist[:3], drawn.debris.rotation().ToQuaternion().wxyz()
    )
    places = np.broadcast_to(drawn.debris.translation(), (times.size, 3))
    return np.hstack([quaternions, places])


# the 24 rotations of a cube
_GRIPS = [
    RotationMatrix(np.array(rows, dtype=float))
    for order in itertools.permutations(np.eye(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(rows := [sign * row for sign, row in zip(signs, order, strict=True)]) > 0.0
]


def fly(plan: Plan) -> str:
    """How a mission ends; "caught" at best."""

    def reference(setup: BlockSetup) -> Any:
        if setup.grip.holds:  # from the grasp on
            return PlannedReference().build(setup)
        return AlongMotion(motion=plan.motion)

    rollout = make_rollout(plan.scenario, blocks={"reference": reference})
    try:
        log = rollout.run()
    finally:
        rollout.release()
    if not log.outcome.completed:
        return log.outcome.status
    if left := limits_left(log):
        return f"leaves a limit: {', '.join(left)}"
    motion = _apart(plan.scenario, log.series["state"][-1])
    return "caught" if (motion <= REST).all() else "not at rest"


def _apart(scenario: Scenario, state: np.ndarray) -> np.ndarray:
    """Sizes [w, v] (2) of the motion of base and held debris to each other."""
    model = make_nominal_plant(scenario)
    q, v = np.split(state, [len(model.coordinates.position_names)])
    held = find_frame(model.plant, "servicer::grip", key="model.end_effector")
    twist = model.calc_jacobian(q, held) @ v - v[:6]
    found: np.ndarray = np.linalg.norm(twist.reshape(2, 3), axis=1)
    return found


def least_force(drawn: Draw, mass: float, reach: float) -> float:
    """A bound (N) on the force along an axis that any motion needs to be at rest to the debris, no
    farther than ``reach`` (m), at the end of the episode.

    Along an axis the least largest acceleration A between two states is that of one switch: A^2 T^2
    / 4 - A |b| = dv^2 / 4 with b = dv T / 2 - dp.
    """
    T, speed = EPISODE, (drawn.debris_twist - drawn.base_twist)[3:]
    way = drawn.debris.translation() - drawn.base.translation()
    b = np.maximum(np.abs(way + 0.5 * speed * T) - reach, 0.0)
    return float((2.0 * mass / T**2 * (b + np.sqrt(b * b + 0.25 * (T * speed) ** 2))).max())


def interval(caught: int, draws: int) -> tuple[float, float]:
    """The Clopper-Pearson interval (95 %) of a share."""
    low = beta.ppf(0.025, caught, draws - caught + 1) if caught else 0.0
    high = beta.ppf(0.975, caught + 1, draws - caught) if caught < draws else 1.0
    return float(low), float(high)


def results(force: float, draws: int, seed: int) -> Iterator[tuple[Draw, str, float]]:
    """Each draw, how its mission ends, and the time of its grasp (NaN without a plan)."""
    planner, rng = Planner(force), np.random.default_rng(seed)
    for _ in range(draws):
        drawn = draw(rng)
        plan = planner.plan(drawn)
        if isinstance(plan, str):
            yield drawn, f"no plan within the limits of {plan}", np.nan
        else:
            yield drawn, fly(plan), plan.motion.end


def main() -> None:
    """Print a row for each force."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=100)
    parser.add_argument("--force", type=float, nargs="*", default=[400.0], help="N, on each axis")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for force in given.force:
        begin, ends, times, passed = time.process_time(), collections.Counter[str](), [], 0
        needed = []
        for drawn, end, at in results(force, given.draws, given.seed):
            ends[end] += 1
            needed.append(least_force(drawn, MASS, REACH))
            if end == "caught":
                times.append(at)
                passed += at > drawn.debris.translation()[0] / -drawn.debris_twist[3]
        caught = ends.pop("caught", 0)
        low, high = interval(caught, given.draws)
        print(f"{force:g} N: {caught} of {given.draws} caught ({low:.1%} to {high:.1%})")
        if times:
            print(
                f"  grasp at {np.median(times):.1f} s (median), {max(times):.1f} s at most; "
                f"{passed} after the debris has passed the start"
            )
        print(f"  out of reach of any motion: {np.mean(np.array(needed) > force):.1%}", dict(ends))
        print(
            f"  processor time {(time.process_time() - begin) / given.draws:.2f} s a draw",
            flush=True,
        )


if __name__ == "__main__":
    main()
