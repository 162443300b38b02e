"""Faults of thrusters: evidence in a window of unexplained motion, as functions of arrays.

The unexplained velocity is Y(t) = sum (dv - L H^-1 (tau - C)), with the reported force tau and H
and C of a model's masses. Without faults it consists of noise and of bounded effects:

- a disturbance of at most D in each coordinate, of any frequency up to a highest one;
- masses between those of a light, the nominal and a heavy model: Y lies between theirs.

In the axes of such disturbances (``_axes``) each number of Y is then within an interval about the
noise; an excess is evidence of a fault. If thruster i fires without a command, Y grows by
theta a_i (F_i t - I_i); if its force is too low, by -theta a_i I_i (a_i: acceleration of its unit
force; I_i: commanded impulse; F_i: its force). The score of such a hypothesis is the reduction,
with its best theta, of the sum of squares beyond the intervals of the base's coordinates.

The force that holds a jammed joint j moves the base, too: Y grows by H^-1 e_j s(t), with any s. A
thruster is named only if its force explains more than this does for every joint that stands still,
in all coordinates.
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.actuators.thruster_faults import LEAKING, STUCK_OFF, STUCK_ON, WEAK
from ffsm_drake.plugins.faults.windows import between, times_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

LEAST_LEAK, LEAST_LOSS, WHOLE = 0.08, 0.3, 0.75  # least shares theta: leak, loss, complete
_MARGIN = 9.0  # least margin between the scores of an isolated thruster and of all others
_LEFT = 2.0  # largest unexplained rest: times its share of the noise, or the explained part
_SHARES = np.array([0.08, 0.12, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])  # theta
_HALVINGS = 40  # of the interval of a jam's force
_FREQUENCIES = 24  # number of frequencies of the disturbances evaluated
# consecutive evaluations that name the same thruster; share of the threshold required in them:
# residuals that are not white stay within bounds
CONFIRMED, _ASKED = 4, 0.6


@dataclasses.dataclass(frozen=True, kw_only=True)
class Suspicion:
    """The best hypothesis on thrusters."""

    explained: float  # squares of standard deviations
    is_isolated: bool  # a single thruster that explains the observation
    thruster: int
    kind: str
    theta: float


@functools.lru_cache(maxsize=16)
def _axes(count: int, step: float, band: float) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal axes, as columns (count, count - 1), of values (count) without their mean, s
    apart, and the largest share (count - 1) that the integral of a sine of amplitude 1 and of a
    frequency up to ``band``, rad/s, has along each.
    """
    time = times_of(count, step)[:, None]
    frequency = np.linspace(0.0, band, _FREQUENCIES + 1)[1:]
    cosine = -np.cos(frequency * time) / frequency
    # frequency 0: a constant force
    waves = np.hstack([time, np.sin(frequency * time) / frequency, cosine - cosine.mean(axis=0)])
    axes = np.linalg.svd(waves - waves.mean(axis=0))[0][:, : count - 1]
    # an axis of rounding errors may hold some of the mean
    axes = np.linalg.qr(axes - axes.mean(axis=0))[0]
    along = axes.T @ waves
    sines, cosines = np.split(along[:, 1:], 2, axis=1)
    largest = np.maximum(np.abs(along[:, 0]), np.hypot(sines, cosines).max(axis=1))
    return axes, largest


def suspect(
    unexplained: np.ndarray,
    told: np.ndarray,
    *,
    pushes: np.ndarray,
    force: np.ndarray,
    bound: np.ndarray,
    noise: np.ndarray,
    in_use: np.ndarray,
    step: float,
    band: float,
    holds: np.ndarray,
) -> Suspicion:
    """The best hypothesis on thrusters for a window of blocks.

    Args:
      unexplained: Y of the blocks (m, models, nv), rad/s and m/s.
      told: commanded impulses of the blocks (m, n), N s.
      pushes: a (nv, n).
      force: F (n), N.
      bound: largest acceleration of a disturbance (nv).
      noise: standard deviation of Y's noise (nv).
      in_use: thrusters to be examined (n).
      step: time between blocks, s.
      band: largest frequency of a disturbance, rad/s.
      holds: accelerations (nv, joints) by unit forces on the joints that stand still.
    """
    time = times_of(len(unexplained), step)
    axes, largest = _axes(len(unexplained), step, band)
    of_models = np.tensordot(axes.T, unexplained, axes=1) / noise  # (m - 1, models, nv)
    room = largest[:, None] * (bound / noise)
    low, high = between(of_models.swapaxes(0, 1))
    low, high = low - room, high + room
    shapes = axes.T @ np.hstack([time[:, None] * force - told, -told])  # (m - 1, 2 n)
    signature = shapes[:, None] * (np.tile(pushes, 2) / noise[:, None])  # (m - 1, nv, 2 n)
    squares = _beyond(low, high, _SHARES, signature)
    return _best(low, high, squares, in_use=in_use, holds=holds / noise[:, None])


