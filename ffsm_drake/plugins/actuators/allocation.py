"""Allocation: thruster forces for a wrench on the base at the least propellant.

    minimise c . f   over   W f = w,   0 <= f <= F

W (6, n) holds the wrench of each thruster's unit force, c the cost of a unit of its impulse.
Without the upper bounds the dual is: maximise w . y over W' y <= c. Its finitely many vertices y
are found once. The thrusters of a cheapest solution are those with a bound touched by all optimal
vertices of the wrench. The least-squares solution among them is used: equivalent thrusters share
equally, so their pulses coincide and their torques cancel. If it has a negative force, a solution
with six thrusters replaces it, f = B^-1 w with a basis B of a vertex. The linear program itself is
solved only if a force exceeds its thruster's limit.
"""

import functools
import itertools
from typing import Any

import numpy as np
from pydrake.solvers import ClpSolver, MathematicalProgram

from ffsm_drake.common.choice import is_known
from ffsm_drake.plugins.actuators.simplex import least_cost, vertex_at

_SMALLEST = 1e-9  # least determinant of a basis relative to the lengths of its columns
_SLACK = 1e-9  # relative; tolerance of a bound
# Relative perturbation of the costs, to select one of equally cheap forces.
_DISTINCT = 1e-7
_DISTINCT_PROGRAM = 1e-4  # in the linear program; its solver ignores differences of 1e-7
_TOUCHES = 1e-10  # relative to the largest cost
# On symbols: added to the diagonal of the normal equations, relative to its sum. Each refinement
# leaves about a share of 1e-4 of the error.
_SHIFT = 1e-12
_REFINEMENTS = 4


