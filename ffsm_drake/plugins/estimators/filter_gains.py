"""Stationary gains of the Kalman estimates, from Riccati equations; see ``estimators``."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import counted

# Least noise of a measurement, in units of acceleration, as a fraction of the larger of the other
# measurement's and the walk's: below it double precision cannot solve the Riccati equation.
SMALLEST_RATIO = 1e-7
# Least noise of a position in the same units, as a fraction of the smaller of the velocity's and
# the walk's. Held forces move sampled positions with a zero at z = -1: the filter of exact ones has
# a pole there, and any error of the model makes the loop alternate; here it stays above -0.7.
_OF_POSITION = 0.1
# Largest work on the gains of a filter of late and slow sensors, in multiplications, roughly: a
# second.
_LARGEST = 3e8
_REFINED = 60  # common periods in which the covariance becomes exact


@memoized(maxsize=64)  # shared by equal coordinates, and by all loops of a search for a boundary
def kalman_gain(
    *, position_noise: float, velocity_noise: float, walk: float, sample_time: float
) -> np.ndarray:
    """Stationary gain (3, 2) of one coordinate's filter.

    Args:
      position_noise, velocity_noise: standard deviations of the measured e and e'.
      walk: intensity of N's random walk, its standard deviation after one second, rad/s^2 or m/s^2
        per sqrt(s).
      sample_time: L, s.
    """
    from scipy.linalg import solve_discrete_are

    step = sample_time
    # In units of acceleration ([L^2, L, 1]) every entry is of order one; SI units scale badly.
    transition = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    output = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    sigma = np.array([position_noise / step**2, velocity_noise / step])
    noise = _assumed(sigma, walk * np.sqrt(step)) ** 2
    scale = noise.min()
    process = np.diag([0.0, 0.0, walk**2 * step]) / scale
    covariance = solve_discrete_are(transition.T, output.T, process, np.diag(noise / scale))
    gain = (
        covariance
        @ output.T
        @ np.linalg.inv(output @ covariance @ output.T + np.diag(noise / scale))
    )
    size = np.array([step**2, step, 1.0])
    return gain * size[:, None] / size[:2]


def _assumed(sigma: np.ndarray, walk: Any) -> np.ndarray:
    """Noises (2 n) of positions and velocities that a filter can have, from given ones and the
    walk's (n) in a sample, all in units of acceleration.
    """
    position, velocity = np.split(sigma, 2)
    position = np.maximum(position, _OF_POSITION * np.minimum(velocity, walk))
    least = SMALLEST_RATIO * max(sigma.max(), np.max(walk))
    return np.maximum(np.concatenate([position, velocity]), least)


@dataclasses.dataclass(frozen=True)
class SensedAxis:
    """Noise assumptions of a filter for one coordinate."""

    position_noise: float  # standard deviations of the measured e and e'
    velocity_noise: float
    walk: float  # intensity of N's random walk, per sqrt(s)
    bias_walk: float = 0.0  # random walk of the velocity's bias; 0: none is estimated
    period: tuple[int, int] = (1, 1)  # periods of position and velocity, control samples
    delay: tuple[int, int] = (0, 0)

    @property
    def is_prompt(self) -> bool:
        """Whether its measurements are new at every sample, at once."""
        return self.period == (1, 1) and self.delay == (0, 0)

    @property
    def is_plain(self) -> bool:
        """Whether they are, and without bias."""
        return self.is_prompt and self.bias_walk == 0.0


class SensedGains(NamedTuple):
    """Stationary gains of a filter of n coordinates by what is new at a sample."""

    kinds: np.ndarray  # (k, 2 n) the new measurements of [e, e'] that occur together
    gains: np.ndarray  # (m, k, 4 n + sum of the delays, 2 n) on [e, e', d, b, past], SI units


def sensed_gains(
    axes: Sequence[SensedAxis], *, responses: np.ndarray, sample_time: float
) -> SensedGains:
    """Return the gains of filters of n coordinates together, which differ by their ``responses``.

    A walk d accelerates the coordinates by R d. If the gain of a stationary filter differs between
    samples with the same new measurements, it is the mean over the common period of the sensors.

    Args:
      axes: noise assumptions (n); their ``walk`` is the walk of d.
      responses: R (m, n, n), one filter for each.
      sample_time: L, s.

    Raises LinAlgError if such a filter is unstable or too large.
    """
    step, found = sample_time, list[np.ndarray]()
    filters = [_SensedFilter.of(axes, response, step=step) for response in responses]
    new = filters[0].new_measurements(axes)
    kinds, kind_of = np.unique(new, axis=0, return_inverse=True)
    order = kind_of.ravel().tolist()
    for filter_ in filters:
        gains = filter_.mean_gains(kinds, order)
        filter_.check(gains, order)
        found.append(_at_present(gains, filter_, axes, step=step))
    return SensedGains(kinds, np.array(found))


def _delays(axes: Sequence[SensedAxis]) -> np.ndarray:
    """The delays (2 n) of [e, e'], control samples."""
    return np.array([axis.delay for axis in axes]).T.ravel()


@dataclasses.dataclass(frozen=True, kw_only=True)
class _SensedFilter:
    """The filter at the time of the youngest measurement, on [e, e', d, b, past]: what all are late
    by needs only prediction. In units of acceleration, as in ``kalman_gain``.
    """

    core: np.ndarray  # (4 n, 4 n) the model of [e, e', d, b]
    late: np.ndarray  # (2 n) samples by which the measurement of [e, e'] is older
    transition: np.ndarray
    output: np.ndarray
    noise: np.ndarray  # (2 n) variances of the measurements, relative to the smallest
    process: np.ndarray  # likewise

    @classmethod
    def of(
        cls, axes: Sequence[SensedAxis], response: np.ndarray, *, step: float
    ) -> "_SensedFilter":
        count, delays = len(axes), _delays(axes)
        late = delays - delays.min()
        core = np.kron(np.array([[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
                       np.eye(count))  # fmt: skip
        core[:count, 2 * count : 3 * count] = 0.5 * response
        core[count : 2 * count, 2 * count : 3 * count] = response
        size = 4 * count + int(late.sum())
        transition, output = np.zeros((size, size)), np.zeros((2 * count, size))
        transition[: 4 * count, : 4 * count] = core
        first = 4 * count
        for entry, lag in enumerate(late.tolist()):
            chain = [entry, *range(first, first + lag)]
            transition[chain[1:], chain[:-1]] = 1.0
            output[entry, chain[-1]] = 1.0
            first += lag
        of_bias = np.array([axis.bias_walk for axis in axes])
        for k in np.flatnonzero(of_bias):
            output[count + k, 3 * count + k] = -1.0
        position, velocity, walk = np.array(
            [[axis.position_noise, axis.velocity_noise, axis.walk] for axis in axes]
        ).T
        sigma = np.concatenate([position / step**2, velocity / step])
        of_walk = walk * math.sqrt(step)
        noise = _assumed(sigma, np.linalg.norm(response * of_walk, axis=1)) ** 2
        process = np.zeros((size, size))
        walks = np.concatenate([of_walk, of_bias / step * math.sqrt(step)])
        own = np.arange(2 * count, 4 * count)
        process[own, own] = walks**2 / noise.min()
        noise = noise / noise.min()
        return cls(
            core=core, late=late, transition=transition, output=output, noise=noise, process=process
        )

    def new_measurements(self, axes: Sequence[SensedAxis]) -> np.ndarray:
        """New measurements (samples, 2 n) at each sample of the common period. Raises LinAlgError
        if it is too long.
        """
        periods = np.array([axis.period for axis in axes]).T.ravel()
        samples, size = np.arange(math.lcm(*periods.tolist())), len(self.transition)
        if (samples.size + 60) * (size**3 + 10_000) > _LARGEST:
            period_of = counted(samples.size, "sample")
            raise np.linalg.LinAlgError(
                f"a common period of {period_of} and {size} states are too many"
            )
        new: np.ndarray = (samples[:, None] - self.late) % periods == 0
        return new

    def mean_gains(self, kinds: np.ndarray, order: Sequence[int]) -> np.ndarray:
        """Return the gains (k, size, 2 n) of the stationary filter by what is new: the mean over
        the period, whose samples have ``kinds`` in this ``order``.
        """
        covariance = self._stationary(kinds[order])
        sums = np.zeros((len(kinds), *self.output.T.shape))
        for kind in order:
            gain, covariance = self._next(kinds[kind], covariance)
            sums[kind] += gain
        mean: np.ndarray = sums / np.bincount(order)[:, None, None]
        return mean

    def _next(self, new: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The gain (size, 2 n) of a sample, and the covariance before the next one."""
        seen, gain = np.flatnonzero(new), np.zeros(self.output.T.shape)
        of = self.output[seen]
        innovation = of @ covariance @ of.T + np.diag(self.noise[seen])
        gain[:, seen] = np.linalg.solve(innovation, of @ covariance).T
        covariance = covariance - gain[:, seen] @ of @ covariance
        return gain, self.transition @ covariance @ self.transition.T + self.process

    def _stationary(self, new: np.ndarray) -> np.ndarray:
        """Return the covariance before the first sample of the common period."""
        one, output = np.eye(len(self.transition)), self.output
        whole = _Riccati(one, 0.0 * one, 0.0 * one)
        for each in new:
            information = output.T * (each / self.noise) @ output
            whole = whole.then(_Riccati(self.transition, information, self.process))
        for _ in range(60):
            before, whole = whole.h, whole.then(whole)
            if _is_close(whole.h, before):
                break
        # Doubling loses digits of a walk that is much larger than the noise; the filter itself
        # forgets such an error.
        covariance = whole.h
        for _ in range(_REFINED):
            before = covariance
            for each in new:
                covariance = self._next(each, covariance)[1]
            covariance = 0.5 * (covariance + covariance.T)
            if _is_close(covariance, before):
                break
        return covariance

    def check(self, gains: np.ndarray, order: Sequence[int]) -> None:
        """Raise LinAlgError if the filter with these gains is unstable."""
        error = one = np.eye(len(self.transition))
        for kind in order:
            error = self.transition @ (one - gains[kind] @ self.output) @ error
        count = len(self.core) // 4
        unbiased = np.flatnonzero(~self.output[:, 3 * count : 4 * count].any(axis=0)) + 3 * count
        error = np.delete(np.delete(error, unbiased, axis=0), unbiased, axis=1)
        if not np.abs(np.linalg.eigvals(error)).max() < 1.0:
            raise np.linalg.LinAlgError("the mean gains of its slow sensors are unstable")


def _at_present(
    gains: np.ndarray, filter_: _SensedFilter, axes: Sequence[SensedAxis], *, step: float
) -> np.ndarray:
    """Return gains of the present, and of all that was, from those (k, size, 2 n) at the time of
    the youngest measurement; in SI units.
    """
    delays, count = _delays(axes), len(axes)
    common, first = int(delays.min()), 4 * count
    steps = [
        np.linalg.matrix_power(filter_.core, power) @ gains[:, :first]
        for power in range(common + 1)
    ]
    rows = [steps[common]]
    for entry, lag in enumerate(delays.tolist()):
        rows += [steps[common - j][:, entry : entry + 1] for j in range(1, min(lag, common) + 1)]
        rows += [gains[:, first : first + lag - common]]
        first += lag - common
    units = np.repeat([step**2, step], count)
    sizes = np.concatenate([units, np.repeat([1.0, step], count), np.repeat(units, delays)])
    return np.concatenate(rows, axis=1) * sizes[:, None] / units


def _is_close(covariance: np.ndarray, before: np.ndarray) -> bool:
    """Whether a covariance no longer changes."""
    size = np.sqrt(np.maximum(np.diag(before), 0.0))  # but for rounding
    return bool((np.abs(covariance - before) <= 1e-12 * size * size[:, None]).all())


class _Riccati(NamedTuple):
    """The map P -> h + a P (1 + g P)^-1 a^T of a covariance; maps compose."""

    a: np.ndarray
    g: np.ndarray
    h: np.ndarray

    def then(self, other: "_Riccati") -> "_Riccati":
        """Return the composition: this map, then the other."""
        inverse = np.linalg.inv(np.eye(len(self.a)) + self.h @ other.g)
        g = self.g + self.a.T @ other.g @ inverse @ self.a
        h = other.h + other.a @ inverse @ self.h @ other.a.T
        return _Riccati(other.a @ inverse @ self.a, 0.5 * (g + g.T), 0.5 * (h + h.T))
