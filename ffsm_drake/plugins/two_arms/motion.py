"""A motion of the closed chain: the target's pose along a polynomial, and the joints by inverse
kinematics.

The target moves in the base's frame on a line and about an eigenaxis, from its pose in the initial
posture to that in the target posture, with the motion's own path parameter; the base moves as
without the chain. The joints are splines in the path parameter, through the solutions of the
inverse kinematics at nodes; each begins at the one before it and changes the joints least.

A late hand (``contacts.NAME.closes``) comes to its place as in ``following``.
"""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import BSpline

from ffsm_drake.common.so3 import turned_by
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.two_arms.after_closing import PlannedAfterClosing
from ffsm_drake.plugins.two_arms.chain import ClosedChain, newton_step
from ffsm_drake.plugins.two_arms.closed_motion import ClosedMotion
from ffsm_drake.plugins.two_arms.following import (
    Arm,
    Closing,
    Reach,
    fitted,
    span,
    with_arms,
)
from ffsm_drake.plugins.two_arms.framed import framed_motion
from ffsm_drake.plugins.two_arms.loads import Loads
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import ALL_HANDS, closing_times
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    halves,
    position_error,
)
from ffsm_drake.spacecraft.grasp import plastic_impact
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration, find_body
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.start import velocity_at_start

_REACHED = 1e-11  # m, rad: error of the target's pose at a node
_STEPS = 60


