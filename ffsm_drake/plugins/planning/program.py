"""The optimal control problem as a mathematical program over a spline's control points and
segments.

The unknowns are the control points P of z (``systems.plan``) and the lengths h of the spline's
segments, so knots can move to the instants of switching forces. Positions, rates and their limits
are linear in these, and a spline stays within the hull of its control points, so limits on
those are kept at all times. Force and clearance are evaluated at a few instants of every
segment.
"""

import time
from collections.abc import Callable

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.solvers import (
    LinearConstraint,
    MathematicalProgram,
    PyFunctionConstraint,
    SnoptSolver,
    SolverOptions,
)
from scipy.spatial.transform import Rotation

from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.plugins.planning.inverse_dynamics import (
    FreeDynamics,
    InverseDynamics,
    complex_step,
    turned,
)
from ffsm_drake.plugins.planning.limits import MotionLimits
from ffsm_drake.scenario import Planning
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.systems.plan import DEGREE

INSTANTS = 3  # per segment, at which force and clearance are evaluated
_INFLUENCE = 0.1  # m beyond the clearance; nearer parts are seen by the solver
_SHARP = 100.0  # of the smooth maximum over them
_ROOM = 0.002  # m beyond the clearance, for motion between instants
_SUM = 0.005  # share of an impulse that the sum over the instants may miss
_LESS = 0.001  # share by which limits are tightened beyond the required amount
_LESS_TURN, _TURN_ROOM = 0.85, 1e-3  # relative change of the base's turn between solutions
# The solver is stopped when merit falls by less than a share in so many evaluations.
_GAIN, _PATIENCE, _MOST = 1e-3, 100, 1000
_PENALTY = 10.0  # merit: relative increase of the cost by violation of constraints
# Moving knots gain little per step, so that they need the smaller tolerance.
_FIXED, _MOVING = 1e-4, 1e-6
# SNOPT would forget after 10 updates, and take thousands of iterations to least effort.
_OPTIONS = {"Major iterations limit": 1000, "Iterations limit": 100_000, "Hessian updates": 200}


class _NoGainError(Exception):
    """The solver has stopped gaining, or its time is over."""


