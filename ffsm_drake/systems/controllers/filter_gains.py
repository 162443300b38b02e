"""Stationary gains of the Kalman estimates, from Riccati equations; see ``estimators``."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

# Least noise of a measurement, in units of acceleration, as a fraction of the larger of the other
# measurement's and the walk's: below it double precision cannot solve the Riccati equation.
SMALLEST_RATIO = 1e-7
# Largest work on the gains of late and slow sensors, in multiplications, roughly: seconds.
_LARGEST = 3e8


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
    noise = np.maximum(sigma, SMALLEST_RATIO * max(*sigma, walk * np.sqrt(step))) ** 2
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


def coupled_gain(
    inverse_mass_matrix: np.ndarray,
    *,
    position_noise: np.ndarray,
    velocity_noise: np.ndarray,
    walk: np.ndarray,
    sample_time: float,
) -> np.ndarray:
    """Stationary gain (3 n, 2 n) of a CoupledEstimator.

    Args:
      inverse_mass_matrix: block (n, n) of Hhat^-1 for the coupled coordinates.
      position_noise, velocity_noise: standard deviations of the measured e and e' (n).
      walk: intensity of the force's random walk (n), N m or N per sqrt(s).
      sample_time: L, s.
    """
    from scipy.linalg import solve_discrete_are

    step, size = sample_time, walk.size
    response, one = -inverse_mass_matrix, np.eye(size)
    zero = np.zeros_like(one)
    # In units of acceleration, as in ``kalman_gain``.
    transition = np.block([[one, one, 0.5 * response], [zero, one, response], [zero, zero, one]])
    output = np.eye(2 * size, 3 * size)
    sigma = np.concatenate([position_noise / step**2, velocity_noise / step])
    fastest = float(np.abs(response @ walk).max()) * math.sqrt(step)
    noise = np.maximum(sigma, SMALLEST_RATIO * max(float(sigma.max()), fastest)) ** 2
    process = np.zeros((3 * size, 3 * size))
    process[2 * size :, 2 * size :] = np.diag(walk**2 * step) / noise.min()
    of_noise = np.diag(noise / noise.min())
    covariance = solve_discrete_are(transition.T, output.T, process, of_noise)
    gain = np.linalg.solve(output @ covariance @ output.T + of_noise, output @ covariance).T
    units = np.repeat([step**2, step, 1.0], size)
    return gain * units[:, None] / units[: 2 * size]


@dataclasses.dataclass(frozen=True)
class LateAxis:
    """One coordinate's sensors and model, for ``late_gains``."""

    position_noise: float  # standard deviations of the measured e and e'
    velocity_noise: float
    walk: float  # intensity of N's random walk, per sqrt(s)
    bias_walk: float  # that of the velocity's bias; 0: none is estimated
    period: tuple[int, int]  # of position and velocity, control samples
    delay: tuple[int, int]