def _best(
    low: np.ndarray, high: np.ndarray, squares: np.ndarray, *, in_use: np.ndarray, holds: np.ndarray
) -> Suspicion:
    """The hypothesis that leaves the least squares (thetas, nv, 2 n) beyond the intervals."""
    base, count = slice(NUM_BASE_VELOCITIES), in_use.size
    at_rest = _beyond(low, high, np.zeros(1), np.zeros((*low.shape, 1)))[0, :, 0]
    total = float(at_rest[base].sum())
    explained = total - squares[:, base].sum(axis=1)  # (thetas, 2 n)
    least = np.repeat([LEAST_LEAK, LEAST_LOSS], count)
    explained[(_SHARES[:, None] < least) | ~np.tile(in_use, 2)] = 0.0
    theta, best = np.unravel_index(int(explained.argmax()), explained.shape)
    most, share = float(explained[theta, best]), float(_SHARES[theta])
    others = explained[:, np.tile(np.arange(count), 2) != best % count]
    is_clear = most - others.max(initial=0.0) > _MARGIN
    is_enough = total - most < max(_LEFT * low[:, base].size, most)
    left = float(squares[..., best].sum(axis=1).min())
    is_no_jam = (_left_by_jams(low, high, holds) > left + _MARGIN).all()
    whole, some = (STUCK_ON, LEAKING) if best < count else (STUCK_OFF, WEAK)
    return Suspicion(
        explained=most,
        is_isolated=bool(is_clear and is_enough and is_no_jam),
        thruster=int(best) % count,
        kind=(whole if share > WHOLE else some).name,
        theta=share,
    )


def confirmed(suspicions: Sequence[Suspicion], looks: np.ndarray, threshold: float) -> str:
    """The kind of a fault of the thruster that the last of some windows names, if enough
    consecutive evaluations have named it; empty: not yet.

    It is that of the best explanation in the windows: before and after a fault's start two kinds
    differ by a constant force. ``looks`` (n): evaluations that have named each thruster, updated.
    """
    found = suspicions[-1]
    before, looks[:] = looks[found.thruster], 0.0
    if found.explained <= (_ASKED * threshold) ** 2 or not found.is_isolated:
        return ""
    looks[found.thruster] = before + 1.0
    if looks[found.thruster] < CONFIRMED:
        return ""
    same = [each for each in suspicions if each.thruster == found.thruster]
    return max(same, key=lambda each: each.explained).kind


def _beyond(low: np.ndarray, high: np.ndarray, theta: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Sums of squares beyond the intervals (thetas, nv, hypotheses) with shares ``theta`` of the
    motion ``of`` hypotheses (m - 1, nv, hypotheses) taken off.
    """
    taken = theta[:, None, None, None] * of
    outside = np.maximum(low[..., None] - taken, 0.0) + np.maximum(taken - high[..., None], 0.0)
    squares: np.ndarray = (outside**2).sum(axis=1)
    return squares


def _left_by_jams(low: np.ndarray, high: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Least sums of squares (joints) beyond the intervals (m - 1, nv) with the force of a jam
    along (nv, joints): one of any size on each axis, by halving the interval of its sizes.
    """

    def missing(sizes: np.ndarray) -> np.ndarray:
        taken = sizes[:, None] * along
        found: np.ndarray = np.maximum(low[..., None] - taken, 0.0) - np.maximum(
            taken - high[..., None], 0.0
        )
        return found  # (m - 1, nv, joints)

    far = np.maximum(np.abs(low), np.abs(high)).max() / np.abs(along).max(axis=0, initial=0.0)
    first = np.broadcast_to(-far, (len(low), along.shape[1]))
    last = -first
    for _ in range(_HALVINGS):
        middle = 0.5 * (first + last)
        more = (missing(middle) * along).sum(axis=1) > 0.0
        first, last = np.where(more, middle, first), np.where(more, last, middle)
    left: np.ndarray = (missing(0.5 * (first + last)) ** 2).sum(axis=(0, 1))
    return left
