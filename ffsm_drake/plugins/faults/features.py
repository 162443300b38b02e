"""Weighted means of accelerations that the commands do not explain, and the forces behind them.

With the nominal mass matrix H and the reported force, a mean over a window is

    a = H^-1 (d - Y p + s) + noise

with a disturbance d of at most its bound, errors p of the payload's mass properties in intervals,
and the force s of a fault. The weights are positive or those of a slope, and add up to one, so that
the mean of a bounded force of any frequency stays within its bound. A mean weighted by the
commanded force of a thruster shows a missing force in full.
"""

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from ffsm_drake.plugins.faults.payload_error import force_by_errors
from ffsm_drake.plugins.faults.windows import slope_weights

WINDOWS = (4, 8, 16, 32, 64)  # blocks of slopes
CHAIN, LINKS = 16, 4  # blocks of slopes that follow one another; their number
FIRED = (4, 16, 64)  # blocks of means that are weighted by the force of a thruster
FIRST = 13  # blocks from which on there are features
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class Means:
    """Weighted means (F) before they are whitened."""

    window: np.ndarray  # (F) blocks
    is_slope: np.ndarray  # (F)
    ago: np.ndarray  # (F) blocks from the last one back to the end of the window
    middle: np.ndarray  # (F) blocks from the last one back to its middle
    unexplained: np.ndarray  # (F, nv) accelerations
    acceleration: np.ndarray  # (F, nv)
    noise: np.ndarray  # (F, nv) standard deviation of ``unexplained``
    told: np.ndarray  # (F, n) N


def slopes(
    left: np.ndarray,
    velocity: np.ndarray,
    told: np.ndarray,
    noise: np.ndarray,
    step: float,
    windows: np.ndarray,
    ago: np.ndarray,
) -> Means:
    """Slopes over windows (F) of m blocks that are ``step`` s apart.

    Args: of blocks, unexplained changes and velocities (m, nv), impulses (m, n), each summed up;
    the noise (nv) of a velocity's mean over a block; also how many blocks ago each window ended.
    """
    weights = np.zeros((len(windows), len(left)))
    ends = len(left) - ago
    for row, (first, end) in enumerate(zip(ends - windows, ends, strict=True)):
        weights[row, first:end] = slope_weights((int(end - first),), int(end - first), step)[0]
    return Means(
        window=windows, is_slope=np.ones(len(windows), dtype=bool), middle=windows // 2 + ago,
        ago=ago, unexplained=weights @ left, acceleration=weights @ velocity, told=weights @ told,
        noise=np.linalg.norm(weights, axis=1)[:, None] * noise,
    )  # fmt: skip


def fired(
    samples: np.ndarray, span: int, force: np.ndarray, noise: np.ndarray, step: float
) -> Means:
    """Means weighted by the commanded force of each thruster that fired in ``FIRED`` blocks.

    Args:
      samples: of each of m blocks, more than the longest window (m, k, n + 2 nv): commanded forces,
        unexplained and expected acceleration.
      span: blocks that may be used.
      force: of the thrusters (n), N.
      noise: of a sample of the velocities (nv).
      step: control period, s.
    """
    count, nv, each = len(force), noise.size, samples.shape[1]
    rows, told = samples.reshape(-1, count + 2 * nv), samples[:, :, :count].sum(axis=1)
    fires, last = rows[:, :count], 0
    changes, of, rough = np.diff(fires, axis=0) ** 2, np.zeros((count, count + 2 * nv)), 0.0
    parts = list[tuple[np.ndarray, ...]]()
    for window in (blocks for blocks in FIRED if max(blocks, FIRST) <= span):
        part = slice(-window * each, -last * each or None)
        of, last = of + fires[part].T @ rows[part], window
        rough = rough + changes[part].sum(axis=0)
        total = told[-window:].sum(axis=0)
        which = np.flatnonzero(total >= 2.0 * force)
        total = total[which]
        back = np.arange(window)[::-1] @ told[-window:, which] / total
        spread = np.sqrt(rough[which] + 2.0 * force[which] ** 2) / total / step
        middle = np.round(back + 0.4).astype(int)
        parts.append((np.full(len(which), window), middle, of[which] / total[:, None], spread))
    if not parts:
        none = np.zeros(0, dtype=int)
        parts.append((none, none, np.zeros((0, count + 2 * nv)), np.zeros(0)))
    windows, middles, means, roughs = (np.concatenate(of) for of in zip(*parts, strict=True))
    left, expected = means[:, count : count + nv], means[:, count + nv :]
    return Means(
        window=windows, is_slope=np.zeros(len(windows), dtype=bool), middle=middles,
        ago=0 * windows,
        unexplained=left, acceleration=left + expected, told=means[:, :count],
        noise=roughs[:, None] * noise,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """What each feature's middle tells (F, ...)."""

    inverse: np.ndarray  # (F, nv, nv) of the mass matrix
    bound: np.ndarray  # (F, nv) of normal forces
    velocity: np.ndarray  # (F, nv)
    payload: np.ndarray  # (F, 6 nv + 6) as ``payload_error.place``; (F, 0) without a payload
    pushes: np.ndarray  # (F, nv, n)
    panels: np.ndarray  # (F, 6) largest force of flexible parts on the base
    turned: np.ndarray  # (F) largest motion of a joint or the base in the window, rad or m


def whitened(
    means: Means, at: Places, box: tuple[np.ndarray, np.ndarray], is_free: np.ndarray
) -> Features:
    """The features of means, with a box of the payload's errors (two of 10).

    Args: also whether any force on the base is normal (F).
    """
    bound = _MORE * at.bound + _FORCE
    share = (_MODEL + _TURN * at.turned)[:, None]
    largest = np.sqrt((at.inverse**2 @ bound[..., None] ** 2)[..., 0])
    deviation = np.hypot(means.noise, share * (largest + np.abs(means.unexplained)))
    bound[:, :6] = np.where(is_free[:, None], _FREE, bound[:, :6] + at.panels)
    white = at.inverse / deviation[:, :, None]
    matrix, high = white * bound[:, None], np.ones_like(bound)
    low = -high
    if at.payload.size:
        by_errors = force_by_errors(at.payload, at.velocity, means.acceleration)
        scale = 0.5 * (box[1] - box[0])
        matrix = np.concatenate([matrix, -white @ (by_errors * scale)], axis=2)
        low, high = (
            np.hstack([own, np.tile(of / scale, (len(own), 1))])
            for own, of in zip((low, high), box, strict=True)
        )
    return Features(
        window=means.window, is_slope=means.is_slope, is_free=is_free,
        y=means.unexplained / deviation, matrix=matrix, low=low, high=high,
        white=white, pushes=at.pushes, told=means.told,
    )  # fmt: skip


Rows = TypeVar("Rows", Features, Means, Places)


def rows_of(of: Rows, which: np.ndarray) -> Rows:
    """Those at places, or of a mask."""
    values = {each.name: getattr(of, each.name)[which] for each in dataclasses.fields(of)}
    return dataclasses.replace(of, **values)


def joined(parts: Sequence[Means]) -> Means:
    """All of them."""
    names = [each.name for each in dataclasses.fields(Means)]
    return Means(**{n: np.concatenate([getattr(each, n) for each in parts]) for n in names})
