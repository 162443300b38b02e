"""Arms that close loops beside a given motion of the base and of the arm that carries the target.

Their joints are splines in time, through the solutions of the inverse kinematics at nodes. A hand
that is open at the start comes to its place by a polynomial of fifth order in its arm's joints,
with the position, velocity and acceleration of the closed chain there.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.interpolate import BPoly, BSpline, make_interp_spline

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain, Loop
from ffsm_drake.plugins.two_arms.loads import SOON, Loads
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.scenario.contacts import ALL_HANDS, closing_times
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion

NODES, _MOST_NODES = 128, 2048
_ACCURATE = 1e-10  # m, rad: gap between the nodes
_AT_REST = 1e-7  # rad/s, m/s: of a motion that has ended
_LEAST = 1.0  # s, of the spline of a hand that closes when the motion has ended
SINGULAR = 0.01  # singular value of an arm's Jacobian below which no motion is planned


class Following(PlannedMotion):
    """A motion of base and carrying arm, whose closing arms follow."""

    def __init__(
        self,
        motion: PlannedMotion,
        mission: Mission,
        nominal: PlantModel,
        *,
        since: float,
        closed: float | None = None,
        most: int = _MOST_NODES,
    ) -> None:
        """Args:
          motion: the motion, with first guesses of the joints of the closing arms at its start.
          mission: the mission.
          nominal: the plant with the nominal payload.
          since: begin of the motion after the grasp of the first hand, s.
          closed: hands with ``closes`` up to this time, s, hold the target then. The others close
            where the motion ends, but not before their time. None: all close at their time.
          most: nodes of a spline, at most.

        Raises ScenarioError: a hand does not reach its place, or an arm is singular.
        """
        self._motion, self.path, scenario = motion, motion.path, mission.scenario
        period, closings = scenario.sample_time, closing_times(scenario)
        super().__init__(coordinates=motion.coordinates, sample_time=period, end=motion.end)
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        row = motion.rows(np.zeros(1))[0]
        chain = ClosedChain(nominal, scenario, ALL_HANDS, true=False)
        close, self.arms = Closing(chain, [row[:nq]], motion.end), list[Reach]()
        end = period * samples_to(motion.end, period)
        begins = {each: each - since for each in closings}
        if closed is not None:
            begins = {each: max(each - since, end) if each > closed else 0.0 for each in closings}
        self._loads = Loads(scenario, nominal, begins)

        def rest(times: np.ndarray) -> np.ndarray:
            return motion.rows(times)[:, NUM_BASE_POSITIONS:nq]

        left = scenario.duration - scenario.grasp_time - since
        drifts = np.abs(motion.rows(np.array([motion.end]))[0, nq : nq + nv]).max() > _AT_REST
        for loop in chain.loops:
            begin = begins[loop.contact.closes]
            arm, marks = Arm(close, loop, rest), [begin, max(motion.end, begin + _LEAST)]
            if drifts and left > marks[-1] + SOON:
                marks.append(left)
            own = fitted(marks, arm.solve, arm.error, most)
            velocity = row[nq : nq + nv][loop.joints]
            self.arms.append(Reach(loop.joints, arm.first, own.t, own.c, velocity))

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        return with_arms(self, self._motion.rows(times), self.arms, times)

    def remarks(self) -> list[str]:
        """See PlannedMotion."""
        return self._motion.remarks()

    def shared(
        self, times: np.ndarray, found: dict[str, np.ndarray], state: Sequence[np.ndarray]
    ) -> dict[str, np.ndarray]:
        """See PlannedMotion."""
        return self._loads.shared(self, times, found, state)


def samples_to(time: float, period: float) -> int:
    """Return the first sample that is not before a time (s)."""
    return math.ceil(time / period - SOON)


def span(scenario: Scenario, grip: Grip, end: float) -> tuple[float, float]:
    """Begin and end (s) in the phase of a grip, of a motion to ``end``."""
    closed = grip.closed
    if closed is None:
        return 0.0, end
    later = (each for each in closing_times(scenario) if each > closed)
    return closed, min(later, default=max(end, closed))


def with_arms(
    motion: PlannedMotion, rows: np.ndarray, arms: Sequence["Reach"], times: np.ndarray
) -> np.ndarray:
    """Rows of a motion at times (n,) with the joints of arms that follow."""
    nq, nv = motion.coordinates.num_positions, motion.coordinates.num_velocities
    for each in arms:
        columns = np.add.outer((nq - nv, nq, nq + nv), each.joints)
        for column, values in zip(columns, each.at(times), strict=True):
            rows[:, column] = values
    return rows


class Reach:
    """Motion of the arm of a hand that closes a loop."""

    def __init__(
        self,
        joints: np.ndarray,
        first: np.ndarray,
        knots: np.ndarray,
        values: np.ndarray,
        velocity: np.ndarray,
    ) -> None:
        """Args: indices in v; positions at the start; a spline from the grasp on; velocities at the
        start.
        """
        self.joints, self.values, spline = joints, values, BSpline(knots, values, k=5)
        self._given = first, knots, velocity
        self._closed = [functools.partial(spline, nu=order) for order in range(3)]
        self._closes, self._end = self.marks = knots[0], knots[-1]
        self._open: list[Callable[[np.ndarray], np.ndarray]] = [*self._closed]
        if self._closes > 0.0:
            ends = [first, velocity, 0.0 * first], [each(knots[0]) for each in self._closed]
            open_ = BPoly.from_derivatives([0.0, self._closes], ends)
            self._open = [open_, open_.derivative(), open_.derivative(2)]

    def with_values(self, values: np.ndarray) -> "Reach":
        """The motion with other values of its spline, in any shape."""
        first, knots, velocity = self._given
        return Reach(self.joints, first, knots, values.reshape(self.values.shape), velocity)

    def at(self, times: np.ndarray) -> list[np.ndarray]:
        """Positions, velocities and accelerations (n, joints each) at times (n)."""
        is_open, over = (times < self._closes)[:, None], (times > self._end)[:, None]
        before, after = np.clip(times, 0.0, self._closes), np.clip(times, self._closes, self._end)
        found = []
        for order, (open_, closed) in enumerate(zip(self._open, self._closed, strict=True)):
            values = np.where(is_open, open_(before), closed(after))
            found.append(np.where(over, 0.0, values) if order else values)
        return found


class Closing:
    """The loops of a nominal chain, closed one after the other along a path."""

    def __init__(self, chain: ClosedChain, guesses: Sequence[np.ndarray], end: float) -> None:
        """Args: the chain; configurations (nq) near which hands close; the path parameter at the
        end.
        """
        self.chain, self.guesses, self._end = chain, guesses, end

    def close(self, s: float, q: np.ndarray, loops: Sequence[Loop]) -> np.ndarray:
        """The configuration with loops closed, at a path parameter."""
        chain = self.chain
        try:
            q = chain.closed(q, loops)
        except ScenarioError as error:
            raise self.refused(s, str(error).partition(": ")[2].partition(";")[0]) from None
        for loop in loops:
            jacobian = loop.closure.jacobian(chain.model, q)
            for joints in (chain.carrying, loop.joints):
                least = np.linalg.svd(jacobian[:, joints], compute_uv=False)[len(jacobian) - 1]
                if least < SINGULAR:
                    names = chain.model.coordinates.names
                    raise self.refused(
                        s,
                        f"the arm of {names[joints[0]]} to {names[joints[-1]]} is singular "
                        f"(smallest singular value {least:.2g}, at least {SINGULAR:g})",
                    )
        return q

    def refused(self, s: float, problem: str) -> ScenarioError:
        """The error of a path that cannot be followed."""
        return ScenarioError(
            "contacts",
            f"no motion of the closed chain: at {100 * s / self._end:.3g} % of the path {problem}; "
            "change initial_posture or target_posture",
        )


class Arm:
    """An arm that closes a loop, beside the joints (m, n) of the rest at times (m)."""

    def __init__(self, closing: Closing, loop: Loop, rest: Callable[..., Any]) -> None:
        self._closing, self._loop, self._rest = closing, loop, rest
        self._places = loop.joints + 1
        self.first = closing.guesses[0][self._places]

    def solve(self, s: np.ndarray) -> np.ndarray:
        """Its joints (m, k) with the loop closed, near those of the first guess where it closes,
        or of a later one.
        """
        starts, failed, rest = list[np.ndarray](), list[ScenarioError](), self._rest(s)
        for guess in self._closing.guesses:
            try:
                starts.append(self._closed(s[0], rest[0], guess[self._places]))
            except ScenarioError as error:
                failed.append(error)
        if not starts:
            raise failed[0]
        found = [min(starts, key=lambda each: np.abs(each - self.first).max())]
        for each, others in zip(s[1:], rest[1:], strict=True):
            found.append(self._closed(each, others, found[-1]))
        return np.array(found)

    def _closed(self, s: float, rest: np.ndarray, joints: np.ndarray) -> np.ndarray:
        q = self._closing.close(s, self._whole(rest, joints), [self._loop])
        return q[self._places]

    def _whole(self, rest: np.ndarray, joints: np.ndarray) -> np.ndarray:
        q = np.concatenate([[1.0], np.zeros(6), rest])
        q[self._places] = joints
        return q

    def error(self, s: np.ndarray, joints: np.ndarray) -> float:
        """The largest gap (m, rad) for its joints (m, k)."""
        worst = 0.0
        for rest, own in zip(self._rest(s), joints, strict=True):
            gap = self._loop.closure.gap(self._closing.chain.model, self._whole(rest, own))
            worst = max(worst, np.abs(gap).max())
        return worst


def fitted(
    marks: Sequence[float],
    solve: Callable[..., Any],
    error: Callable[..., Any],
    most: int = _MOST_NODES,
) -> BSpline:
    """The spline of fifth order through solutions at path parameters, one from each mark to the
    next, with as many nodes as its error between them asks for, ``most`` at most.
    """
    nodes = NODES
    while True:
        parts = [np.linspace(*pair, nodes + 1) for pair in itertools.pairwise(marks)]
        values = np.split(solve(np.concatenate(parts)), len(parts))
        splines = list(map(functools.partial(make_interp_spline, k=5), parts, values))
        knots = [splines[0].t, *(each.t[6:] for each in splines[1:])]
        found = BSpline(np.concatenate(knots), np.concatenate([each.c for each in splines]), k=5)
        between = np.concatenate([0.5 * (s[1:] + s[:-1]) for s in parts])
        if nodes >= most or error(between, found(between)) < _ACCURATE:
            return found
        nodes *= 2