def late_gains(axis: LateAxis, *, sample_time: float) -> np.ndarray:
    """Gains (4, 4 + sum of the delays, 2) of one coordinate of a LateKalmanEstimator, on [e, e', d,
    b, past].

    One gain per kind of sample (nothing, velocity, position, both new). If the stationary filter's
    gain differs between samples of one kind, it is the mean over the sensors' common period.
    Raises LinAlgError if that filter is unstable.
    """
    step, (lag_e, lag_v) = sample_time, axis.delay
    common = min(axis.delay)
    extra = lag_e - common, lag_v - common  # one of them is 0
    size = 4 + sum(extra)
    # In units of acceleration, as in ``kalman_gain``. The measurements' common delay needs only
    # prediction: the filter runs at the time of the younger measurement.
    core = np.array(
        [[1.0, 1.0, 0.5, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    )
    transition = np.zeros((size, size))
    transition[:4, :4] = core
    if size > 4:
        transition[4, 0 if extra[0] else 1] = 1.0
        transition[np.arange(5, size), np.arange(4, size - 1)] = 1.0
    output = np.zeros((2, size))
    output[0, size - 1 if extra[0] else 0] = 1.0
    output[1, size - 1 if extra[1] else 1] = 1.0
    output[1, 3] = -1.0 if axis.bias_walk > 0.0 else 0.0
    sigma = np.array([axis.position_noise / step**2, axis.velocity_noise / step])
    walks = np.array([axis.walk, axis.bias_walk / step]) * math.sqrt(step)
    noise = np.maximum(sigma, SMALLEST_RATIO * max(*sigma, walks[0])) ** 2
    process = np.zeros((size, size))
    process[2, 2], process[3, 3] = walks**2 / noise.min()
    noise = noise / noise.min()

    samples = np.arange(math.lcm(*axis.period))
    if (samples.size + 60) * (size**3 + 10_000) > _LARGEST:
        raise np.linalg.LinAlgError(
            f"a common period of {samples.size} samples and {size} states are too many"
        )
    new = np.stack(
        [(samples - late) % period == 0 for late, period in zip(extra, axis.period, strict=True)],
        axis=1,
    )
    kinds = 2 * new[:, 0] + new[:, 1]
    information = {
        kind: output.T * ([kind // 2, kind % 2] / noise) @ output for kind in set(kinds.tolist())
    }
    whole = _Riccati(np.eye(size), np.zeros((size, size)), np.zeros((size, size)))
    for kind in kinds.tolist():
        whole = whole.then(_Riccati(transition, information[kind], process))
    for _ in range(60):
        twice = whole.then(whole)
        done = np.allclose(twice.h, whole.h, rtol=1e-12, atol=0.0)
        whole = twice
        if done:
            break
    covariance, sums = whole.h, np.zeros((4, size, 2))
    for kind in kinds.tolist():
        seen = [i for i, is_new in enumerate((kind // 2, kind % 2)) if is_new]
        of = output[seen]
        gain = np.linalg.solve(of @ covariance @ of.T + np.diag(noise[seen]), of @ covariance).T
        sums[kind][:, seen] += gain
        covariance = transition @ (covariance - gain @ of @ covariance) @ transition.T + process
    gains = sums / np.maximum(np.bincount(kinds, minlength=4), 1)[:, None, None]
    error = np.eye(size)
    for kind in kinds.tolist():
        error = transition @ (np.eye(size) - gains[kind] @ output) @ error
    kept = np.delete(np.arange(size), 3) if axis.bias_walk == 0.0 else np.arange(size)
    if not np.abs(np.linalg.eigvals(error[np.ix_(kept, kept)])).max() < 1.0:
        raise np.linalg.LinAlgError("the mean gains of its slow sensors are unstable")

    # From the time of the younger measurement to the present.
    steps = [np.linalg.matrix_power(core, count) @ gains[:, :4] for count in range(common + 1)]
    rows = [steps[common]]
    for entry, lag in enumerate(axis.delay):
        rows += [steps[common - j][:, entry : entry + 1] for j in range(1, min(lag, common) + 1)]
        rows += [gains[:, 4 : 4 + extra[entry]]]
    size_of_e, size_of_rate = step**2, step
    sizes = [
        size_of_e,
        size_of_rate,
        1.0,
        size_of_rate,
        *[size_of_e] * lag_e,
        *[size_of_rate] * lag_v,
    ]
    return (
        np.concatenate(rows, axis=1)
        * np.array(sizes)[:, None]
        / np.array([size_of_e, size_of_rate])
    )


class _Riccati(NamedTuple):
    """The map P -> h + a P (1 + g P)^-1 a^T of a covariance; maps compose."""

    a: np.ndarray
    g: np.ndarray
    h: np.ndarray

    def then(self, other: "_Riccati") -> "_Riccati":
        """The composition: this map, then the other."""
        inverse = np.linalg.inv(np.eye(len(self.a)) + self.h @ other.g)
        g = self.g + self.a.T @ other.g @ inverse @ self.a
        h = other.h + other.a @ inverse @ self.h @ other.a.T
        return _Riccati(other.a @ inverse @ self.a, 0.5 * (g + g.T), 0.5 * (h + h.T))
