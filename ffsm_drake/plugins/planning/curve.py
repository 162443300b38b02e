"""A spline as unknowns of an optimization, and the dynamics along it with derivatives.

The unknowns are the control points P of z (``systems.plan``), the duration T and the changes d of
the segments' even lengths, so knots can move to the instants of switching forces. Everything is
evaluated at a few instants of every segment.
"""

from collections.abc import Callable

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from ffsm_drake.plugins.planning.inverse_dynamics import Dynamics, complex_step
from ffsm_drake.systems.plan import DEGREE

INSTANTS = 3  # per segment, at which force and clearance are evaluated


class Curve:
    """The curve of z at its instants, as functions of the unknowns [P, T, d]."""

    def __init__(
        self,
        dynamics: Dynamics,
        size: int,
        segments: int,
        evaluated: Callable[[np.ndarray], None],
    ) -> None:
        """Args:
        dynamics: dynamics of z.
        size: of z.
        segments: of the spline.
        evaluated: called with the unknowns after they have been evaluated anew.
        """
        self._dynamics, self.size, self._evaluated = dynamics, size, evaluated
        self.joints = dynamics.joints
        self.count = segments + DEGREE  # control points
        self.num_points = self.count * size  # unknowns before T and d
        self.num_unknowns = self.num_points + 1 + segments
        self.evaluations = 0
        self._cache: tuple[bytes, np.ndarray, np.ndarray] = (b"", np.empty(0), np.empty(0))
        self._set_instants(segments)

    def _set_instants(self, segments: int) -> None:
        """The instants, the unknowns that each depends on, and their parts in an integral."""
        self.instants = count = INSTANTS * segments + 1
        self._segment = np.minimum(np.arange(count) // INSTANTS, segments - 1)
        self._within = np.arange(count) / INSTANTS - self._segment
        self._near = self._segment[:, None] + np.arange(DEGREE + 1)  # control points
        points = self._near[..., None] * self.size + np.arange(self.size)
        lengths = self._segment[:, None] + np.arange(-2, 3)
        # Segments beyond the ends are in a last column, which is ignored.
        lengths[(lengths < 0) | (lengths >= segments)] = segments
        self._columns = np.hstack([points.reshape(count, -1), lengths + self.num_points])
        # h = lengths_by [T, d]
        self.lengths_by = np.hstack([np.full((segments, 1), 1.0 / segments), np.eye(segments)])
        # Both times the lengths: time between instants, weights of the trapezoidal rule, s.
        self.steps = np.repeat(np.eye(segments), INSTANTS, axis=0) / INSTANTS
        self.weights = 0.5 * (
            np.pad(self.steps, ((0, 1), (0, 0))) + np.pad(self.steps, ((1, 0), (0, 0)))
        )

    def lengths(self, x: np.ndarray) -> np.ndarray:
        """Lengths of the segments, s. x begins with the unknowns."""
        found: np.ndarray = self.lengths_by @ x[self.num_points : self.num_unknowns]
        return found

    def given(self, x: np.ndarray) -> np.ndarray:
        """The unknowns as numbers. x begins with them, and may have derivatives."""
        found: np.ndarray = ExtractValue(x).ravel() if x.dtype == object else x
        return found[: self.num_unknowns]

    def points(self, x: np.ndarray) -> np.ndarray:
        """Control points (count, size). x begins with the unknowns."""
        return x[: self.num_points].reshape(self.count, self.size)

    def guess(self, curve: Callable[[np.ndarray], np.ndarray], duration: float) -> np.ndarray:
        """Unknowns of the spline with even segments nearest to z(t / T), (instants, size)."""
        segments = len(self.lengths_by)
        even = self.lengths_by[:, 0]
        basis = np.zeros((self.instants, self.count))
        np.put_along_axis(basis, self._near, self._basis_at(even)[0][0].T, axis=1)
        wanted = curve((self._segment + self._within) / segments)
        points = np.linalg.lstsq(basis, wanted, rcond=None)[0]
        return np.r_[points.ravel(), duration, 0.0 * even]

    def pattern(self, rows: int) -> list[tuple[int, int]]:
        """Pattern of possible nonzeros in the gradient of ``rows`` values at every instant."""
        size = self.num_points
        return [
            (k * rows + row, int(column))
            for k, columns in enumerate(self._columns)
            for row in range(rows)
            for column in np.r_[columns[columns < size], size, columns[columns >= size] + 1]
            if column < self.num_unknowns
        ]

    def lifted(self, x: np.ndarray, values: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Return values, with their gradient ``by`` the unknowns if x has derivatives, which are
        those by itself; x begins with the unknowns.
        """
        if x.dtype != object:
            return values
        gradient = np.zeros((values.size, x.size))
        gradient[:, : self.num_unknowns] = by.reshape(values.size, -1)
        return InitializeAutoDiff(values.reshape(-1, 1), gradient).reshape(values.shape)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the values of ``evaluate``, with their gradient if x has derivatives."""
        return self.lifted(x, *self.evaluate(x))

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return values (instants, rows) for [P, h] and their gradient (instants, rows, unknowns).

        The rows are force, what else the dynamics give, and z. x begins with the unknowns.
        """
        unknowns = self.given(x)
        if self._cache[0] == (key := unknowns.tobytes()):
            return self._cache[1:]
        calc = self._dynamics.calc
        self.last_lengths = self.lengths(unknowns)
        basis, change = self._basis_at(self.last_lengths)
        points = self.points(unknowns)[self._near]
        motion = np.einsum("oan,nas->osn", basis, points)
        found, by = complex_step(lambda z, *rates: np.vstack([calc(z, *rates), z]), motion)
        by_points = np.einsum("omsn,oan->nasm", by, basis).reshape(self.instants, -1, len(found))
        by_lengths = np.einsum("omsn,oadn,nas->ndm", by, change, points, optimize=True)
        both = np.zeros((self.instants, len(found), self.num_unknowns))
        rows = np.arange(self.instants)[:, None]
        both[rows, :, self._columns] = np.concatenate([by_points, by_lengths], axis=1)
        by_points, by_lengths = np.split(both[..., :-1], [self.num_points], axis=2)
        gradient = np.concatenate([by_points, by_lengths @ self.lengths_by], axis=2)
        self._cache = key, found.T, gradient
        self.evaluations += 1
        self._evaluated(unknowns)
        return self._cache[1:]

    def _basis_at(self, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        window = np.pad(lengths, 2)[self._segment[:, None] + np.arange(5)]
        return spline_basis(window.T, self._within)


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
