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

from ffsm_drake.plugins.faults.windows import EVERY, slope_weights

WINDOWS = (4, 8, 16, 32, 64)  # blocks of slopes
CHAIN, LINKS = 16, 4  # blocks of slopes that follow one another; their number
FIRED = (4, 16, 64)  # blocks of means that are weighted by the force of a thruster
_FADES = (3.0, 8.0, 32.0)  # blocks in which these weights fade
_FIRES = 1.0  # least force of such a mean, in samples with all of it
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
    errors: np.ndarray  # (F, nv, 10) accelerations that errors of the payload need, each one
    spread: np.ndarray  # (F) root of the sum of the squares of the weights of samples
    noise: np.ndarray  # (F, nv) standard deviation of ``unexplained``
    told: np.ndarray  # (F, n) N


def slopes(
    left: np.ndarray,
    errors: np.ndarray,
    told: np.ndarray,
    noise: np.ndarray,
    step: float,
    windows: Sequence[int],
    ago: Sequence[int],
) -> Means:
    """Slopes over windows (F) of m blocks that are ``step`` s apart.

    Args: of blocks, unexplained changes (m, nv), those that errors of the payload need (m, nv 10),
    and impulses (m, n), each summed up; the noise (nv) of a velocity's mean over a block; also how
    many blocks ago each window ended.
    """
    weights, window, back = np.zeros((len(windows), len(left))), np.array(windows), np.array(ago)
    for row, (size, end) in enumerate(zip(windows, ago, strict=True)):
        count = len(left) - end
        weights[row, :count] = slope_weights((size,), count, step)
    return Means(
        window=window, is_slope=np.ones(len(window), dtype=bool), middle=window // 2 + back,
        ago=back, unexplained=weights @ left, told=weights @ told,
        errors=_in_rows(weights @ errors, noise.size), spread=np.sqrt(1.2 / (EVERY * window)),
        noise=np.linalg.norm(weights, axis=1)[:, None] * noise,
    )  # fmt: skip


def pulses(sums: np.ndarray, rows: np.ndarray, fires: np.ndarray, blocks: int) -> None:
    """Add samples to sums that are weighted by the force of each thruster, and fade.

    Args:
      sums: (3, n, n + 11 nv + 4), updated: forces, accelerations, unexplained and as errors of
        the payload need, of ones, of how many blocks ago, and of squares of forces and of changes.
      rows: the values before the ones, of so many samples (k, n + 11 nv).
      fires: forces of thrusters (k + 1, n), N, also at the sample before.
      blocks: that the samples form.
    """
    ago = blocks * np.arange(len(rows))[::-1] / len(rows)
    values = np.column_stack([rows, np.ones(len(rows)), ago])
    changes = np.diff(fires, axis=0) ** 2
    for of, time in zip(sums, _FADES, strict=True):
        fades, faded = np.exp(-ago / time), np.exp(-blocks / time)
        of[:, -3] += blocks * of[:, -4]
        of[:, -2:] *= faded
        of *= faded
        of[:, :-2] += (fades[:, None] * fires[1:]).T @ values
        of[:, -2] += fades**2 @ fires[1:] ** 2
        of[:, -1] += fades**2 @ changes


def fired(sums: np.ndarray, span: int, force: np.ndarray, noise: np.ndarray, step: float) -> Means:
    """Means weighted by the commanded force of each thruster that fired.

    Args: sums of ``pulses``; blocks that may be used; force of the thrusters (n), N; the noise (nv)
    of a sample of the velocities; control period, s.
    """
    count, nv = len(force), noise.size
    total = sums[:, :, -4]
    is_used = np.array([max(blocks, FIRST) <= span for blocks in FIRED])
    at, which = np.nonzero((total >= _FIRES * force) & is_used[:, None])
    of, total = sums[at, which], total[at, which]
    means = of / total[:, None]
    rough = np.sqrt(of[:, -1] + 2.0 * force[which] ** 2) / total / step
    return Means(
        window=np.array(FIRED)[at], is_slope=np.zeros(len(at), dtype=bool), ago=0 * at,
        middle=np.minimum(np.round(means[:, -3] + 0.4), np.array(FIRED)[at]).astype(int),
        unexplained=means[:, count : count + nv], told=means[:, :count],
        errors=_in_rows(means[:, count + nv : -4], nv),
        spread=np.sqrt(of[:, -2]) / total, noise=rough[:, None] * noise,
    )  # fmt: skip


def _in_rows(columns: np.ndarray, nv: int) -> np.ndarray:
    """Columns (F, nv k) as (F, nv, k)."""
    return columns.reshape(len(columns), nv, columns.shape[1] // nv)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Places:
    """What each feature's middle tells (F, ...)."""

    inverse: np.ndarray  # (F, nv, nv) of the mass matrix
    bound: np.ndarray  # (F, nv) of normal forces
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
    if box[1].any():
        scale = 0.5 * (box[1] - box[0])
        matrix = np.concatenate([matrix, means.errors * scale / deviation[:, :, None]], axis=2)
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
