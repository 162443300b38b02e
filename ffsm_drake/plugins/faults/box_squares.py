"""Least squares with every unknown in an interval, for many small problems at once."""

import numpy as np

_STEPS, _GAP = 40, 0.5  # steps at most; largest excess of half a sum of squares
_BACK, _CENTRED, _LEAST = 0.95, 0.1, 1e-4  # share of the way to a bound; of the barrier
_FLAT = 1e-12  # least weight of an unknown, share of its column's squares
_DAMPED, _GUESSES = 16.0, 6  # weight of the squares of changes in the first guesses; their number


def least_squares(
    matrix: np.ndarray,
    values: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    enough: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least |y - A x|^2 (n) with low <= x <= high, to twice ``_GAP``, and x (n, m).

    A primal-dual interior-point method (Nocedal and Wright, Numerical Optimization, 2nd ed.,
    section 16.6); each step solves systems of as many equations as y has numbers.

    Args:
      matrix: A (n, k, m).
      values: y (n, k).
      low: (n, m).
      high: (n, m), above ``low``.
      enough: a problem with at most these squares is not improved further. Above zero, damped
        least squares, cut at the bounds, are tried first, since they are nearly always enough.
    """
    centre, scale = 0.5 * (high + low), 0.5 * (high - low)
    left = values - np.einsum("nij,nj->ni", matrix, centre)
    scaled = matrix * scale[:, None]
    found, squares, live = np.zeros_like(centre), np.zeros(len(values)), np.arange(len(values))
    for _ in range(_GUESSES):
        if not (live.size and enough):
            break
        found[live] = _damped(scaled[live], left[live], found[live])
        rest = left[live] - np.einsum("nij,nj->ni", scaled[live], found[live])
        squares[live] = (rest**2).sum(axis=1)
        live = live[squares[live] > enough]
    left, scaled = left[live], scaled[live]
    first = np.maximum((left**2).sum(axis=1), 1.0)[:, None] / max(centre.shape[1], 1)
    x, up = np.zeros_like(centre[live]), np.repeat(first, centre.shape[1], axis=1)
    down = up.copy()
    for step in range(_STEPS + 1):
        rooms = 1.0 + x, 1.0 - x
        gap = (rooms[0] * up + rooms[1] * down).sum(axis=1)
        reached = np.einsum("ni,ni->n", left, left)
        goes = (gap >= _GAP) & (reached > enough) & (step < _STEPS)
        if not goes.all():
            found[live[~goes]], squares[live[~goes]] = x[~goes], reached[~goes]
            live, x, left, up, down, scaled, gap = (
                each[goes] for each in (live, x, left, up, down, scaled, gap)
            )
        if not live.size:
            break
        change, up, down = _advanced(scaled, left, x, up, down, gap)
        x = x + change
        left = left - np.einsum("nij,nj->ni", scaled, change)
    return squares, centre + scale * found


def _damped(matrix: np.ndarray, values: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Unknowns within +-1 that make |y - A x|^2 smaller; those at a bound stay there."""
    left = values - np.einsum("nij,nj->ni", matrix, x)
    free = matrix * (np.abs(x) < 1.0)[:, None]
    across = free.swapaxes(1, 2)
    system = free @ across + _DAMPED * np.eye(matrix.shape[1])
    found: np.ndarray = x + (across @ np.linalg.solve(system, left[..., None]))[..., 0]
    return np.clip(found, -1.0, 1.0)


def _advanced(
    matrix: np.ndarray,
    left: np.ndarray,
    x: np.ndarray,
    up: np.ndarray,
    down: np.ndarray,
    gap: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The change of x within +-1, and the next multipliers of both bounds."""
    over, under = 1.0 + x, 1.0 - x
    barrier = np.maximum(_CENTRED * gap / (2.0 * x.shape[1]), _LEAST)[:, None]
    # no less than rounding of an unknown's own curvature, or the system cannot be solved
    weight = np.maximum(up / over + down / under, _FLAT * (matrix**2).sum(axis=1))
    pull = np.einsum("nij,ni->nj", matrix, left) + barrier / over - barrier / under
    by_weight = matrix / weight[:, None]
    system = np.eye(matrix.shape[1]) + by_weight @ matrix.swapaxes(1, 2)
    along = np.linalg.solve(system, np.einsum("nij,nj->ni", by_weight, pull)[..., None])[..., 0]
    change = pull / weight - np.einsum("nij,ni->nj", by_weight, along)
    of_up = (barrier - up * change) / over - up
    of_down = (barrier + down * change) / under - down
    with np.errstate(divide="ignore", invalid="ignore"):
        primal = np.minimum(_room(over, change), _room(under, -change)).min(axis=1, keepdims=True)
        dual = np.minimum(_room(up, of_up), _room(down, of_down)).min(axis=1, keepdims=True)
    primal, dual = np.minimum(1.0, _BACK * primal), np.minimum(1.0, _BACK * dual)
    return primal * change, up + dual * of_up, down + dual * of_down


def _room(value: np.ndarray, change: np.ndarray) -> np.ndarray:
    """How many changes a positive value stays positive."""
    return np.where(change < 0.0, -value / change, np.inf)
