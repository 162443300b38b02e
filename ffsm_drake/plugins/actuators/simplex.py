"""Linear programs of thrusters in a fixed form, for symbols as for numbers.

    minimise c . f   over   W f = s w - l,   0 <= f <= F,   with the largest s up to a given one

A bounded primal simplex: first for the largest s, then for the least cost with this s. It begins at
a vertex with s = 0. The table has the rows B^-1 [W, -w] of a basis B, then the costs of both aims,
less those of the basis.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.choice import repeated

_ROUNDS = 200  # at most; usually 10 to 30
_IMPROVES = 1e-11  # least reduced cost, as a share of the largest cost
_PIVOT = 1e-10  # least
_TIES = 1e-12  # N; of the steps to bounds


class Vertex(NamedTuple):
    """Forces that cancel the leak."""

    forces: np.ndarray  # (n), N
    basis: np.ndarray  # (6) the numbers of those that may be within their bounds
    inverse: np.ndarray  # (6, 6) of W at the basis


def vertex_at(
    wrenches: np.ndarray, wrench: np.ndarray, forces: np.ndarray, largest: np.ndarray
) -> Vertex:
    """Return the vertex near forces (n) that give a wrench (6), with its basis."""
    basis = list[int]()
    for each in np.argsort(-np.minimum(forces, largest - forces), kind="stable").tolist():
        columns = wrenches[:, [*basis, each]]
        sizes = np.linalg.svd(columns / np.linalg.norm(columns, axis=0))[1]
        if len(basis) < 6 and sizes[-1] > 1e-6 * sizes[0]:
            basis.append(each)
    inverse = np.linalg.inv(wrenches[:, basis])
    exact = np.where(forces > 0.5 * largest, largest, 0.0)
    exact[basis] = 0.0
    exact[basis] = inverse @ (wrench - wrenches @ exact)
    return Vertex(exact, np.array(basis), inverse)


def least_cost(
    wrenches: np.ndarray,
    wrench: Any,
    *,
    largest: np.ndarray,
    cost: np.ndarray,
    most: Any,
    slack: float,
    start: Vertex,
    needed: Any,
) -> tuple[Any, Any]:
    """Return the forces (n), N, and the largest s; NaN if it needs too many rounds.

    Args:
      wrenches: W (6, n).
      wrench: w (6).
      largest: F (n), N; may be infinite.
      cost: c (n), of the size of 1.
      most: the largest s that is wanted.
      slack: what the least cost may take away from the largest s, as a share of it.
      start: a vertex for s = 0.
      needed: whether it is; otherwise the results mean nothing.
    """
    basis, numbers = start.basis, np.arange(largest.size + 1)
    columns = np.concatenate([wrenches, -wrench[:, None]], axis=1)
    begin, is_basic = np.append(start.forces, 0.0), np.isin(numbers, basis)
    table, costs = start.inverse @ columns, np.zeros((2, numbers.size))
    costs[0, -1], costs[1, :-1] = -1.0, cost
    state = {
        "goes": needed, "has_part": 0.0, "part": 0.0, "range": most,  # of s
        "table": np.concatenate([table, costs - costs[:, basis] @ table]),
        "values": begin[basis], "tops": largest[basis], "basis": basis,  # s above its lower bound
        "is_basic": is_basic, "is_full": ~is_basic & (begin > 0.0),
    }  # fmt: skip
    found = repeated(_round, state, {"largest": largest, "slack": slack}, most=_ROUNDS)

    # Many rounds leave rounding, which the columns themselves have not. B^-1 = T B0 B0^-1.
    whole = _whole(found, found["values"], largest, slack)
    left = start.inverse @ (columns @ (begin - whole))
    values = found["values"] + found["table"][:6, basis] @ left
    forces = _whole(found, values, largest, slack)[:-1]
    forces = np.where(found["goes"] > 0.0, np.nan, forces)
    return np.minimum(np.maximum(forces, 0.0), largest), found["part"]


def _whole(found: Mapping[str, Any], values: Any, largest: np.ndarray, slack: float) -> Any:
    """All forces, and s, from those of the basis."""
    ranges = _ranges(found, largest)
    made = [
        _picked(found["basis"] == k, values, np.where(found["is_full"][k] > 0.0, ranges[k], 0))
        for k in range(largest.size + 1)
    ]
    low = np.where(found["has_part"] > 0.0, found["part"] * (1.0 - slack), 0.0)
    return np.stack([*made[:-1], made[-1] + low])


def _round(state: Mapping[str, Any], fixed: Mapping[str, Any]) -> Mapping[str, Any]:
    """A pivot, or the step of a force to its other bound, or the begin of the second aim."""
    table, values, tops, basis = (state[name] for name in ("table", "values", "tops", "basis"))
    is_full, has_part, part = state["is_full"] > 0.0, state["has_part"] > 0.0, state["part"]
    ranges = _ranges(state, fixed["largest"])
    numbers, rows = np.arange(ranges.size), np.arange(6)
    costs = np.where(has_part, table[7], table[6])
    gains = np.where(is_full, costs, -costs)
    gains = np.where((state["is_basic"] > 0.0) | (ranges <= 0.0), 0.0, gains)
    gain = gains.max()
    goes, enters = gain > _IMPROVES, _picked(gains == gain, numbers)
    column, span, falls = (
        _picked(numbers == enters, each) for each in (table.T, ranges, state["is_full"])
    )
    along = np.where(falls > 0.0, -column[:6], column[:6])  # how the basis falls
    size = np.abs(along)
    room = np.where(along > 0.0, values, tops - values) / np.where(size > _PIVOT, size, 1.0)
    room = np.where(size > _PIVOT, np.maximum(room, 0.0), np.inf)
    least = room.min()
    pivots, step = goes & (least < span), np.where(goes, np.minimum(least, span), 0.0)
    size = np.where(room <= least + _TIES, size, -1.0)
    leaves = np.where(pivots, _picked(size == size.max(), rows), -1.0)
    is_out, is_in = rows == leaves, pivots & (numbers == enters)
    was = numbers == _picked(is_out, basis, -1.0)
    row = _picked(is_out, table[:6]) / _picked(is_out, column[:6], 1.0)
    is_row = np.append(is_out, [False, False])[:, None]
    pivoted = np.where(is_row, row, table - column[:, None] * row)
    is_full = np.where(was, _picked(is_out, along) < 0.0, is_full & ~is_in)
    is_full = is_full ^ (goes & (least >= span) & (numbers == enters))
    # s is known
    knows, is_part = (gain <= _IMPROVES) & (state["has_part"] <= 0.0), basis == numbers[-1]
    part = np.where(
        knows, _picked(is_part, values, np.where(is_full[-1], state["range"], 0.0)), part
    )
    values = np.where(is_out, np.where(falls > 0.0, span - step, step), values - step * along)
    low = np.where(knows, part * (1.0 - fixed["slack"]), 0.0)
    span_of_part = np.where(knows, part - low, state["range"])
    return {
        "goes": goes | knows, "has_part": has_part | knows, "part": part, "range": span_of_part,
        "table": pivoted, "values": np.where(is_part, values - low, values),
        "tops": np.where(is_out, span, np.where(is_part & knows, span_of_part, tops)),
        "basis": np.where(is_out, enters, basis),
        "is_basic": is_in | ((state["is_basic"] > 0.0) & ~was), "is_full": is_full,
    }  # fmt: skip


def _ranges(state: Mapping[str, Any], largest: Any) -> Any:
    """The upper bounds of forces and s above their lower ones."""
    return np.append(largest, state["range"])


def _picked(which: Any, values: Any, otherwise: Any = 0.0) -> Any:
    """The first value (or row of values) whose truth is."""
    for truth, value in zip(reversed(which), reversed(values), strict=True):
        otherwise = np.where(truth, value, otherwise)
    return otherwise
