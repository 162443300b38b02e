"""The least change of joint accelerations within limits: a quadratic program in a fixed form, for
symbols as for numbers.

    minimise x^T M x / 2 + k s   over   low - s <= x <= high + s,   down <= M x <= up,   s >= 0

A primal-dual interior-point method with fixed centring (Nocedal and Wright, Numerical Optimization,
2nd ed., section 16.6). The limits of M x, the force, are hard. The slack s is zero where all limits
can be met: k is large enough for an exact penalty.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.choice import repeated

_ROUNDS = 40  # at most; usually 10 to 20
_ENOUGH = 1e-10  # mean product of room and multiplier, in the units of the scaled problem
_CENTRED, _SHARE = 0.1, 0.99  # of that product; of the way to the nearest limit
_FAR, _PENALTY = 1e3, 1e4  # a limit that counts as none; k; of the scaled problem
_START = 2.0  # slack at the start
_ROUNDING = 1e-14  # share of its diagonal that keeps the system regular


def least_change(
    mass: np.ndarray, low: np.ndarray, high: np.ndarray, down: np.ndarray, up: np.ndarray
) -> tuple[Any, Any]:
    """Return the change x (n), and the slack s (1). Both are zero if x = 0 is within all limits.

    Args:
      mass: M (n, n), positive definite.
      low, high: of x (n); may be infinite, and low may exceed high.
      down, up: of M x (n); may be infinite; down <= up.
    """
    largest = np.diagonal(mass).max()
    beyond = np.concatenate(
        [low, -high, down / np.diagonal(mass), -up / np.diagonal(mass), np.zeros(1)]
    ).max()
    is_beyond = beyond > 0.0
    size = np.where(is_beyond, beyond, 1.0)  # of accelerations; that of forces is largest * size
    scaled, count = mass / largest, low.size
    one, ones = np.eye(count), np.ones((count, 1))
    rows = np.block(
        [
            [one, -ones], [-one, -ones], [scaled, 0.0 * ones], [-scaled, 0.0 * ones],
            [np.zeros((1, count)), -np.ones((1, 1))],
        ]
    )  # fmt: skip
    bounds = np.concatenate(
        [high / size, -low / size, up / (largest * size), -down / (largest * size), np.zeros(1)]
    )
    bounds = np.minimum(np.maximum(bounds, -_FAR), _FAR)
    curvature = np.block([[scaled, np.zeros((count, 1))], [np.zeros((1, count)), np.ones((1, 1))]])
    slope = np.concatenate([np.zeros(count), np.array([_PENALTY])])
    start = slope / _PENALTY * _START  # within all limits but those of the force
    share = np.concatenate([np.full(2 * count, 1.0), np.zeros(2 * count), np.ones(1)])
    state = {
        "goes": np.where(is_beyond, 1.0, 0.0),
        "point": start,
        "room": np.maximum(bounds - rows @ start, 1.0),
        "multiplier": 1.0 + share * (_PENALTY / (2 * count + 1)),
    }
    fixed = {"rows": rows, "bounds": bounds, "curvature": curvature, "slope": slope}
    point = repeated(_round, state, fixed, most=_ROUNDS)["point"]
    return size * point[:count], np.where(is_beyond, size * point[count:], 0.0)


def _round(state: Mapping[str, Any], fixed: Mapping[str, Any]) -> Mapping[str, Any]:
    point, room, multiplier = state["point"], state["room"], state["multiplier"]
    rows, curvature = fixed["rows"], fixed["curvature"]
    gap = (room * multiplier).sum() / room.size
    dual = curvature @ point + fixed["slope"] + rows.T @ multiplier
    primal = rows @ point + room - fixed["bounds"]
    product = room * multiplier - _CENTRED * gap
    weighted = rows * (multiplier / room)[:, None]
    right = rows.T @ ((product - multiplier * primal) / room) - dual
    system = curvature + rows.T @ weighted
    # no direction is lost beside one with a limit so near that its weight exceeds 1 / rounding
    system = system + _ROUNDING * np.eye(len(point)) * np.diagonal(system)
    change = np.linalg.solve(system, right)
    of_room = -primal - rows @ change
    of_multiplier = -(product + multiplier * of_room) / room
    share = np.minimum(_step(room, of_room), _step(multiplier, of_multiplier))
    room, multiplier = room + share * of_room, multiplier + share * of_multiplier
    left = (room * multiplier).sum() / room.size + (1.0 - share) * np.abs(primal).max()
    return {
        "goes": np.where(left > _ENOUGH, 1.0, 0.0),
        "point": point + share * change,
        "room": room,
        "multiplier": multiplier,
    }


def _step(value: Any, change: Any) -> Any:
    """The step that keeps positive values positive, at most 1."""
    falls = change < 0.0
    longest = np.where(falls, -_SHARE * value / np.where(falls, change, -1.0), 1.0)
    return np.minimum(longest.min(), 1.0)
