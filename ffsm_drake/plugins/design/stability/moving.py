"""The linear verdict on a whole motion: the loop at instants chosen along it, and the growth of
errors between them.

A loop may be stable at rest at both ends, and at a few postures between, and unstable on the way:
at postures with a light coordinate, or unsuited to a gain. The instants are five fractions of the
motion and the instants of least inertia of each coordinate. They are bisected between values of the
spectral radius on both sides of 1, and between instants with changing or weakly damped fast modes
(a slow pole may hide these in the spectral radius); then where the growth is most uncertain, until
it is clear whether errors grow little or much.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping

import numpy as np

from ffsm_drake.common.numbers import rounded_up
from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer

# Least reported error growth, and the growth from which a motion counts as unstable.
GROWN, LARGE_GROWTH = 1.5, 100.0
_POINTS = 1010  # instants at which rates are interpolated
# Fast radius, and its changes between two instants, above which they are bisected: above _FAST a
# small change suffices.
_FAST, _SMALL_CHANGE, _CHANGE = 0.7, 0.02, 0.15
# Shortest distances between instants, as shares of the motion: of those where a coordinate is
# lightest, of stable stretches, and where errors grow.
_APART, _COARSE, _FINE = 0.03, 0.05, 0.01


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotionStability:
    """The linearised loop at instants along a motion."""

    loops: tuple[LinearLoop, ...]  # in the order of time

    @property
    def worst(self) -> LinearLoop:
        """The loop with the largest spectral radius."""
        return max(self.loops, key=lambda loop: loop.spectral_radius)

    @property
    def growth(self) -> float:
        """Growth of small errors over the worst stretch of the motion, at least 1: the exponential
        of the integral of ln rho / L, rho being the spectral radius.
        """
        return self._growth(lambda grid: np.interp(grid, self.times, self.rates))

    @property
    def growth_bound(self) -> float:
        """The growth if between two instants their larger rate held, with their difference added:
        more than is likely.
        """
        if len(self.loops) < 2:
            return self.growth
        return self._growth(
            lambda grid: self.rate_bounds[
                np.clip(np.searchsorted(self.times, grid, side="right") - 1, 0, len(self.loops) - 2)
            ]
        )

    @property
    def growing(self) -> str:
        """The growth in words, with its bound if that is informative."""
        most = (
            f" (cautious estimate {rounded_up(self.growth_bound, 2):.2g})"
            if self.growth_bound < LARGE_GROWTH
            else ""
        )
        return f"grow {self.growth:.2g} times{most}"

    @property
    def times(self) -> np.ndarray:
        """The instants (n), s."""
        return np.array([loop.time for loop in self.loops])

    @property
    def rates(self) -> np.ndarray:
        """ln rho / L (n), 1/s."""
        radius = np.array([loop.spectral_radius for loop in self.loops])
        return np.log(np.maximum(radius, 1e-300)) / self.loops[0].sample_time

    @property
    def rate_bounds(self) -> np.ndarray:
        """The rates of ``growth_bound`` (n - 1), 1/s."""
        rates = self.rates
        return np.maximum(rates[1:], rates[:-1]) + np.abs(np.diff(rates))

    def _growth(self, rate_at: Callable[[np.ndarray], np.ndarray]) -> float:
        if not np.isfinite(self.rates).all():
            return math.inf
        grid = np.linspace(self.times[0], self.times[-1], _POINTS)
        rate = rate_at(grid)
        total = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(grid))]
        exponent = float((total - np.minimum.accumulate(total)).max())
        return math.exp(exponent) if exponent < 700.0 else math.inf


def motion_stability(
    linearizer: Linearizer, *, held: Mapping[str, np.ndarray] | None = None
) -> MotionStability:
    """The loop along a linearizer's planned motion, moving as planned.

    Args:
      linearizer: the linearizer.
      held: held memory, see ``Linearizer.at``. Errors are also the same.
    """
    span, found = linearizer.end - linearizer.begin, dict[float, LinearLoop]()

    def add(time: float) -> None:
        found[time] = linearizer.at(time, held=held)

    for time in map(linearizer.part, POSTURES):
        add(time)
    for time in linearizer.lightest:
        if all(abs(time - other) > _APART * span for other in found):
            add(time)
    pairs = list(itertools.pairwise(sorted(found)))
    while pairs:
        first, second = pairs.pop()
        if _is_bisected(found[first], found[second], (second - first) / span):
            middle = 0.5 * (first + second)
            add(middle)
            pairs += [(first, middle), (middle, second)]
    while True:
        motion = MotionStability(loops=tuple(found[time] for time in sorted(found)))
        next_one = _least_known(motion, sorted(found), _FINE * span)
        if next_one is None:
            return motion
        add(next_one)


def _is_bisected(first: LinearLoop, second: LinearLoop, share: float) -> bool:
    """Whether the loop is needed between two instants a share of the motion apart."""
    crosses = (first.spectral_radius < 1.0) is not (second.spectral_radius < 1.0)
    fast = first.fast_radius, second.fast_radius
    allowed = _SMALL_CHANGE if max(fast) > _FAST else _CHANGE
    return share > _COARSE and (crosses or abs(fast[0] - fast[1]) > allowed)


def _least_known(motion: MotionStability, times: list[float], shortest: float) -> float | None:
    """The middle, s, of the interval with the most uncertain growth; None if it is short, or if it
    is clear whether errors grow little or much.

    Args:
      motion: the loops.
      times: requested times of the loops, in their order.
      shortest: shortest interval.
    """
    growth, bound = motion.growth, motion.growth_bound
    if bound <= GROWN or growth > LARGE_GROWTH or (growth > GROWN and bound < 2.0 * growth):
        return None
    steps, rates = np.diff(times), motion.rates
    unknown = np.maximum(motion.rate_bounds, 0.0) - np.maximum(0.5 * (rates[1:] + rates[:-1]), 0.0)
    unknown = np.where(steps > shortest, steps * unknown, 0.0)
    worst = int(np.argmax(unknown))
    return None if unknown[worst] <= 0.0 else float(times[worst] + 0.5 * steps[worst])
