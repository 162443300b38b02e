"""Weighted means of accelerations that the commands do not explain, and the forces behind them.

With the nominal mass matrix H and the reported force, a mean over a window is

    a = H^-1 (d - Y p + s) + noise

with a disturbance d of at most its bound, errors p of the payload's mass properties in intervals,
and the force s of a fault. The weights are positive or those of a slope, and add up to one, so that
the mean of a bounded force of any frequency stays within its bound. A mean weighted by the
commanded force of a thruster shows a missing force in full.
"""

import dataclasses
from typing import Self

import numpy as np

from ffsm_drake.plugins.faults.payload_error import force_by_errors
from ffsm_drake.plugins.faults.windows import times_of

WINDOWS = (4, 8, 16, 32, 64)  # blocks of slopes
FIRED = (4, 16, 64)  # blocks of means that are weighted by the force of a thruster
_FIRST = 13  # blocks from which on there are features
_MODEL, _TURN = 0.004, 0.1  # error of the model, of accelerations: least; for each rad of motion
_MORE, _FORCE = 1.03, 1e-3  # of the bounds of forces: share, N m or N
_FREE = 200.0  # N m or N, any force on the base


@dataclasses.dataclass(frozen=True, kw_only=True)
class Features:
    """F features, with noise of deviation 1: y = A [d; p] + W s + noise."""

    window: np.ndarray  # (F) blocks
    is_slope: np.ndarray  # (F) else weighted by a commanded force
    is_free: np.ndarray  # (F) whether any force on the base is normal
    y: np.ndarray  # (F, nv)
    matrix: np.ndarray  # A (F, nv, nv + 10, or nv without a payload), of d and p in their bounds
    low: np.ndarray  # (F, nv + 10)
    high: np.ndarray  # (F, nv + 10)
    white: np.ndarray  # W (F, nv, nv)
    pushes: np.ndarray  # (F, nv, n) generalized force of a unit force of each thruster
    told: np.ndarray  # (F, n) mean commanded force of each thruster, N

    def of(self, which: np.ndarray) -> Self:
        """Those at places, or of a mask."""
        values = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        return dataclasses.replace(self, **{name: of[which] for name, of in values.items()})

    def at_most(self, errors: np.ndarray) -> np.ndarray:
        """A sum of squares (F) that normal causes leave at most, with a payload.

        Args: its errors (10), as shares of half their intervals; without a payload, (0).
        """
        nv = self.y.shape[1]
        inside = self.matrix[:, :, :nv]
        left = self.y - self.matrix[:, :, nv:] @ errors
        share = np.linalg.solve(inside, left[..., None])[..., 0]
        beyond = share - np.clip(share, -1.0, 1.0)
        squares: np.ndarray = (np.einsum("fij,fj->fi", inside, beyond) ** 2).sum(axis=1)
        return squares


@dataclasses.dataclass(frozen=True, kw_only=True)
class Means:
    """Weighted means (F) before they are whitened."""

    window: np.ndarray  # (F) blocks
    is_slope: np.ndarray  # (F)
    middle: np.ndarray  # (F) blocks from the last one back to the middle
    unexplained: np.ndarray  # (F, nv) accelerations
    acceleration: np.ndarray  # (F, nv)
    noise: np.ndarray  # (F, nv) standard deviation of ``unexplained``
    told: np.ndarray  # (F, n) N


def slopes(
    left: np.ndarray, velocity: np.ndarray, told: np.ndarray, noise: np.ndarray, step: float
) -> Means:
    """Slopes over the ``WINDOWS`` that m blocks fill, ``step`` s apart.

    Args: of blocks, unexplained changes and velocities (m, nv), impulses (m, n), each summed up;
    the noise (nv) of a velocity's mean over a block.
    """
    windows = [each for each in WINDOWS if max(each, _FIRST) <= len(left)]
    found = list[tuple[np.ndarray, ...]]()
    for count in windows:
        time = times_of(count, step)
        weights = time / (time @ time)
        means = (weights @ each[-count:] for each in (left, velocity, told))
        found.append((*means, noise / np.sqrt(time @ time)))
    stacked = [np.array(each) for each in zip(*found, strict=True)]
    whole, is_slope = np.array(windows), np.ones(len(windows), dtype=bool)
    return Means(
        window=whole, is_slope=is_slope, middle=whole // 2,
        unexplained=stacked[0], acceleration=stacked[1], told=stacked[2], noise=stacked[3],
    )  # fmt: skip


