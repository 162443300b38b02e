"""A limit on the rotation of a base that joints turn by conservation of momentum."""

from collections.abc import Callable

import numpy as np
from pydrake.solvers import MathematicalProgram
from scipy.spatial.transform import Rotation

from ffsm_drake.plugins.planning.curve import Curve
from ffsm_drake.plugins.planning.inverse_dynamics import turned

_LESS_TURN, _TURN_ROOM = 0.85, 1e-3  # relative change of the base's turn between solutions


def turned_along(of: Curve, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations (n, 3, 3) of a base that joints turn since the start of a curve, and its
    small rotations (n, 3, unknowns) by the unknowns, in the axes of the world.
    """
    values, by = of.evaluate(x)
    rows = slice(-of.size - 6, -of.size)  # the last before z
    w, alpha = np.split(values[:, rows], 2, axis=1)
    slope = by[:, rows]
    step = np.zeros((len(of.steps), of.num_unknowns))
    step[:, of.num_points :] = of.steps @ of.lengths_by
    return turned(w, alpha, slope, of.steps @ of.last_lengths, step)


class TurnLimit:
    """The constraint on the base's turn in a program, and how it comes nearer.

    Where joints turn the base further than they may, a limit on it at once is not found to be
    possible. So the first solution is without, and the limit comes nearer step by step.
    """

    def __init__(
        self, program: MathematicalProgram, curve: Curve, x: np.ndarray, most: float
    ) -> None:
        """Args: the program; the curve; its unknowns; the largest turn, rad."""
        self.most = self._allowed = most
        self._curve = curve

        def square(x: np.ndarray) -> np.ndarray:
            vector, turning = self._turned(x)
            slope = 2.0 * np.einsum("ki,kix->kx", vector, turning)
            return curve.lifted(x, np.square(vector).sum(axis=1), slope) / self._allowed**2

        ones = np.ones(curve.instants - 1)
        self._constraint = program.AddConstraint(square, -np.inf * ones, ones, x).evaluator()

    def _turned(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the base's rotation vector at every instant but the first, and its small rotations
        by the unknowns.
        """
        rotation, turning = turned_along(self._curve, x)
        return Rotation.from_matrix(rotation[1:]).as_rotvec(), turning[1:]

    def _of(self, unknowns: np.ndarray) -> float:
        """The largest turn, rad."""
        vector, _ = self._turned(unknowns)
        return float(np.linalg.norm(vector, axis=1).max())

    def _allow(self, allowed: float) -> None:
        self._allowed = min(allowed, np.pi)
        bound = np.full(self._constraint.num_constraints(), 1.0 if np.isfinite(allowed) else np.inf)
        self._constraint.set_bounds(-np.inf * bound, bound)

    def solve(
        self, first: np.ndarray, solve: Callable[[np.ndarray], tuple[np.ndarray, str]]
    ) -> tuple[np.ndarray, str]:
        """Return what a solver finds from values of the program's variables."""
        limit = self.most
        allowed = limit if _LESS_TURN * self._of(first) <= limit else np.inf
        while True:
            self._allow(allowed)
            first, said = solve(first)
            turn = self._of(first)
            if allowed == limit or turn > allowed * (1.0 + _TURN_ROOM):
                return first, said
            allowed = max(min(allowed, _LESS_TURN * turn), limit)