class PlanningProgram:
    """One problem. ``solve`` may be called again from another first guess."""

    def __init__(
        self,
        *,
        dynamics: InverseDynamics | FreeDynamics,
        planning: Planning,
        limits: MotionLimits,
        start: np.ndarray,
        rate: np.ndarray,
        goal: np.ndarray | None,
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
        limits: limits of z alone.
        start: z at the start.
        rate: rate of z at the start.
        goal: z at the end; None: anywhere.
        shortest: least length of a segment, s.
        longest: largest duration, s.
        clearance: distance to keep, m.
        distance: distances between parts.
        report: called with evaluations, duration and the largest share of a force limit.
        is_over: True to end the search with its best.
        """
        self._dynamics, self._planning, self._limits = dynamics, planning, limits
        self._report, self._reported = report, time.monotonic()
        self._is_over = is_over
        self.evaluations = 0
        self._size, self._count = start.size, planning.segments + DEGREE
        self._cache: tuple[bytes, np.ndarray, np.ndarray] = (b"", np.empty(0), np.empty(0))
        self._scale = 1.0  # scales the cost to about 1 for the solver
        self._program = MathematicalProgram()
        self._points = self._program.NewContinuousVariables(self._count * start.size, "point")
        duration = self._program.NewContinuousVariables(1, "duration")
        self._times = np.r_[duration, self._program.NewContinuousVariables(planning.segments, "d")]
        self._unknowns = np.r_[self._points, self._times]
        self._set_instants()
        self._add_lengths(shortest, longest)
        self._end: LinearConstraint | None = None
        self._add_curve(start, rate, goal)
        self._turn: PyFunctionConstraint | None = None
        if planning.base_attitude_limit is not None:
            self._largest_turn = self._allowed_turn = planning.base_attitude_limit
            self._add_turn()
        self._add_forces()
        self._add_impulses()
        self._clearance: Clearance | None = None
        if clearance is not None and clearance.pairs:
            self._clearance, self._kept = clearance, distance + _ROOM
            self._add_clearance(clearance)
        self._program.AddCost(self._cost, vars=self._unknowns)
        self._program.AddVisualizationCallback(self._watch, self._program.decision_variables())

    def _set_instants(self) -> None:
        """The instants, the unknowns that each depends on, and their parts in an integral."""
        segments, count = self._planning.segments, INSTANTS * self._planning.segments + 1
        self._segment = np.minimum(np.arange(count) // INSTANTS, segments - 1)
        self._within = np.arange(count) / INSTANTS - self._segment
        self._near = self._segment[:, None] + np.arange(DEGREE + 1)  # control points
        points = self._near[..., None] * self._size + np.arange(self._size)
        lengths = self._segment[:, None] + np.arange(-2, 3)
        # Segments beyond the ends are in a last column, which is ignored.
        lengths[(lengths < 0) | (lengths >= segments)] = segments
        self._columns = np.hstack([points.reshape(count, -1), lengths + self._points.size])
        # h = lengths_by [T, d]
        self._lengths_by = np.hstack([np.full((segments, 1), 1.0 / segments), np.eye(segments)])
        self._share = np.ones((count, self._size))  # share of the force limits
        # Both times the lengths: time between instants, weights of the trapezoidal rule, s.
        self._steps = np.repeat(np.eye(segments), INSTANTS, axis=0) / INSTANTS
        self._weights = 0.5 * (
            np.pad(self._steps, ((0, 1), (0, 0))) + np.pad(self._steps, ((1, 0), (0, 0)))
        )

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
        add(self._lengths_by, none + shortest, none + longest, self._times)
        add(np.ones((1, segments)), [0.0], [0.0], self._times[1:])
        self._knots = self._program.AddBoundingBoxConstraint(none, none, self._times[1:])

    def _add_curve(self, start: np.ndarray, rate: np.ndarray, goal: np.ndarray | None) -> None:
        """Positions, rates and ends of the curve.

        The control points of its rate are 3 (P_k+1 - P_k) by the lengths of three segments.
        """
        limits, last, segments = self._limits, self._count - 2, self._planning.segments
        scale = DEGREE * segments  # row scale: the solver needs a rate times the duration
        points = self._points.reshape(self._count, self._size)
        add = self._program.AddBoundingBoxConstraint
        add(start, start, points[0])
        if goal is not None:
            add(goal, goal, points[-1])
        for i, k in np.ndindex(self._size, self._count - 1):
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
            span = segments * self._lengths_by[near].sum(axis=0)
            rows = [np.r_[-scale, scale, -bound * span] for bound in (least, most)]
            variables = np.r_[points[k : k + 2, i], self._times]
            if least == most:
                self._program.AddLinearEqualityConstraint(np.array(rows[:1]), [0.0], variables)
            else:
                self._program.AddLinearConstraint(
                    np.array(rows), [0.0, -np.inf], [np.inf, 0.0], variables
                )

    def _limit_end(self, last: np.ndarray) -> None:
        """Limit the base's angular velocity at the end, with its rotation vector there (3,), rad.

        It is J 3 (P_n - P_n-1) by the last length; J changes from one solution to the next.
        """
        still = np.zeros((3, 3))
        _, left, _ = attitude_motion(np.tile(last[:, None], 3), np.eye(3), still)
        segments = self._planning.segments
        turning = DEGREE * segments * np.hstack([-left, left])
        most = np.tile(self._planning.end_rate * segments * self._lengths_by[-1], (3, 1))
        rows = np.block([[turning, -most], [turning, most]])
        none = np.zeros(3)
        bounds = np.r_[none - np.inf, none], np.r_[none, none + np.inf]
        if self._end is None:
            points = self._points.reshape(self._count, self._size)[-2:, :3]
            variables = np.r_[points.ravel(), self._times]
            self._end = self._program.AddLinearConstraint(rows, *bounds, variables).evaluator()
        else:
            self._end.UpdateCoefficients(rows, *bounds)

    def _add_forces(self) -> None:
        """Forces within their limits."""
        bounded = np.flatnonzero(np.isfinite(self._limits.force))
        limits, self._bounded = self._limits.force[bounded], bounded
        self._forces: PyFunctionConstraint | None = None
        if not bounded.size:
            return

        ones = np.ones(self._segment.size * bounded.size)
        constraint = self._program.AddConstraint(
            lambda x: (self._values(x)[:, bounded] / limits).ravel(), -ones, ones, self._unknowns
        )
        self._forces = constraint.evaluator()
        self._forces.SetGradientSparsityPattern(self._pattern(bounded.size))

    def _add_impulses(self) -> None:
        """Impulses within their limits: |tau| <= s at every instant, and the sum of s limited."""
        limited = np.flatnonzero(np.isfinite(self._limits.impulse))
        if not limited.size:
            return
        sizes = self._program.NewContinuousVariables(self._segment.size * limited.size, "size")
        inner, times = self._unknowns.size, self._times.size
        weights = self._weights @ self._lengths_by

        def room(x: np.ndarray) -> np.ndarray:
            force, given = self._values(x)[:, limited].ravel(), x[inner:]
            return np.concatenate([given - force, given + force])

        none = np.zeros(2 * sizes.size)
        constraint = self._program.AddConstraint(
            room, none, none + np.inf, np.r_[self._unknowns, sizes]
        )
        upper = self._pattern(limited.size)
        lower = [(row + sizes.size, column) for row, column in upper]
        own = [(row, inner + row % sizes.size) for row in range(none.size)]
        constraint.evaluator().SetGradientSparsityPattern(upper + lower + own)
        for k, i in enumerate(limited):
            self._program.AddConstraint(
                lambda x: np.array([x[:times] @ (weights.T @ x[times:])]),
                [0.0], [(1.0 - _SUM) * float(self._limits.impulse[i])],
                np.r_[self._times, sizes[k :: limited.size]],
            )  # fmt: skip

    def _add_turn(self) -> None:
        """The base turns no further: by its control points, in whose hull the curve is, or as
        momentum takes it.
        """
        if not self._dynamics.turns:
            for point in self._points.reshape(self._count, -1)[1:, :3]:
                self._program.AddQuadraticConstraint(
                    2.0 * np.eye(3), np.zeros(3), -np.inf, self._largest_turn**2, point
                )
            return

        def square(x: np.ndarray) -> np.ndarray:
            vector, turning = self._turned(x)
            slope = 2.0 * np.einsum("ki,kix->kx", vector, turning)
            return self._lifted(x, np.square(vector).sum(axis=1), slope) / self._allowed_turn**2

        ones = np.ones(self._segment.size - 1)
        self._turn = self._program.AddConstraint(
            square, -np.inf * ones, ones, self._unknowns
        ).evaluator()

    def _turned(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the base's rotation vector at every instant but the first, and its small rotations
        by the unknowns.
        """
        values, by = self._evaluate(x)
        w, alpha = np.split(values[:, self._size : self._size + 6], 2, axis=1)
        slope = by[:, self._size : self._size + 6]
        step = np.zeros((len(self._steps), self._unknowns.size))
        step[:, self._points.size :] = self._steps @ self._lengths_by
        rotation, turning = turned(w, alpha, slope, self._steps @ self._last_lengths, step)
        return Rotation.from_matrix(rotation[1:]).as_rotvec(), turning[1:]

    def _turn_of(self, unknowns: np.ndarray) -> float:
        """Rotation of the base by the joints, rad; zero without a limit on it."""
        if self._turn is None:
            return 0.0
        vector, _ = self._turned(unknowns)
        return float(np.linalg.norm(vector, axis=1).max())

    def _allow_turn(self, allowed: float) -> None:
        if self._turn is not None:
            self._allowed_turn = min(allowed, np.pi)
            bound = np.full(self._turn.num_constraints(), 1.0 if np.isfinite(allowed) else np.inf)
            self._turn.set_bounds(-np.inf * bound, bound)

    def tighten(self, used: np.ndarray, turn: float, short: float, *, where: bool) -> None:
        """Tighten what a solution exceeds between instants.

        Args: shares of the force limits in use (m, size), at equally many instants of every third
        of a segment; the share of the largest turn; by how much parts are too near, m; whether
        forces are tightened where they exceed their limits alone.
        """
        parts = len(self._steps)
        inner = len(used) // parts
        most = np.maximum(used[:-1].reshape(parts, inner, -1).max(axis=1), used[inner::inner])
        around = np.maximum(np.pad(most, ((1, 0), (0, 0))), np.pad(most, ((0, 1), (0, 0))))
        around = around if where else np.full_like(around, around.max())
        self._share /= np.where(around > 1.0, around + _LESS, 1.0)
        if self._forces is not None:
            bound = self._share[:, self._bounded].ravel()
            self._forces.set_bounds(-bound, bound)
        if self._turn is not None and turn > 1.0:
            self._largest_turn /= turn + _LESS
        if self._clearance is not None and short > 0.0:
            self._kept += short + _ROOM

    def _add_clearance(self, clearance: Clearance) -> None:
        """Parts keep their distance; this depends on the joints alone."""
        joints = slice(NUM_BASE_POSITIONS - clearance.plant.num_positions(), None)
        q = np.zeros(clearance.plant.num_positions())
        q[0] = 1.0

        def nearness(x: np.ndarray) -> np.ndarray:
            values, by = self._evaluate(x)
            found, slope = np.empty(len(values)), np.zeros_like(values[:, joints])
            for k, row in enumerate(values[:, joints]):
                q[joints] = row
                distance, rate = _distances(clearance, q, self._kept + _INFLUENCE)
                found[k], weight = _nearness(distance, self._kept)
                slope[k] = weight @ rate[:, joints]
            return self._lifted(x, found, np.einsum("kj,kjx->kx", slope, by[:, joints]))

        ones = np.ones(self._segment.size)
        constraint = self._program.AddConstraint(nearness, -np.inf * ones, ones, self._unknowns)
        constraint.evaluator().SetGradientSparsityPattern(self._pattern(1))

    def _pattern(self, rows: int) -> list[tuple[int, int]]:
        """Pattern of possible nonzeros in the gradient of ``rows`` values at every instant."""
        size = self._points.size
        return [
            (k * rows + row, int(column))
            for k, columns in enumerate(self._columns)
            for row in range(rows)
            for column in np.r_[columns[columns < size], size, columns[columns >= size] + 1]
            if column < self._unknowns.size
        ]

    def _lifted(self, x: np.ndarray, values: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return values, with their gradient ``by`` the unknowns if x has derivatives, which are
        those by itself; x begins with the unknowns.
        """
        if x.dtype != object:
            return values
        gradient = np.zeros((values.size, x.size))
        gradient[:, : self._unknowns.size] = by.reshape(values.size, -1)
        return InitializeAutoDiff(values.reshape(-1, 1), gradient).reshape(values.shape)

    def _values(self, x: np.ndarray) -> np.ndarray:
        """Return the values of ``_evaluate``, with their gradient if x has derivatives."""
        return self._lifted(x, *self._evaluate(x))

    def _evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (instants, rows) for [P, h] and their gradient (instants, rows, unknowns).

        The rows are force, what else the dynamics give, and z. x begins with the unknowns.
        """
        given = ExtractValue(x).ravel() if x.dtype == object else x
        unknowns = given[: self._unknowns.size]
        if self._cache[0] == (key := unknowns.tobytes()):
            return self._cache[1:]
        count, size, calc = self._segment.size, self._size, self._dynamics.calc
        points, times = np.split(unknowns, [self._points.size])
        self._last_lengths = self._lengths_by @ times
        basis, change = self._basis_at(self._last_lengths)
        points = points.reshape(-1, size)[self._near]
        motion = np.einsum("oan,nas->osn", basis, points)
        found, by = complex_step(lambda z, *rates: np.vstack([calc(z, *rates), z]), motion)
        by_points = np.einsum("omsn,oan->nasm", by, basis).reshape(count, -1, len(found))
        by_lengths = np.einsum("omsn,oadn,nas->ndm", by, change, points, optimize=True)
        both = np.zeros((count, len(found), unknowns.size))
        rows = np.arange(count)[:, None]
        both[rows, :, self._columns] = np.concatenate([by_points, by_lengths], axis=1)
        by_points, by_lengths = np.split(both[..., :-1], [self._points.size], axis=2)
        gradient = np.concatenate([by_points, by_lengths @ self._lengths_by], axis=2)
        self._cache = key, found.T, gradient
        self.evaluations += 1
        if time.monotonic() - self._reported > 1.0:
            self._reported = time.monotonic()
            self._report(self.evaluations, float(self._last_lengths.sum()), self.worst(unknowns))
        return self._cache[1:]

    def worst(self, unknowns: np.ndarray) -> float:
        """Return the largest share of a force limit in use."""
        force = self._evaluate(unknowns)[0][:, : self._size]
        return float(np.max(np.abs(force) / self._limits.force))

    def _basis_at(self, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        window = np.pad(lengths, 2)[self._segment[:, None] + np.arange(5)]
        return spline_basis(window.T, self._within)

    def _cost(self, x: np.ndarray) -> np.ndarray:
        """Weighed duration and integral of the squared force."""
        own, effort = self._planning.time_weight, self._planning.effort_weight
        square = np.square(self._values(x)[:, : self._size]).sum(axis=1)
        lengths = self._lengths_by @ x[self._points.size :]
        return (own * lengths.sum() + effort * (self._weights @ lengths) @ square) / self._scale

    def guess(self, curve: Callable[[np.ndarray], np.ndarray], duration: float) -> np.ndarray:
        """Unknowns of the spline with even segments nearest to z(t / T), (instants, size)."""
        segments = len(self._lengths_by)
        even = self._lengths_by[:, 0]
        basis = np.zeros((self._segment.size, self._count))
        np.put_along_axis(basis, self._near, self._basis_at(even)[0][0].T, axis=1)
        wanted = curve((self._segment + self._within) / segments)
        points = np.linalg.lstsq(basis, wanted, rcond=None)[0]
        return np.r_[points.ravel(), duration, 0.0 * even]

    def solve(self, guess: np.ndarray, *, moving: bool) -> tuple[np.ndarray, str]:
        """Return the best unknowns found, with the solver's message; knots keep their shares of
        the duration unless they are ``moving``.

        Where joints turn the base further than they may, a limit on it at once is not found to be
        possible. So the first solution is without, and the limit comes nearer step by step.
        """
        first = np.zeros(self._program.num_vars())
        first[: guess.size] = guess
        limited = np.flatnonzero(np.isfinite(self._limits.impulse))
        first[guess.size :] = np.abs(self._evaluate(guess)[0][:, limited]).ravel()
        self._scale = 1.0
        self._scale = max(float(self._cost(guess)), 1e-12)
        if not self._dynamics.turns and self._planning.end_rate > 0.0:
            self._limit_end(guess[: self._points.size].reshape(self._count, -1)[-1, :3])
        fixed = guess[self._points.size + 1 :]
        room = np.inf if moving else 0.0
        self._knots.evaluator().set_bounds(fixed - room, fixed + room)
        turn = self._turn_of(guess)
        limit = self._largest_turn if self._turn is not None else np.inf
        allowed = limit if _LESS_TURN * turn <= limit else np.inf
        while True:
            self._allow_turn(allowed)
            first, said = self._solve_once(first, _MOVING if moving else _FIXED)
            turn = self._turn_of(first[: guess.size])
            if allowed == limit or turn > allowed * (1.0 + _TURN_ROOM):
                return first[: guess.size], said
            allowed = max(min(allowed, _LESS_TURN * turn), limit)

    def _solve_once(self, first: np.ndarray, tolerance: float) -> tuple[np.ndarray, str]:
        chosen, options = SnoptSolver(), SolverOptions()
        for key, value in (_OPTIONS | {"Major optimality tolerance": tolerance}).items():
            options.SetOption(chosen.solver_id(), key, value)
        self._best, self._least = first, float("inf")
        self._begun = self._gained = self.evaluations
        self._mark = self._least
        try:
            result = chosen.Solve(self._program, first, options)
        except RuntimeError as error:
            if _NoGainError.__name__ not in str(error):
                raise
            return self._best, "no gain"
        return self._best, result.get_solution_result().name.removeprefix("k")

    def _watch(self, x: np.ndarray) -> None:
        """Keep the best of the solver's iterates, and stop the solver without further
        improvement.
        """
        beyond = 0.0
        program = self._program
        for binding in program.generic_constraints() + program.quadratic_constraints():
            value, evaluator = program.EvalBinding(binding, x), binding.evaluator()
            sides = np.r_[value - evaluator.upper_bound(), evaluator.lower_bound() - value]
            beyond = max(beyond, float(np.max(sides)))
        merit = float(self._cost(x[: self._unknowns.size])) * (1.0 + _PENALTY * beyond)
        if merit < self._least:
            self._best, self._least = x.copy(), merit
        if merit < self._mark * (1.0 - _GAIN):
            self._mark, self._gained = merit, self.evaluations
        is_stuck = self.evaluations > min(self._gained + _PATIENCE, self._begun + _MOST)
        if is_stuck or self._is_over():
            raise _NoGainError


def spline_basis(window: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the four cubic B-splines of the middle one of five segments, with two derivatives.

    Args:
      window: lengths of the segments (5, n), s; zero beyond the ends of the spline.
      within: where in the middle one, (n,), 0 to 1.

    Returns: values and derivatives by time (3, 4, n), and all of these by the lengths (3, 4, 5, n).
    """
    place = np.broadcast_to(within, window.shape)
    lengths = [(0, i) for i in range(len(window))]
    given = np.array([window, place, np.zeros_like(window)])
    found, by = complex_step(_splines, given, lengths)
    return found.reshape(3, DEGREE + 1, -1), by[0].reshape(3, DEGREE + 1, len(window), -1)


def _splines(window: np.ndarray, place: np.ndarray, _: np.ndarray) -> np.ndarray:
    """Return values and derivatives (12, n), by the recursion of Cox and de Boor."""
    own, within = window[2], place[0]
    left = np.cumsum([within * own, window[1], window[0]], axis=0)
    right = np.cumsum([(1.0 - within) * own, window[3], window[4]], axis=0)
    found = np.ones((1, 1, own.size))
    for degree in range(1, DEGREE + 1):
        before, after = left[degree - 1 :: -1], right[:degree]
        shares = found / (before + after)
        lower, upper = (np.pad(shares, ((0, 0), side, (0, 0))) for side in ((1, 0), (0, 1)))
        value = np.pad(before, ((1, 0), (0, 0))) * lower[0]
        value = value + np.pad(after, ((0, 1), (0, 0))) * upper[0]
        found = np.concatenate([value[None], degree * (lower - upper)])
    return found[:3].reshape(-1, own.size)


def _distances(clearance: Clearance, q: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances (n) below ``most`` (m) in a configuration, and their derivatives (n, nv)
    along the plant's velocities.
    """
    plant, context = clearance.plant, clearance.plant_context
    found, rates = list[float](), [np.empty((0, plant.num_velocities()))]
    for distance, points, bodies in clearance.within(q, most):
        first, second = (
            plant.CalcJacobianTranslationalVelocity(
                context, JacobianWrtVariable.kV, body.body_frame(),
                body.EvalPoseInWorld(context).inverse() @ point,
                plant.world_frame(), plant.world_frame(),
            )
            for body, point in zip(bodies, points, strict=True)
        )  # fmt: skip
        found.append(distance)
        away = (points[1] - points[0]) / (distance or np.inf)
        rates.append((away @ (second - first))[None])
    return np.array(found), np.vstack(rates)


def _nearness(distance: np.ndarray, kept: float) -> tuple[float, np.ndarray]:
    """How near parts are: 1 or less where all distances (n, m) are ``kept``, 0 from _INFLUENCE
    beyond it on; and its derivatives (n).
    """
    x = (kept + _INFLUENCE - distance) / _INFLUENCE  # 1 at the bound
    each, slope = np.where(x < 1.0, x * x, 2.0 * x - 1.0), 2.0 * np.minimum(x, 1.0)
    most = each.max(initial=0.0)
    power = np.exp(_SHARP * (each - most))
    total = np.exp(-_SHARP * most) * (1.0 - len(each)) + power.sum()
    return most + np.log(total) / _SHARP, -power / total * slope / _INFLUENCE
