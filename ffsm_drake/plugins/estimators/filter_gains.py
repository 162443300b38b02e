"""Stationary gains of the Kalman estimates, from Riccati equations; see ``estimators``."""

import dataclasses
import math
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
# Largest work on the gains of late and slow sensors, in multiplications, roughly: seconds.
_LARGEST = 3e8


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


def coupled_gain(
    inverse_mass_matrix: np.ndarray,
    *,
    position_noise: np.ndarray,
    velocity_noise: np.ndarray,
    walk: np.ndarray,
    bias_walk: np.ndarray,
    sample_time: float,
) -> np.ndarray:
    """Stationary gain (3 n + m, 2 n) of a CoupledEstimator with m biases.

    Args:
      inverse_mass_matrix: block (n, n) of Hhat^-1 for the coupled coordinates.
      position_noise, velocity_noise: standard deviations of the measured e and e' (n).
      walk: intensity of the force's random walk (n), N m or N per sqrt(s).
      bias_walk: random walk of the velocities' biases (n), m of them nonzero.
      sample_time: L, s.
    """
    from scipy.linalg import solve_discrete_are

    step, size = sample_time, walk.size
    biased = np.flatnonzero(bias_walk)
    whole = 3 * size + biased.size
    response, one = -inverse_mass_matrix, np.eye(size)
    zero = np.zeros_like(one)
    # In units of acceleration, as in ``kalman_gain``.
    transition, output = np.eye(whole), np.eye(2 * size, whole)
    transition[: 3 * size, : 3 * size] = np.block(
        [[one, one, 0.5 * response], [zero, one, response], [zero, zero, one]]
    )
    output[size + biased, np.arange(3 * size, whole)] = -1.0
    sigma = np.concatenate([position_noise / step**2, velocity_noise / step])
    noise = _assumed(sigma, np.linalg.norm(response * walk, axis=1) * math.sqrt(step)) ** 2
    walks = np.concatenate([np.zeros(2 * size), walk, bias_walk[biased] / step])
    process = np.diag(walks**2 * step) / noise.min()
    of_noise = np.diag(noise / noise.min())
    covariance = solve_discrete_are(transition.T, output.T, process, of_noise)
    gain = np.linalg.solve(output @ covariance @ output.T + of_noise, output @ covariance).T
    units = np.repeat([step**2, step, 1.0, step], [size, size, size, biased.size])
    return gain * units[:, None] / units[: 2 * size]


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


def late_gains(axis: SensedAxis, *, sample_time: float) -> np.ndarray:
    """Return gains (4, 4 + sum of the delays, 2) of one coordinate of a LateKalmanEstimator, on [e,
    e', d, b, past].

    One gain per kind of sample (nothing, velocity, position, both new). If the stationary filter's
    gain differs between samples of one kind, it is the mean over the sensors' common period.
    Raises LinAlgError if that filter is unstable.
    """
    filter_ = _LateFilter.of(axis, step=sample_time)
    kinds = filter_.kinds(axis.period)
    gains = filter_.mean_gains(kinds)
    filter_.check(gains, kinds)
    return _at_present(gains, axis, step=sample_time)


