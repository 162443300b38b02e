"""A planned motion that is moved as one rigid body, by c: a rotation vector and a way (6), and its
joints by further numbers. A polynomial of fifth order brings c, c' and c'' to other values.
"""

import math

import numpy as np

from ffsm_drake.common.so3 import (
    attitude_motion,
    composed,
    matrix_of,
    quaternion_of,
    turn_between,
)
from ffsm_drake.systems.planned_motion import PlannedMotion


def quintic(first: np.ndarray, last: np.ndarray, duration: float) -> np.ndarray:
    """Coefficients (6, n) by powers of time from [c; c'; c''] (3, n) to others."""
    rows = np.zeros((6, 6))
    for order in range(3):
        factors = [math.perm(power, order) for power in range(6)]
        rows[order, order] = factors[order]
        rows[3 + order, order:] = [
            factors[power] * duration ** (power - order) for power in range(order, 6)
        ]
    found: np.ndarray = np.linalg.solve(rows, np.vstack([first, last]))
    return found


def displacement(coefficients: np.ndarray, time: float, late: float = 0.0) -> np.ndarray:
    """[c; c'; c''] (3, n) of a ``quintic`` at a time, s, and evenly for so long after it, s."""
    power, terms = coefficients, time ** np.arange(6)
    found = np.empty((3, power.shape[1]))
    for order in range(3):
        found[order] = terms[: 6 - order] @ power
        power = np.arange(1, 6 - order)[:, None] * power[1:]
    found[0] += late * found[1]
    return found


def displaced(row: np.ndarray, c: np.ndarray, nq: int) -> np.ndarray:
    """A row [q_d; v_d; a_d] displaced by [c; c'; c''] (3, 6), or with joints (3, 6 + joints); nq
    is the number of positions.
    """
    found, v = row.copy(), nq
    a = v + (len(row) - nq) // 2
    rotation, w, alpha = (part[..., 0] for part in attitude_motion(*c[:, :3, None]))
    found[:4] = composed(quaternion_of(c[0, :3]), row[:4])
    found[4:7] += c[0, 3:6]
    turned = rotation @ row[v : v + 3]
    found[v : v + 3] = w + turned
    found[v + 3 : v + 6] += c[1, 3:6]
    found[a : a + 3] = alpha + rotation @ row[a : a + 3] + np.cross(w, turned)
    found[a + 3 : a + 6] += c[2, 3:6]
    for begin, joints in zip((7, v + 6, a + 6), c[:, 6:], strict=True):
        found[begin : begin + joints.size] += joints
    return found


def between(row: np.ndarray, other: np.ndarray, nq: int) -> np.ndarray:
    """[c; c'; c''] (3, 6 + joints) that displaces a row to another."""
    v, a = nq, nq + (len(row) - nq) // 2
    found = np.vstack([(other - row)[begin:][: v - 7 + 6] for begin in (1, v, a)])
    turn = matrix_of(row[:4]) @ turn_between(row[:4], other[:4])

    def moved(rate: np.ndarray, acceleration: np.ndarray) -> tuple[np.ndarray, ...]:
        each = attitude_motion(*(part[:, None] for part in (turn, rate, acceleration)))
        return tuple(part[..., 0] for part in each)

    zero = np.zeros(3)
    rotation = moved(zero, zero)[0]
    by_rate = np.stack([moved(axis, zero)[1] for axis in np.eye(3)], axis=1)
    turned = rotation @ row[v : v + 3]
    w = other[v : v + 3] - turned
    rate = np.linalg.solve(by_rate, w)
    alpha = other[a : a + 3] - rotation @ row[a : a + 3] - np.cross(w, turned)
    found[:, :3] = turn, rate, np.linalg.solve(by_rate, alpha - moved(rate, zero)[2])
    return found


class Joined(PlannedMotion):
    """A motion that begins at the row of another, and ends where and as it ends."""

    def __init__(self, motion: PlannedMotion, first: np.ndarray, *, sample_time: float) -> None:
        self._motion, self._nq = motion, len(motion.coordinates.position_names)
        c = between(motion.row(0.0), first, self._nq)
        self._coefficients = quintic(c, np.zeros_like(c), motion.end)
        super().__init__(coordinates=motion.coordinates, sample_time=sample_time, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._motion.rows(times)
        for row, time in zip(rows, np.clip(times, 0.0, self.end).tolist(), strict=True):
            row[:] = displaced(row, displacement(self._coefficients, time), self._nq)
        return rows
