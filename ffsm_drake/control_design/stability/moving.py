"""The linear verdict on a whole motion: the loop at instants chosen along it, and the growth of
errors between them.

A loop that is stable at rest at both ends, and at a few postures between, may be unstable on the
way: where a coordinate becomes light, or where a gain no longer suits the posture. The instants are
five fractions of the motion and those at which a coordinate is lightest. Between them they are
bisected where the spectral radius crosses 1, and where the fast modes, which a slow pole hides in
the spectral radius, are weakly damped or change; the unstable stretch is refined until its growth
is known.
"""

import dataclasses
import itertools
import math
from collections.abc import Mapping

import numpy as np

from ffsm_drake.control_design.stability.linear_loop import LinearLoop
from ffsm_drake.control_design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.control_design.stability.planned_dynamics import PlannedDynamics

LARGE_GROWTH = 100.0  # error growth from which on a motion counts as unstable
_POINTS = 101  # instants at which the lightest coordinates are sought
# Fast radius, and its change between two instants, above which they are bisected.
_FAST, _CHANGE = 0.7, 0.15
# Shortest distances between instants, as shares of the motion: of stable and unstable stretches.
_COARSE, _FINE = 0.05, 0.01


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
        times = np.array([loop.time for loop in self.loops])
        radius = np.array([loop.spectral_radius for loop in self.loops])
        if not np.isfinite(radius).all():
            return math.inf
        rates = np.log(np.maximum(radius, 1e-300)) / self.loops[0].sample_time
        grid = np.linspace(times[0], times[-1], 10 * _POINTS)
        rate = np.interp(grid, times, rates)
        total = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(grid))]
        exponent = float((total - np.minimum.accumulate(total)).max())
        return math.exp(exponent) if exponent < 700.0 else math.inf

    @property
    def is_stable(self) -> bool:
        """Whether the loop is stable at both ends, and errors grow little on the way."""
        ends = self.loops[0].spectral_radius, self.loops[-1].spectral_radius
        return max(ends) < 1.0 and self.growth < LARGE_GROWTH


def motion_stability(
    linearizer: Linearizer, *, held: Mapping[str, np.ndarray] | None = None
) -> MotionStability:
    """The loop along a linearizer's planned motion, moving as planned.

    Args: the linearizer; held memory, as for ``Linearizer.at``, which raises the same errors.
    """
    planned = PlannedDynamics(linearizer.given)
    span, found = linearizer.end - linearizer.begin, dict[float, LinearLoop]()

    def add(time: float) -> None:
        found[time] = linearizer.at(time, held=held)

    lightest = _lightest(planned, np.linspace(linearizer.begin, linearizer.end, _POINTS))
    for time in sorted({*map(linearizer.part, POSTURES), *lightest}):
        if all(abs(time - other) > _FINE * span for other in found):
            add(time)
    pairs = _pairs(found)
    while pairs:
        first, second = pairs.pop()
        if _is_bisected(found[first], found[second], (second - first) / span):
            middle = 0.5 * (first + second)
            add(middle)
            pairs += [(first, middle), (middle, second)]
    while MotionStability(loops=_ordered(found)).growth < LARGE_GROWTH:
        wide = [
            (first, second)
            for first, second in _pairs(found)
            if second - first > _FINE * span
            and max(found[first].spectral_radius, found[second].spectral_radius) >= 1.0
        ]
        if not wide:
            break
        for first, second in wide:
            add(0.5 * (first + second))
    return MotionStability(loops=_ordered(found))


def _lightest(planned: PlannedDynamics, times: np.ndarray) -> list[float]:
    """Those of some times, s, at which a driven coordinate is lightest, the others free to
    react.
    """
    driven = planned.coordinates.driven
    inverse = np.array([
        np.diagonal(np.linalg.inv(planned.mass_matrices(time)[0]))[driven] for time in times
    ])  # fmt: skip
    found: list[float] = times[np.unique(inverse.argmax(axis=0))].tolist()
    return found


def _is_bisected(first: LinearLoop, second: LinearLoop, share: float) -> bool:
    """Whether the loop is needed between two instants a share of the motion apart."""
    crosses = (first.spectral_radius < 1.0) is not (second.spectral_radius < 1.0)
    fast = first.fast_radius, second.fast_radius
    ringing = max(fast) > _FAST or abs(fast[0] - fast[1]) > _CHANGE
    return share > _COARSE and (crosses or ringing)


def _ordered(found: Mapping[float, LinearLoop]) -> tuple[LinearLoop, ...]:
    return tuple(found[time] for time in sorted(found))


def _pairs(found: Mapping[float, LinearLoop]) -> list[tuple[float, float]]:
    return list(itertools.pairwise(sorted(found)))
