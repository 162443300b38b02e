"""The optimal control problem as a mathematical program over a spline (``curve``).

Positions, rates and their limits are linear in the unknowns, and a spline stays within the hull of
its control points, so limits on those are kept at all times. Force and clearance are evaluated at
the instants of the curve.
"""

import functools
import time
from collections.abc import Callable

import numpy as np
from pydrake.solvers import LinearConstraint, MathematicalProgram, PyFunctionConstraint

from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.plugins.planning.curve import Curve
from ffsm_drake.plugins.planning.frame_end import FrameEnd
from ffsm_drake.plugins.planning.inverse_dynamics import Dynamics
from ffsm_drake.plugins.planning.motion_limits import MotionLimits
from ffsm_drake.plugins.planning.nearness import Nearness
from ffsm_drake.plugins.planning.patient_solver import PatientSolver
from ffsm_drake.plugins.planning.turn_limit import TurnLimit
from ffsm_drake.scenario import Planning
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.systems.plan import DEGREE

_ROOM = 0.002  # m beyond the clearance, for motion between instants
_SUM = 0.005  # share of an impulse that the sum over the instants may miss
_LESS = 0.001  # share by which limits are tightened beyond the required amount
_FIXED, _MOVING = 1e-4, 1e-6  # tolerances; moving knots gain little per step