def fired(sums: np.ndarray, force: np.ndarray, noise: np.ndarray, step: float) -> Means:
    """Means weighted by the commanded force of each thruster that fired in ``FIRED`` blocks.

    Args:
      sums: of the samples of each of m blocks (m, n, n + 2 nv + 1): commanded force times the
        forces of all, unexplained and expected acceleration; and the square of its change.
      force: of the thrusters (n), N.
      noise: of a sample of the velocities (nv).
      step: control period, s.
    """
    count, nv = len(force), noise.size
    found = list[tuple[np.ndarray, ...]]()
    total = sums[:, :, -2]
    for window in (each for each in FIRED if max(each, _FIRST) <= len(sums)):
        of = sums[-window:].sum(axis=0)
        for i in np.flatnonzero(of[:, -2] >= 2.0 * force):
            mean, share = of[i] / of[i, -2], total[-window:, i]
            left, expected = mean[count : count + nv], mean[count + nv : count + 2 * nv]
            rough = np.sqrt(of[i, -1] + 2.0 * force[i] ** 2) / of[i, -2] / step
            back = share @ np.arange(window)[::-1] / share.sum()
            row = (np.array(window), np.array(round(back + 0.4)), left, left + expected)
            found.append((*row, noise * rough, mean[:count]))
    if found:
        arrays = [np.array(each) for each in zip(*found, strict=True)]
    else:
        none, empty = np.zeros((0, nv)), np.zeros(0, dtype=int)
        arrays = [empty, empty, none, none, none, np.zeros((0, count))]
    return Means(
        window=arrays[0], is_slope=np.zeros(len(arrays[0]), dtype=bool), middle=arrays[1],
        unexplained=arrays[2], acceleration=arrays[3], noise=arrays[4], told=arrays[5],
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """What each feature's middle tells (F, ...)."""

    mass: np.ndarray  # (F, nv, nv)
    bound: np.ndarray  # (F, nv) of normal forces
    velocity: np.ndarray  # (F, nv)
    payload: np.ndarray  # (F, 6 nv + 15) as ``payload_error.place``; (F, 0) without a payload
    pushes: np.ndarray  # (F, nv, n)
    panels: np.ndarray  # (F, 6) largest force of flexible parts on the base
    turned: np.ndarray  # (F) largest motion of a joint or the base in the window, rad or m


def whitened(
    means: Means, at: Places, box: tuple[np.ndarray, np.ndarray], *, is_free: bool
) -> Features:
    """The features of means, with a box of the payload's errors (two of 10)."""
    inverse = np.linalg.inv(at.mass)
    bound = _MORE * at.bound + _FORCE
    share = (_MODEL + _TURN * at.turned)[:, None]
    largest = np.sqrt(np.einsum("fij,fj->fi", inverse**2, bound**2))
    deviation = np.hypot(means.noise, share * (largest + np.abs(means.unexplained)))
    bound[:, :6] = _FREE if is_free else bound[:, :6] + at.panels
    white = inverse / deviation[:, :, None]
    parts, ones = [white * bound[:, None]], np.ones_like(bound)
    lows, highs = [-ones], [ones]
    if at.payload.size:
        by_errors = force_by_errors(at.payload, at.velocity, means.acceleration)
        scale = 0.5 * (box[1] - box[0])
        parts.append(-white @ by_errors * scale)
        lows.append(np.tile(box[0] / scale, (len(bound), 1)))
        highs.append(np.tile(box[1] / scale, (len(bound), 1)))
    return Features(
        window=means.window, is_slope=means.is_slope,
        is_free=np.full(len(bound), is_free), y=means.unexplained / deviation,
        matrix=np.concatenate(parts, axis=2), white=white, pushes=at.pushes, told=means.told,
        low=np.concatenate(lows, axis=1), high=np.concatenate(highs, axis=1),
    )  # fmt: skip


def joined(*parts: Features) -> Features:
    """All features of parts."""
    names = [each.name for each in dataclasses.fields(Features)]
    return Features(**{n: np.concatenate([getattr(each, n) for each in parts]) for n in names})
