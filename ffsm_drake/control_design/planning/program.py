"""The optimal control problem as a mathematical program over a spline's control points.

Unknown are the control points P of z (``systems.plan``) and the duration T. Positions, rates and
their limits are linear in these, and a spline stays within the hull of its control points, so that
limits on those are kept at all times. Force and clearance are looked at in a few instants of every
segment.
"""

import time
from collections.abc import Callable

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import BsplineBasis, KnotVectorType
from pydrake.multibody.inverse_kinematics import MinimumDistanceLowerBoundConstraint
from pydrake.solvers import (
    MathematicalProgram,
    MathematicalProgramResult,
    PyFunctionConstraint,
    SnoptSolver,
    SolverOptions,
)
from pydrake.trajectories import BsplineTrajectory

from ffsm_drake.control_design.planning.free_dynamics import FreeDynamics, rotation_vector, turned
from ffsm_drake.control_design.planning.limits import MotionLimits
from ffsm_drake.scenario import Planning
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.inverse_dynamics import InverseDynamics
from ffsm_drake.systems.plan import DEGREE

_INFLUENCE = 0.1  # m beyond the clearance; nearer parts are seen by the solver
_INSTANTS = 3  # in which force and clearance are looked at, per segment
_ROOM = 0.002  # m beyond the clearance, for what happens between these instants
_SUM = 0.005  # share of an impulse that the sum over these instants may miss
_LESS_TURN, _TURN_ROOM = 0.85, 1e-3  # of the base's turn, from one solution to the next; relative
_OPTIONS = {
    "Major iterations limit": 1000,
    "Iterations limit": 100_000,
    "Major optimality tolerance": 1e-4,
    # it would forget after 10, and take thousands of iterations to least effort
    "Hessian updates": 200,
}


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
        largest_turn: float | None,
        report: Callable[[int, float, float], None],
    ) -> None:
        """Args: of the problem, with ``limits`` of z alone; z and its rate at the start, z at the
        end (None: anywhere); durations, s; distances to keep, and how much, m; the base's largest
        turn, rad; ``report`` is called with evaluations, duration and the worst force relative to
        its limit.
        """
        self._dynamics, self._planning, self._limits = dynamics, planning, limits
        self._report, self._reported = report, time.monotonic()
        self.evaluations = 0
        size, count = start.size, planning.segments + DEGREE
        self._size, self._count = size, count
        self.share = np.linspace(0.0, 1.0, _INSTANTS * planning.segments + 1)  # of T
        # of z and its derivatives by t/T, (3, instants, count)
        self.basis = _basis(planning.segments, self.share)
        touched = (self.basis != 0.0).any(axis=0)
        self._cache: tuple[bytes, np.ndarray, np.ndarray] = (b"", np.empty(0), np.empty(0))

        program = self._program = MathematicalProgram()
        self._points = program.NewContinuousVariables(count * size, "point")
        self._duration = program.NewContinuousVariables(1, "duration")
        points, duration = self._points.reshape(count, size), self._duration
        # Effort alone takes all the time there is.
        self.durations = min(shortest, longest) if planning.time_weight > 0.0 else longest, longest
        program.AddBoundingBoxConstraint(*self.durations, duration)
        program.AddBoundingBoxConstraint(start, start, points[0])
        # z'(0) T = per_segment (P_1 - P_0), likewise at the end
        per_segment = planning.segments * DEGREE
        for i in range(size):
            program.AddLinearEqualityConstraint(
                np.array([[-per_segment, per_segment, -rate[i]]]),
                [0.0],
                np.r_[points[:2, i], duration],
            )
            if planning.end_rate > 0.0:
                ends = np.array(
                    [[-per_segment, per_segment, sign * planning.end_rate] for sign in (-1.0, 1.0)]
                )
                program.AddLinearConstraint(
                    ends, [-np.inf, 0.0], [0.0, np.inf], np.r_[points[-2:, i], duration]
                )
            else:
                program.AddLinearEqualityConstraint(np.array([[-1.0, 1.0]]), [0.0], points[-2:, i])
            if np.isfinite([limits.lower[i], limits.upper[i]]).any():
                program.AddBoundingBoxConstraint(limits.lower[i], limits.upper[i], points[:, i])
            if np.isfinite(limits.rate[i]):
                self._limit_rate(points[:, i], duration, float(limits.rate[i]))
        if goal is not None:
            program.AddBoundingBoxConstraint(goal, goal, points[-1])
        self._turn: PyFunctionConstraint | None = None
        self._largest_turn = self._allowed_turn = np.inf if largest_turn is None else largest_turn
        if largest_turn is not None and dynamics.turns:
            self._add_turn()
        elif largest_turn is not None:  # of the control points, in whose hull the curve is
            for point in points[1:, :3]:
                program.AddQuadraticConstraint(
                    2.0 * np.eye(3), np.zeros(3), -np.inf, largest_turn**2, point
                )

        self._add_forces(touched)
        self._clearance: Clearance | None = None
        if clearance is not None and clearance.pairs:
            self._add_clearance(clearance, distance, touched)
        self._scale = 1.0  # of the cost, which solvers like to be about 1
        program.AddCost(self._cost, vars=np.r_[self._points, duration])

    def _limit_rate(self, points: np.ndarray, duration: np.ndarray, limit: float) -> None:
        """Keep the control points of the rate, which are differences of those of z, within a
        limit.
        """
        segments = self._planning.segments
        knots = np.r_[np.zeros(DEGREE), np.linspace(0.0, 1.0, segments + 1), np.ones(DEGREE)]
        for k in range(points.size - 1):
            factor = DEGREE / (knots[k + 1 + DEGREE] - knots[k + 1])
            rows = np.array([[-factor, factor, -limit], [-factor, factor, limit]])
            self._program.AddLinearConstraint(
                rows, [-np.inf, 0.0], [0.0, np.inf], np.r_[points[k : k + 2], duration]
            )

    def _add_forces(self, touched: np.ndarray) -> None:
        """Forces within their limits, and their impulses."""
        instants = self.share.size
        self._forces: PyFunctionConstraint | None = None
        allowed = self._limits.force * (1.0 - self._planning.reserve)
        bounded = np.flatnonzero(np.isfinite(allowed))
        unknowns = np.r_[self._points, self._duration]
        if bounded.size:
            scale = allowed[bounded]

            def of_limit(force: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                slope = gradient[:, bounded] / scale[:, None]
                return (force[:, bounded] / scale).ravel(), slope.reshape(-1, unknowns.size)

            def relative(x: np.ndarray) -> np.ndarray:
                return self._with_gradient(x, of_limit)

            ones = np.ones(bounded.size * instants)
            constraint = self._program.AddConstraint(relative, -ones, ones, unknowns)
            constraint.evaluator().SetGradientSparsityPattern(self._pattern(touched, bounded.size))
            self._forces = constraint.evaluator()
        limited = np.flatnonzero(np.isfinite(self._limits.impulse))
        if limited.size == 0:
            return
        # |tau| <= s in every instant, and T times the trapezoidal sum of s within the limit.
        sizes = self._program.NewContinuousVariables(instants * limited.size, "size")

        def room(x: np.ndarray) -> np.ndarray:
            inner = unknowns.size

            def both(force: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
                value, slope = force[:, limited].ravel(), gradient[:, limited].reshape(-1, inner)
                given = ExtractValue(x).ravel()[inner:] if x.dtype == object else x[inner:]
                identity = np.eye(value.size)
                return np.r_[given - value, given + value], np.block(
                    [[-slope, identity], [slope, identity]]
                )

            return self._with_gradient(x, both)

        none = np.zeros(2 * sizes.size)
        constraint = self._program.AddConstraint(room, none, none + np.inf, np.r_[unknowns, sizes])
        pattern = []
        for row, column in self._pattern(touched, limited.size):
            pattern += [(row, column), (row + sizes.size, column)]
        own = [(row, unknowns.size + row % sizes.size) for row in range(2 * sizes.size)]
        constraint.evaluator().SetGradientSparsityPattern(pattern + own)
        weights = np.full(instants, 1.0 / (instants - 1))
        weights[[0, -1]] *= 0.5
        for k in range(limited.size):
            self._program.AddConstraint(
                lambda x: np.array([x[0] * weights.dot(x[1:])]),
                [0.0], [(1.0 - _SUM) * float(self._limits.impulse[limited[k]])],
                np.r_[self._duration, sizes[k :: limited.size]],
            )  # fmt: skip

    def _add_turn(self) -> None:
        """The base turns no further, as momentum takes it: that depends on the path of the joints,
        not on how fast.
        """
        unknowns = np.r_[self._points, self._duration]

        def square(x: np.ndarray) -> np.ndarray:
            differentiated = x.dtype == object
            vector, turning = self._turned(ExtractValue(x).ravel() if differentiated else x)
            value = (vector**2).sum(axis=1) / self._allowed_turn**2
            if not differentiated:
                return value
            gradient = 2.0 / self._allowed_turn**2 * np.einsum("ki,kix->kx", vector, turning)
            return InitializeAutoDiff(value[:, None], gradient @ ExtractGradient(x))

        ones = np.ones(self.share.size - 1)
        self._turn = self._program.AddConstraint(square, -np.inf * ones, ones, unknowns).evaluator()

    def _turned(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The base's rotation vector in every instant but the first, and its small rotations by the
        unknowns.
        """
        self._evaluate_all(unknowns)
        found, slope = (part[:, self._size :] for part in self._cache[1:])
        step = float(unknowns[-1]) / (self.share.size - 1)
        rotation, turning = turned(found[:, :3], found[:, 3:], slope, step)
        turning[..., -1] = 0.0  # but for rounding
        return rotation_vector(rotation[1:]), turning[1:]

    def _turn_of(self, unknowns: np.ndarray) -> float:
        """How far the joints turn the base, rad; zero where nothing limits it."""
        return (
            0.0
            if self._turn is None
            else float(np.linalg.norm(self._turned(unknowns)[0], axis=1).max())
        )

    def _allow_turn(self, allowed: float) -> None:
        if self._turn is not None:
            self._allowed_turn = min(allowed, np.pi)
            bound = np.full(self._turn.num_constraints(), 1.0 if np.isfinite(allowed) else np.inf)
            self._turn.set_bounds(-np.inf * bound, bound)

    def tighten(self, share: float, turn: float | None) -> None:
        """Keep forces below this share of what they were allowed at first, the base's turn below
        this, rad.
        """
        if self._turn is not None and turn is not None:
            self._largest_turn = turn
        if self._forces is not None:
            bound = np.full(self._forces.num_constraints(), share)
            self._forces.set_bounds(-bound, bound)

    def keep_off(self, further: float) -> None:
        """Keep parts further apart than was asked at first, m."""
        if self._clearance is not None:
            self._distance = MinimumDistanceLowerBoundConstraint(
                plant=self._clearance.plant, bound=self._kept + further,
                plant_context=self._clearance.plant_context, influence_distance_offset=_INFLUENCE,
            )  # fmt: skip

    def _add_clearance(self, clearance: Clearance, distance: float, touched: np.ndarray) -> None:
        """Parts keep their distance; this depends on the joints alone."""
        self._clearance, self._kept = clearance, distance + _ROOM
        self.keep_off(0.0)
        size, count = self._size, self._count
        first = np.zeros(clearance.plant.num_positions())
        joints = np.arange(size - (first.size - NUM_BASE_POSITIONS), size)
        first[0] = 1.0
        rows = self.basis[0]
        columns = (np.arange(count)[:, None] * size + joints).ravel()

        def nearness(x: np.ndarray) -> np.ndarray:
            points = (ExtractValue(x).ravel() if x.dtype == object else x).reshape(
                count, joints.size
            )
            value, gradient = (
                np.empty(self.share.size),
                np.zeros((self.share.size, count, joints.size)),
            )
            q = first.copy()
            for k, row in enumerate(rows):
                q[NUM_BASE_POSITIONS:] = row @ points
                if x.dtype != object:
                    value[k] = self._distance.Eval(q)[0]
                    continue
                seeded = InitializeAutoDiff(q).ravel()
                found = self._distance.Eval(seeded)
                value[k] = ExtractValue(found)[0, 0]
                slope = ExtractGradient(found)
                if slope.size:
                    gradient[k] = row[:, None] * slope[0, NUM_BASE_POSITIONS:]
            if x.dtype != object:
                return value
            return InitializeAutoDiff(
                value[:, None], gradient.reshape(value.size, -1) @ ExtractGradient(x)
            )

        ones = np.ones(self.share.size)
        constraint = self._program.AddConstraint(
            nearness, -np.inf * ones, ones, self._points[columns]
        )
        pattern = [
            (k, int(a * joints.size + j))
            for k in range(self.share.size)
            for a in np.flatnonzero(touched[k])
            for j in range(joints.size)
        ]
        constraint.evaluator().SetGradientSparsityPattern(pattern)

    def _pattern(self, touched: np.ndarray, rows: int) -> list[tuple[int, int]]:
        """Where the gradient of ``rows`` forces in every instant can differ from zero."""
        size = self._size
        return [
            (k * rows + row, column)
            for k in range(self.share.size)
            for row in range(rows)
            for column in (
                *(int(a * size + j) for a in np.flatnonzero(touched[k]) for j in range(size)),
                self._count * size,
            )
        ]

    def _with_gradient(
        self,
        x: np.ndarray,
        chosen: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
    ) -> np.ndarray:
        """What is ``chosen`` of force and gradient, with derivatives where x carries some."""
        differentiated = x.dtype == object
        values = ExtractValue(x).ravel() if differentiated else x
        result, gradient = chosen(*self.evaluate(values[: self._points.size + 1]))
        if not differentiated:
            return result
        return InitializeAutoDiff(result[:, None], gradient @ ExtractGradient(x))

    def evaluate(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces (instants, size) of [P, T], and their gradient (instants, size, unknowns)."""
        self._evaluate_all(unknowns)
        return self._cache[1][:, : self._size], self._cache[2][:, : self._size]

    def _evaluate_all(self, unknowns: np.ndarray) -> None:
        """All that the dynamics give, into the cache."""
        key = unknowns.tobytes()
        if self._cache[0] == key:
            return
        points, duration = unknowns[:-1].reshape(self._count, self._size), float(unknowns[-1])
        z, rate, acceleration = (
            (rows @ points).T / duration**order for order, rows in enumerate(self.basis)
        )
        found, by = self._dynamics.linearized(z, rate, acceleration)
        gradient = np.zeros((self.share.size, len(found), unknowns.size))
        for order in range(3):
            part = np.einsum("ijk,ka->kiaj", by[order], self.basis[order]) / duration**order
            gradient[:, :, :-1] += part.reshape(self.share.size, len(found), -1)
        gradient[:, :, -1] = (
            -(
                np.einsum("ijk,jk->ki", by[1], rate)
                + 2.0 * np.einsum("ijk,jk->ki", by[2], acceleration)
            )
            / duration
        )
        self._cache = (key, found.T, gradient)
        self.evaluations += 1
        if time.monotonic() - self._reported > 1.0:
            self._reported = time.monotonic()
            worst = float(np.max(np.abs(found.T[:, : self._size]) / self._limits.force))
            self._report(self.evaluations, duration, worst)

    def _cost(self, x: np.ndarray) -> np.ndarray:
        """Weighed duration and integral of the squared force."""
        planning = self._planning
        weights = np.full(self.share.size, 1.0 / (self.share.size - 1))
        weights[[0, -1]] *= 0.5

        def squared(force: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            duration = float((ExtractValue(x).ravel() if x.dtype == object else x)[-1])
            total = weights @ (force**2).sum(axis=1)
            slope = (
                planning.effort_weight
                * 2.0
                * duration
                * np.einsum("k,ki,kix->x", weights, force, gradient)
            )
            slope[-1] += planning.effort_weight * total + planning.time_weight
            cost = duration * (planning.time_weight + planning.effort_weight * total)
            return np.array([cost]) / self._scale, slope[None] / self._scale

        result = self._with_gradient(x, squared)
        return result.item() if result.dtype == object else result[0]

    def guess(self, curve: Callable[[np.ndarray], np.ndarray], duration: float) -> np.ndarray:
        """Unknowns of the spline nearest to z(t / T), (instants, nv)."""
        points = np.linalg.lstsq(self.basis[0], curve(self.share), rcond=None)[0]
        return np.r_[points.ravel(), duration]

    def solve(self, guess: np.ndarray) -> tuple[MathematicalProgramResult, np.ndarray, float]:
        """The solver's result, control points (count, size) and duration, s.

        Where joints turn the base further than they may, a limit on it at once is not found to be
        possible. So the first solution is without, and the limit comes nearer step by step.
        """
        unknowns = np.r_[self._points, self._duration]
        first = np.zeros(self._program.num_vars())
        first[: guess.size] = guess
        if first.size > guess.size:
            limited = np.flatnonzero(np.isfinite(self._limits.impulse))
            first[guess.size :] = np.abs(self.evaluate(guess)[0][:, limited]).ravel()
        chosen, options = SnoptSolver(), SolverOptions()
        for key, value in _OPTIONS.items():
            options.SetOption(chosen.solver_id(), key, value)
        self._scale = 1.0
        self._scale = max(float(self._cost(guess)), 1e-12)
        turn = self._turn_of(guess)
        allowed = self._largest_turn if _LESS_TURN * turn <= self._largest_turn else np.inf
        while True:
            self._allow_turn(allowed)
            result = chosen.Solve(self._program, first, options)
            turn = self._turn_of(result.GetSolution(unknowns))
            if (
                self._turn is None
                or allowed == self._largest_turn
                or turn > allowed * (1.0 + _TURN_ROOM)
            ):
                break
            first, allowed = (
                result.get_x_val(),
                max(min(allowed, _LESS_TURN * turn), self._largest_turn),
            )
        points = result.GetSolution(self._points).reshape(self._count, self._size)
        return result, points, float(result.GetSolution(self._duration)[0])


def _basis(segments: int, share: np.ndarray) -> np.ndarray:
    """The spline's basis functions and their first two derivatives at ``share`` of its length, (3,
    n, count).
    """
    count = segments + DEGREE
    basis = BsplineBasis(DEGREE + 1, count, KnotVectorType.kClampedUniform, 0.0, 1.0)
    curve = BsplineTrajectory(basis, [column[:, None] for column in np.eye(count)])
    found = []
    for _ in range(3):
        found.append(curve.vector_values(share).T)
        curve = curve.MakeDerivative()
    return np.array(found)