class PlanningProgram:
    """One problem. ``solve`` may be called again from another first guess."""

    def __init__(
        self,
        *,
        dynamics: Dynamics,
        planning: Planning,
        limits: MotionLimits,
        start: np.ndarray,
        rate: np.ndarray,
        goal: np.ndarray,
        end: FrameEnd | None,
        shortest: float,
        longest: float,
        clearance: Clearance | None,
        distance: float,
        report: Callable[[int, float, float], None],
        is_over: Callable[[], bool],
    ) -> None:
        """Args:
        dynamics: dynamics of z.
        planning: settings.
        limits: limits of z alone, then of other forces.
        start: z at the start.
        rate: rate of z at the start.
        goal: z at the end; NaN: anywhere.
        end: the pose of a frame at the end; None: without one.
        shortest: least length of a segment, s.
        longest: largest duration, s.
        clearance: distances between parts; None: without a limit.
        distance: the least distance to keep, m.
        report: called with evaluations, duration and the largest share of a force limit.
        is_over: True to end the search with its best.
        """
        self._dynamics, self._planning, self._limits = dynamics, planning, limits
        self._report, self._reported = report, time.monotonic()
        self._scale = 1.0  # scales the cost to about 1 for the solver
        self._program = MathematicalProgram()
        self.curve = curve = Curve(dynamics, start.size, planning.segments, self._evaluated)
        self._points = self._program.NewContinuousVariables(curve.num_points, "point")
        duration = self._program.NewContinuousVariables(1, "duration")
        self._times = np.r_[duration, self._program.NewContinuousVariables(planning.segments, "d")]
        self._unknowns = np.r_[self._points, self._times]
        # limits of the rows of the dynamics, and the share of them in use
        self._most = np.concatenate([limits.force, np.ones(dynamics.extra)])
        self._share = np.ones((curve.instants, self._most.size))
        self._add_lengths(shortest, longest)
        self._end: LinearConstraint | None = None
        self._add_curve(start, rate, goal)
        self._frame = end
        if end is not None:
            self._add_frame(end)
        self._turn: TurnLimit | None = None
        if planning.base_attitude_limit is not None:
            self._add_turn(planning.base_attitude_limit)
        self._add_forces()
        self._add_impulses()
        self._nearness: Nearness | None = None
        if clearance is not None and clearance.pairs:
            self._add_clearance(clearance, distance)
        self._program.AddCost(self._cost, vars=self._unknowns)
        self._solver = PatientSolver(
            self._program,
            cost=lambda x: float(self._cost(x[: curve.num_unknowns])),
            evaluations=lambda: curve.evaluations,
            is_over=is_over,
        )

    @property
    def evaluations(self) -> int:
        """Evaluations of the dynamics so far."""
        return self.curve.evaluations

    def _add_lengths(self, shortest: float, longest: float) -> None:
        """Bounds of the segments' lengths and of their sum, the duration."""
        segments = self._planning.segments
        shortest = min(shortest, longest / segments)
        # Effort alone takes all the time there is.
        least = shortest * segments if self._planning.time_weight > 0.0 else longest
        self.durations = least, longest
        none = np.zeros(segments)
        add = self._program.AddLinearConstraint
        self._program.AddBoundingBoxConstraint(least, longest, self._times[0])
        add(self.curve.lengths_by, none + shortest, none + longest, self._times)
        add(np.ones((1, segments)), [0.0], [0.0], self._times[1:])
        self._knots = self._program.AddBoundingBoxConstraint(none, none, self._times[1:])

    def _add_curve(self, start: np.ndarray, rate: np.ndarray, goal: np.ndarray) -> None:
        """Positions, rates and ends of the curve.

        The control points of its rate are 3 (P_k+1 - P_k) by the lengths of three segments.
        """
        limits, last, segments = self._limits, self.curve.count - 2, self._planning.segments
        scale = DEGREE * segments  # row scale: the solver needs a rate times the duration
        points = self._points.reshape(self.curve.count, self.curve.size)
        add = self._program.AddBoundingBoxConstraint
        add(start, start, points[0])
        free = np.where(np.isnan(goal), np.inf, 0.0)
        add(np.nan_to_num(goal) - free, np.nan_to_num(goal) + free, points[-1])
        for i, k in np.ndindex(self.curve.size, self.curve.count - 1):
            add(limits.lower[i], limits.upper[i], points[k + 1, i])
            most = float(limits.rate[i])
            least = -most
            if k == 0:
                least = most = float(rate[i])
            elif k == last and (i >= 3 or self._dynamics.turns or self._planning.end_rate == 0.0):
                most = min(most, self._planning.end_rate)
                least = -most
            if not np.isfinite(most):
                continue
            near = slice(max(k - 2, 0), k + 1)
            span = segments * self.curve.lengths_by[near].sum(axis=0)
            rows = [np.r_[-scale, scale, -bound * span] for bound in (least, most)]
            variables = np.r_[points[k : k + 2, i], self._times]
            if least == most:
                self._program.AddLinearEqualityConstraint(np.array(rows[:1]), [0.0], variables)
            else:
                self._program.AddLinearConstraint(
                    np.array(rows), [0.0, -np.inf], [np.inf, 0.0], variables
                )

    def _add_frame(self, end: FrameEnd) -> None:
        """A frame ends at its pose."""
        curve, none = self.curve, np.zeros(6)[end.rows]
        self._program.AddConstraint(
            lambda x: curve.lifted(x, *end.distance(curve, curve.given(x))),
            none, none, self._unknowns,
        )  # fmt: skip

    def _limit_end(self, last: np.ndarray) -> None:
        """Limit the base's angular velocity at the end, with its rotation vector there (3,), rad.

        It is J 3 (P_n - P_n-1) by the last length; J changes from one solution to the next.
        """
        still = np.zeros((3, 3))
        _, left, _ = attitude_motion(np.tile(last[:, None], 3), np.eye(3), still)
        segments = self._planning.segments
        turning = DEGREE * segments * np.hstack([-left, left])
        most = np.tile(self._planning.end_rate * segments * self.curve.lengths_by[-1], (3, 1))
        rows = np.block([[turning, -most], [turning, most]])
        none = np.zeros(3)
        bounds = np.r_[none - np.inf, none], np.r_[none, none + np.inf]
        if self._end is None:
            points = self._points.reshape(self.curve.count, self.curve.size)[-2:, :3]
            variables = np.r_[points.ravel(), self._times]
            self._end = self._program.AddLinearConstraint(rows, *bounds, variables).evaluator()
        else:
            self._end.UpdateCoefficients(rows, *bounds)

    def _add_forces(self) -> None:
        """Forces within their limits."""
        bounded = np.flatnonzero(np.isfinite(self._most))
        limits, self._bounded = self._most[bounded], bounded
        self._forces: PyFunctionConstraint | None = None
        if not bounded.size:
            return

        ones = np.ones(self.curve.instants * bounded.size)
        constraint = self._program.AddConstraint(
            lambda x: (self.curve.values(x)[:, bounded] / limits).ravel(),
            -ones,
            ones,
            self._unknowns,
        )
        self._forces = constraint.evaluator()
        self._forces.SetGradientSparsityPattern(self.curve.pattern(bounded.size))

    def _add_impulses(self) -> None:
        """Impulses within their limits: |tau| <= s at every instant, and the sum of s limited."""
        limited = np.flatnonzero(np.isfinite(self._limits.impulse))
        if not limited.size:
            return
        sizes = self._program.NewContinuousVariables(self.curve.instants * limited.size, "size")
        inner, times = self._unknowns.size, self._times.size
        weights = self.curve.weights @ self.curve.lengths_by

        def room(x: np.ndarray) -> np.ndarray:
            force, given = self.curve.values(x)[:, limited].ravel(), x[inner:]
            return np.concatenate([given - force, given + force])

        none = np.zeros(2 * sizes.size)
        constraint = self._program.AddConstraint(
            room, none, none + np.inf, np.r_[self._unknowns, sizes]
        )
        upper = self.curve.pattern(limited.size)
        lower = [(row + sizes.size, column) for row, column in upper]
        own = [(row, inner + row % sizes.size) for row in range(none.size)]
        constraint.evaluator().SetGradientSparsityPattern(upper + lower + own)
        for k, i in enumerate(limited):
            self._program.AddConstraint(
                lambda x: np.array([x[:times] @ (weights.T @ x[times:])]),
                [0.0], [(1.0 - _SUM) * float(self._limits.impulse[i])],
                np.r_[self._times, sizes[k :: limited.size]],
            )  # fmt: skip

    def _add_turn(self, most: float) -> None:
        """The base turns no further: by its control points, in whose hull the curve is, or as
        momentum takes it.
        """
        if self._dynamics.turns:
            self._turn = TurnLimit(self._program, self.curve, self._unknowns, most)
            return
        for point in self.curve.points(self._points)[1:, :3]:
            self._program.AddQuadraticConstraint(
                2.0 * np.eye(3), np.zeros(3), -np.inf, most**2, point
            )

    def _add_clearance(self, clearance: Clearance, distance: float) -> None:
        """Parts keep their distance."""
        self._nearness = Nearness(clearance, self.curve, distance + _ROOM)
        ones = np.ones(self.curve.instants)
        constraint = self._program.AddConstraint(
            self._nearness, -np.inf * ones, ones, self._unknowns
        )
        constraint.evaluator().SetGradientSparsityPattern(self.curve.pattern(1))

    def tighten(self, used: np.ndarray, turn: float, short: float, *, where: bool) -> None:
        """Tighten what a solution exceeds between instants.

        Args: shares of the limits of rows in use (m, rows), at equally many instants of every third
        of a segment; the share of the largest turn; by how much parts are too near, m; whether
        forces are tightened where they exceed their limits alone.
        """
        parts = len(self.curve.steps)
        inner = len(used) // parts
        most = np.maximum(used[:-1].reshape(parts, inner, -1).max(axis=1), used[inner::inner])
        around = np.maximum(np.pad(most, ((1, 0), (0, 0))), np.pad(most, ((0, 1), (0, 0))))
        around = around if where else np.full_like(around, around.max())
        self._share /= np.where(around > 1.0, around + _LESS, 1.0)
        if self._forces is not None:
            bound = self._share[:, self._bounded].ravel()
            self._forces.set_bounds(-bound, bound)
        if self._turn is not None and turn > 1.0:
            self._turn.most /= turn + _LESS
        if self._nearness is not None and short > 0.0:
            self._nearness.kept += short + _ROOM

    def learn_end(self, unknowns: np.ndarray, q: np.ndarray) -> None:
        """Aim so that the frame is at its pose, where unknowns lead to q (nq) at the end."""
        if self._frame is not None:
            self._frame.learn(self.curve, unknowns, q)

    def _evaluated(self, unknowns: np.ndarray) -> None:
        """Report about once a second."""
        if time.monotonic() - self._reported > 1.0:
            self._reported = time.monotonic()
            duration = float(self.curve.last_lengths.sum())
            self._report(self.evaluations, duration, self.worst(unknowns))

    def used(self, *motion: np.ndarray) -> np.ndarray:
        """Shares (n, rows) of the limits, for z and its derivatives (size, n)."""
        shares: np.ndarray = np.abs(self._dynamics.calc(*motion)[: self._most.size].T) / self._most
        return shares

    def worst(self, unknowns: np.ndarray) -> float:
        """Return the largest share of a force limit in use."""
        rows = self.curve.evaluate(unknowns)[0][:, : self._most.size]
        return float(np.max(np.abs(rows) / self._most))

    def _cost(self, x: np.ndarray) -> np.ndarray:
        """Weighed duration and integral of the squared force."""
        own, effort = self._planning.time_weight, self._planning.effort_weight
        square = np.square(self.curve.values(x)[:, : self._limits.force.size]).sum(axis=1)
        lengths = self.curve.lengths(x)
        return (
            own * lengths.sum() + effort * (self.curve.weights @ lengths) @ square
        ) / self._scale

    def solve(self, guess: np.ndarray, *, moving: bool) -> tuple[np.ndarray, str]:
        """Return the best unknowns found, with the solver's message; knots keep their shares of
        the duration unless they are ``moving``.
        """
        first = np.zeros(self._program.num_vars())
        first[: guess.size] = guess
        limited = np.flatnonzero(np.isfinite(self._limits.impulse))
        first[guess.size :] = np.abs(self.curve.evaluate(guess)[0][:, limited]).ravel()
        self._scale = 1.0
        self._scale = max(float(self._cost(guess)), 1e-12)
        if not self._dynamics.turns and self._planning.end_rate > 0.0:
            self._limit_end(self.curve.points(guess)[-1, :3])
        fixed = guess[self.curve.num_points + 1 :]
        room = np.inf if moving else 0.0
        self._knots.evaluator().set_bounds(fixed - room, fixed + room)
        once = functools.partial(self._solver.solve, tolerance=_MOVING if moving else _FIXED)
        found, said = once(first) if self._turn is None else self._turn.solve(first, once)
        return found[: guess.size], said