# The model of e, e', d and b, in units of acceleration as in ``kalman_gain``.
_CORE = np.eye(4)
_CORE[:2, 1:3] = [[1.0, 0.5], [1.0, 1.0]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _LateFilter:
    """The filter at the time of the younger measurement, on [e, e', d, b, past]: what both are late
    by needs only prediction.
    """

    late: tuple[int, int]  # samples by which the position, or the velocity, is older
    transition: np.ndarray
    output: np.ndarray
    noise: np.ndarray  # (2) variances of the measurements, relative to the smaller
    process: np.ndarray  # likewise

    @classmethod
    def of(cls, axis: SensedAxis, *, step: float) -> "_LateFilter":
        late = axis.delay[0] - min(axis.delay), axis.delay[1] - min(axis.delay)
        size = 4 + sum(late)
        transition = np.zeros((size, size))
        transition[:4, :4] = _CORE
        if size > 4:
            transition[4, 0 if late[0] else 1] = 1.0
            transition[np.arange(5, size), np.arange(4, size - 1)] = 1.0
        output = np.zeros((2, size))
        output[0, size - 1 if late[0] else 0] = 1.0
        output[1, size - 1 if late[1] else 1] = 1.0
        output[1, 3] = -1.0 if axis.bias_walk > 0.0 else 0.0
        sigma = np.array([axis.position_noise / step**2, axis.velocity_noise / step])
        walks = np.array([axis.walk, axis.bias_walk / step]) * math.sqrt(step)
        noise = _assumed(sigma, walks[0]) ** 2
        process = np.zeros((size, size))
        process[2, 2], process[3, 3] = walks**2 / noise.min()
        noise = noise / noise.min()
        return cls(late=late, transition=transition, output=output, noise=noise, process=process)

    def kinds(self, period: tuple[int, int]) -> list[int]:
        """New measurements at each sample of the common period. Raises LinAlgError if it is too
        long.
        """
        samples, size = np.arange(math.lcm(*period)), len(self.transition)
        if (samples.size + 60) * (size**3 + 10_000) > _LARGEST:
            period_of = counted(samples.size, "sample")
            raise np.linalg.LinAlgError(
                f"a common period of {period_of} and {size} states are too many"
            )
        position, velocity = (
            (samples - late) % each == 0 for late, each in zip(self.late, period, strict=True)
        )
        found: list[int] = (2 * position + velocity).tolist()
        return found

    def mean_gains(self, kinds: list[int]) -> np.ndarray:
        """Return the stationary filter's gains (4, size, 2) by what is new: the mean over the
        period.
        """
        covariance, sums = self._stationary(kinds), np.zeros((4, *self.output.T.shape))
        for kind in kinds:
            seen = np.flatnonzero([kind // 2, kind % 2])
            of = self.output[seen]
            innovation = of @ covariance @ of.T + np.diag(self.noise[seen])
            gain = np.linalg.solve(innovation, of @ covariance).T
            sums[kind][:, seen] += gain
            covariance = covariance - gain @ of @ covariance
            covariance = self.transition @ covariance @ self.transition.T + self.process
        return sums / np.maximum(np.bincount(kinds, minlength=4), 1)[:, None, None]

    def _stationary(self, kinds: list[int]) -> np.ndarray:
        """Return the covariance before the first sample of the common period."""
        one, output = np.eye(len(self.transition)), self.output
        whole = _Riccati(one, 0.0 * one, 0.0 * one)
        for kind in kinds:
            information = output.T * ([kind // 2, kind % 2] / self.noise) @ output
            whole = whole.then(_Riccati(self.transition, information, self.process))
        for _ in range(60):
            before, whole = whole.h, whole.then(whole)
            if np.allclose(whole.h, before, rtol=1e-12, atol=0.0):
                break
        return whole.h

    def check(self, gains: np.ndarray, kinds: list[int]) -> None:
        """Raise LinAlgError if the filter with these gains is unstable."""
        error = one = np.eye(len(self.transition))
        for kind in kinds:
            error = self.transition @ (one - gains[kind] @ self.output) @ error
        if not self.output[1, 3]:  # no bias is measured
            error = np.delete(np.delete(error, 3, axis=0), 3, axis=1)
        if not np.abs(np.linalg.eigvals(error)).max() < 1.0:
            raise np.linalg.LinAlgError("the mean gains of its slow sensors are unstable")


def _at_present(gains: np.ndarray, axis: SensedAxis, *, step: float) -> np.ndarray:
    """Return gains of the present, and of all that was, from those (4, size, 2) at the time of the
    younger measurement; in SI units.
    """
    common = min(axis.delay)
    steps = [np.linalg.matrix_power(_CORE, count) @ gains[:, :4] for count in range(common + 1)]
    rows, first = [steps[common]], 4
    for entry, lag in enumerate(axis.delay):
        rows += [steps[common - j][:, entry : entry + 1] for j in range(1, min(lag, common) + 1)]
        rows += [gains[:, first : first + lag - common]]
        first += lag - common
    units = np.array([step**2, step])
    sizes = np.concatenate([units, [1.0, step], np.repeat(units, axis.delay)])
    return np.concatenate(rows, axis=1) * sizes[:, None] / units


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