class Allocation:
    """Least propellant of thrusters that together can give any wrench."""

    def __init__(self, wrenches: np.ndarray, *, largest: np.ndarray, cost: np.ndarray) -> None:
        """Args:
          wrenches: W (6, n), m and 1.
          largest: F (n), N.
          cost: c (n), in any unit.

        Raises ValueError: some wrench cannot be given; its text names it.
        """
        lost = lost_direction(wrenches)
        if lost is not None:
            raise ValueError(_in_words(lost))
        count = largest.size
        self._wrenches, self._largest = wrenches, largest
        count, cost = largest.size, cost / cost.max()
        bases = np.array(list(itertools.combinations(range(count), 6)))
        matrices = np.moveaxis(wrenches[:, bases], 1, 0)
        lengths = np.linalg.norm(matrices, axis=1).prod(axis=1)
        regular = np.abs(np.linalg.det(matrices)) > _SMALLEST * lengths
        bases, inverses = bases[regular], np.linalg.inv(matrices[regular])

        def vertices(cost: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            prices = np.einsum("bij,bi->bj", inverses, cost[bases])
            return prices, (prices @ wrenches <= cost + _TOUCHES).all(axis=1)

        prices, optimal = vertices(cost)
        if not optimal.any():  # too nearly degenerate
            raise ValueError(_in_words(np.linalg.svd(wrenches)[0][:, -1]))
        self._prices = np.unique(prices[optimal].round(9), axis=0)
        self._touches = self._prices @ wrenches > cost - 100.0 * _TOUCHES
        # least squares by the thrusters that may fire, as they come up
        self._shares = dict[bytes, np.ndarray]()
        # squares: of an even sequence the sums are alike again
        spread = np.modf(0.618034 * np.arange(count) ** 2)[0]
        self._distinct_cost = cost * (1.0 + _DISTINCT * spread)
        _, optimal = vertices(self._distinct_cost)
        self._program_cost = cost * (1.0 + _DISTINCT_PROGRAM * spread)
        self._bases, self._inverses = bases[optimal], inverses[optimal].reshape(-1, 6)

    def solve(self, wrench: np.ndarray, leak: np.ndarray | float = 0.0) -> tuple[np.ndarray, Any]:
        """The forces (n, N) for the largest feasible part of a wrench, and that part, 0 to 1.

        Args:
          wrench: (6), N m and N.
          leak: (6), the wrench already present, for example of a thruster stuck on; the other
            thrusters must be able to cancel it.
        """
        if not is_known(wrench):
            return self._solve_traced(wrench, np.zeros(6) + leak)
        left, bound, given = wrench - leak, self._largest * (1.0 + _SLACK), 1.0
        least = -_SLACK * (1.0 + np.abs(left).max())
        forces = self._share_of(left).dot(left)
        if forces.min() < least:
            forces = self._of_a_basis(left)
        if not (forces.min() >= least and (forces <= bound).all()):
            forces, given = self._solve_within_bounds(wrench, leak)
        return np.maximum(forces, 0.0), given

    def _may_fire(self, wrench: Any) -> Any:
        """The thrusters (n) whose bound is touched by every best vertex of a wrench (6)."""
        worth = self._prices @ wrench
        best = worth.max()
        is_worse = worth < best - _SLACK * (1.0 + best)
        return (self._touches | is_worse[:, None]).all(axis=0)

    def _share_of(self, wrench: np.ndarray) -> np.ndarray:
        """The map (n, 6) of least squares for a wrench (6)."""
        may_fire = self._may_fire(wrench)
        key = may_fire.tobytes()
        if key not in self._shares:
            self._shares[key] = np.linalg.pinv(self._wrenches * may_fire, rcond=1e-9)
        return self._shares[key]

    def _solve_traced(self, wrench: Any, leak: np.ndarray) -> tuple[Any, Any]:
        """``solve`` for symbols (6), without branches and tables: the same forces but for
        rounding.
        """
        wrenches, largest, left = self._wrenches, self._largest, wrench - leak
        used = np.where(self._may_fire(left), wrenches, 0.0)
        normal = used @ wrenches.T + _SHIFT * np.trace(wrenches @ wrenches.T) * np.eye(6)
        solution = np.linalg.solve(normal, left)
        for _ in range(_REFINEMENTS):
            rest = left - used @ (wrenches.T @ solution)
            solution = solution + np.linalg.solve(normal, rest)
        forces = used.T @ solution
        least = -_SLACK * (1.0 + np.abs(left).max())
        is_negative, none = forces.min() < least, np.zeros(largest.size)
        start = vertex_at(wrenches, np.zeros(6), none, none + np.inf)
        of_a_basis, _ = least_cost(
            wrenches, left, largest=none + np.inf, cost=self._distinct_cost, most=1.0, slack=0.0,
            start=start, needed=is_negative,
        )  # fmt: skip
        forces = np.where(is_negative, of_a_basis, forces)
        is_within = (forces.min() >= least) & (forces <= largest * (1.0 + _SLACK)).all()
        most = np.maximum(1.0, np.abs(wrench).max() / largest.sum())
        if leak.any():
            held, _ = self._solve_within_bounds(-leak, 0.0)
            start = vertex_at(wrenches, -leak, held, largest)
        within, part = least_cost(
            wrenches, wrench / most, largest=largest, cost=self._program_cost, most=most,
            slack=_SLACK, start=start, needed=np.logical_not(is_within),
        )  # fmt: skip
        found = np.where(is_within, np.maximum(forces, 0.0), within)
        return found, np.where(is_within, 1.0, part / most)

    def _of_a_basis(self, wrench: np.ndarray) -> np.ndarray:
        """The forces (n) of six thrusters, a basis of the best vertex, that give a wrench (6)."""
        forces = self._inverses.dot(wrench).reshape(-1, 6)
        best = forces.min(axis=1).argmax()
        found = np.zeros(self._largest.size)
        found[self._bases[best]] = forces[best]
        return found

    def _solve_within_bounds(
        self, wrench: np.ndarray, leak: np.ndarray | float
    ) -> tuple[np.ndarray, float]:
        """``solve`` in two steps: the largest part s with W f = s w - leak, then the least cost
        with this part. (In one program, with costs that differ by many orders of magnitude,
        rounding would choose among equally cheap forces.)
        """
        program, unknown, bounds, balance, cost = self._program
        most = max(1.0, float(np.abs(wrench).max() / self._largest.sum()))
        matrix = np.concatenate([self._wrenches, -wrench[:, None] / most], axis=1)
        balance.evaluator().UpdateCoefficients(matrix, np.zeros(6) - leak)

        def solved(weights: np.ndarray, least_part: float, most_part: float) -> np.ndarray:
            bounds.evaluator().UpdateLowerBound([*np.zeros(self._largest.size), least_part])
            bounds.evaluator().UpdateUpperBound([*self._largest, most_part])
            cost.evaluator().UpdateCoefficients(weights)
            return ClpSolver().Solve(program).GetSolution(unknown)

        part = float(solved(np.append(np.zeros(self._largest.size), -1.0), 0.0, most)[-1])
        forces = solved(np.append(self._program_cost, 0.0), part * (1.0 - _SLACK), part)[:-1]
        return np.clip(forces, 0.0, self._largest), part / most

    @functools.cached_property
    def _program(self) -> tuple[MathematicalProgram, np.ndarray, Any, Any, Any]:
        """The linear program, its unknowns, their bounds, the balance of wrenches and the cost; of
        the last three, the numbers that depend on the wrench are still to be set.
        """
        program, count = MathematicalProgram(), self._largest.size
        unknown = program.NewContinuousVariables(count + 1)
        cost = program.AddLinearCost(np.ones(count + 1), unknown)
        bounds = program.AddBoundingBoxConstraint(np.zeros(count + 1), np.ones(count + 1), unknown)
        balance = program.AddLinearEqualityConstraint(
            np.zeros((6, count + 1)), np.zeros(6), unknown
        )
        return program, unknown, bounds, balance, cost


def lost_direction(wrenches: np.ndarray) -> np.ndarray | None:
    """A wrench y (6) that no forces f >= 0 with the wrenches W (6, n) can give, W' y <= 0; None
    where there is none.
    """
    left, sizes, _ = np.linalg.svd(wrenches)
    if wrenches.shape[1] < 6 or sizes[-1] < 1e-9 * sizes[0]:
        return left[:, -1]
    program = MathematicalProgram()
    unknown = program.NewContinuousVariables(6)
    program.AddLinearCost(wrenches.sum(axis=1), unknown)
    program.AddBoundingBoxConstraint(-np.ones(6), np.ones(6), unknown)
    program.AddLinearConstraint(
        wrenches.T, np.full(wrenches.shape[1], -np.inf), np.zeros(wrenches.shape[1]), unknown
    )
    found = ClpSolver().Solve(program)
    return (
        None
        if abs(found.get_optimal_cost()) < 1e-9 * np.abs(wrenches).sum()
        else found.GetSolution(unknown)
    )


def _in_words(wrench: np.ndarray) -> str:
    torque, force = (
        ", ".join(f"{number:.2g}" for number in part + 0.0) for part in np.split(wrench.round(2), 2)
    )
    if not wrench[:3].round(2).any():
        return f"a force along [{force}] of the base's axes"
    return (
        f"a torque along [{torque}]"
        + (f" with a force along [{force}]" if wrench[3:].round(2).any() else "")
        + " of the base's axes"
    )