class ChainMotion(PlannedMotion):
    """A polynomial whose joints follow the target."""

    def __init__(self, motion: PlannedMotion, mission: Mission, nominal: PlantModel) -> None:
        """Args:
          motion: the polynomial of the base.
          mission: the mission, with the duration of that motion.
          nominal: the plant with the nominal payload, in the hands of its phase.

        Raises ScenarioError: a hand does not reach, or an arm is singular.
        """
        scenario = mission.scenario
        velocity, closings = None, closing_times(scenario)
        if scenario.starts_moving:
            velocity = velocity_at_start(mission, nominal)
        elif len(closings) > 1:
            velocity = np.zeros(nominal.coordinates.num_velocities)
        self._in_time = velocity is not None
        # without a velocity the path parameter is all that matters
        paths = _path(mission, velocity, motion.end if self._in_time else 1.0)
        (_, _, knots, values), *reaching = paths
        self._joints = BSpline(knots, values, k=5)
        self._rates = self._joints.derivative(), self._joints.derivative(2)
        self._reaching = [
            Reach(*each, velocity[each[0]]) for each in reaching if velocity is not None
        ]
        self._motion, self._blend = motion, Blend(scenario.reference, motion.end)
        closed = nominal.grip.closed
        self._scenario = scenario
        latest = closings if closed is None else [closed]
        self._loads = Loads(scenario, nominal, dict(zip(latest, latest, strict=True)))
        begin, end = span(scenario, nominal.grip, motion.end)
        period = scenario.sample_time
        super().__init__(coordinates=motion.coordinates, sample_time=period, begin=begin, end=end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._motion.rows(times)
        if self._in_time:
            s = np.clip(times, 0.0, self._motion.end)
            ds, dds = np.where(times < self._motion.end, 1.0, 0.0), np.zeros(times.size)
        else:
            s, ds, dds = self._blend.blend(times)
        by_s, by_ss = (rate(s) for rate in self._rates)
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        n = nq - NUM_BASE_POSITIONS
        rows[:, nq - n : nq] = self._joints(s)
        rows[:, nq + nv - n : nq + nv] = ds[:, None] * by_s
        rows[:, -n:] = dds[:, None] * by_s + (ds**2)[:, None] * by_ss
        return with_arms(self, rows, self._reaching, times)

    def instants(self, count: int) -> np.ndarray:
        """See PlannedMotion; as many up to the grasp of each late hand."""
        marks = np.unique([self.begin, *closing_times(self._scenario), self.end])
        marks = marks[(marks >= self.begin) & (marks <= self.end)]
        parts = np.linspace(0, len(marks) - 1, (len(marks) - 1) * (count - 1) + 1)
        return np.interp(parts, np.arange(len(marks)), marks)

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion: the arms share the force as ``chain.force`` has it."""
        return self._loads.shared(self, times, found, state)


@planned
def _path(
    mission: Mission, velocity: np.ndarray | None, end: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Splines of fifth order, each as joints (indices in v), their positions at the start, knots
    and coefficients: of all joints, by the path parameter or with a velocity (nv) at the start by
    time (s), to ``end``; then of the arm of each late hand, from its grasp on.
    """
    follower = _Follower(mission, velocity, end)
    whole = fitted([0.0, end], follower.solve, follower.error)
    every = np.arange(whole.c.shape[1]) + NUM_BASE_VELOCITIES
    found = [(every, whole.c[0], whole.t, whole.c)]
    for loop in follower.later:
        begin = loop.contact.closes
        arm = Arm(follower.closing, loop, lambda s: whole(np.minimum(s, end)))
        own = fitted([begin, max(end, begin + 1.0)], arm.solve, arm.error)
        found.append((loop.joints, arm.first, own.t, own.c))
    return found


class _Follower:
    """The joints for poses of the target in the base's frame, base at the origin."""

    def __init__(self, mission: Mission, velocity: np.ndarray | None, end: float) -> None:
        scenario = mission.scenario
        self.model = model = mission.craft.nominal()
        whole = ClosedChain(model, scenario, ALL_HANDS, true=False)
        self.later = [loop for loop in whole.loops if loop.contact.closes]
        self._chain = ClosedChain(model, scenario, true=False)
        body = find_body(model.plant, scenario.payload.body, key="payload.body")
        self._target = body.body_frame()
        postures = [self._posture(scenario, each) for each in ("initial_posture", "target_posture")]
        self.closing = Closing(whole, postures, end)
        self._start = self._chain.closed(postures[0])
        self._first = model.calc_frame_pose(self._start, self._target)
        self._blend = None
        # rotation vectors and ways, by the blend and by the excursion of the velocity at the start
        self._turns, self._ways = np.zeros((2, 2, 3))
        if velocity is not None:
            self._blend = Blend(scenario.reference, end)
            arm = self._chain.carrying
            jacobian = model.calc_jacobian(self._start, self._target)[:, arm]
            self._turns[1], self._ways[1] = np.split(jacobian @ velocity[arm], 2)
        if scenario.reference.goal == "stop":
            time = 0.0 if self._blend is None else self._blend.stopping_time
            self._turns[0], self._ways[0] = time * self._turns[1], time * self._ways[1]
        else:
            last = model.calc_frame_pose(postures[1], self._target)
            self._turns[0], self._ways[0] = np.split(position_error(last, self._first), 2)

    def _posture(self, scenario: Scenario, key: str) -> np.ndarray:
        """A configuration with the base at the origin."""
        return self._rooted(configuration(self.model.coordinates, getattr(scenario, key), key=key))

    @staticmethod
    def _rooted(q: np.ndarray) -> np.ndarray:
        """q with the base at the origin."""
        return np.concatenate([[1.0], np.zeros(6), q[NUM_BASE_POSITIONS:]])

    def _pose(self, s: float) -> np.ndarray:
        """The target's pose (7; quaternion, position) at a path parameter, or a time."""
        along = np.array([s, 0.0])
        if self._blend is not None:
            along[:] = self._blend.blend(np.array([s]))[0][0], self._blend.stop(np.array([s]))[0][0]
        turn, place = np.split(self._first, [4])
        return np.concatenate([turned_by(along @ self._turns, turn), place + along @ self._ways])

    def _off(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Rotation vector and position (6) from the target's pose to another one (7)."""
        return position_error(pose, self.model.calc_frame_pose(q, self._target))

    def error(self, s: np.ndarray, joints: np.ndarray) -> float:
        """The largest error (m, rad) of the target's pose or a gap, for joints (m, n) at s (m)."""
        worst = 0.0
        for each, q in zip(s, joints, strict=True):
            whole = self._rooted(np.concatenate([np.zeros(7), q]))
            worst = max(worst, np.abs(self._off(self._pose(each), whole)).max())
            worst = max(worst, np.abs(self._chain.gap(whole)).max(initial=0.0))
        return worst

    def solve(self, s: np.ndarray) -> np.ndarray:
        """The joints (m, n) at path parameters (m)."""
        q, found = self._start, []
        for each in s.tolist():
            q = self._follow(each, q)
            found.append(q[NUM_BASE_POSITIONS:])
        return np.array(found)

    def _follow(self, s: float, q: np.ndarray) -> np.ndarray:
        """The configuration at a path parameter, from one nearby."""
        chain, q = self._chain, q.copy()
        arm, pose = chain.carrying, self._pose(s)
        off = self._off(pose, q)
        for _ in range(_STEPS):
            if np.abs(off).max() < _REACHED:
                break
            q[arm + 1] += newton_step(self.model.calc_jacobian(q, self._target)[:, arm], off)
            off = self._off(pose, q)
        if not np.abs(off).max() < 1e-9:
            raise self.closing.refused(s, "the hand that carries the target does not reach")
        return self.closing.close(s, q, chain.loops)


def closed_chain(
    scenario: Scenario, model: PlantModel, q: np.ndarray, *, stays: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The plant's own q (nq) with the loops of the true contacts closed, without those of late
    hands, and their A (m, nv). ``stays``: q does not change.
    """
    chain = ClosedChain(model, scenario, true=True)
    q = q if stays else chain.closed(q)
    return q, chain.jacobian(q)


def start_of(mission: Mission, model: PlantModel, state: np.ndarray) -> np.ndarray:
    """The plant's own [q; v] with the loops of the true contacts closed, and no rate of the gaps.

    Args:
      mission: the mission.
      model: the true plant.
      state: [q; v] with the loops open.
    """
    q, v = halves(state)
    q, jacobian = closed_chain(mission.scenario, model, q)
    if v.any():
        v, _ = plastic_impact(model.calc_mass_matrix(q), jacobian, v)
    return np.concatenate([q, v])


def closed_motion(motion: PlannedMotion, mission: Mission, nominal: PlantModel) -> PlannedMotion:
    """The motion of a chain: of a frame along its path, along a plan, or of the target along the
    path of a polynomial. Raises the errors of these motions.
    """
    if mission.scenario.reference.kind != "optimal":
        framed = mission.scenario.reference.frame is not None
        return (framed_motion if framed else ChainMotion)(motion, mission, nominal)
    if len(closing_times(mission.scenario)) > 1:
        return PlannedAfterClosing(motion, mission, nominal.grip)
    return ClosedMotion(motion, mission, nominal)
