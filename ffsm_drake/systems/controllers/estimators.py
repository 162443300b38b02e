"""Estimators of the lumped uncertainty N in q'' = N + Hhat^-1 tau (equation (2)), for all time-delay laws.

Both give, each sample, what the law works on (error and its rate) and a pair (base force, base acceleration) that turns
the law's acceleration u into the force tau = base force + Hhat (u - base acceleration).

*One sample* (equation (5), the paper's): N is what it was a sample ago, from the differentiated velocity. It is
deadbeat, so the noise of the velocity enters multiplied by 1/L.

*Kalman*: per coordinate, a stationary filter for [e, e', d] with d = -N a random walk, driven by the known
w = q_d'' - Hhat^-1 tau, correcting with the measured e and e'. The noise of the sensors and the walk's intensity decide
how fast it follows. One sample is its limit for exact velocities, useless positions and an infinitely fast walk.
Relatives are the extended state observer and the disturbance observer in Kalman form (Han 2009, "From PID to active
disturbance rejection control", doi:10.1109/TIE.2008.2011621).

*Kalman with late and slow measurements*: the same filter for sensors whose measurements arrive late, come less often
than the control samples, or have a velocity bias, which is then a fourth state b. It remembers what e and e' were over
the delay, compares a measurement with that of its own time, and corrects all of it, the present included. This equals a
filter at the time of measurement that predicts over the delay with the force that acted.

*Coupled*: what disturbs is a force, and H couples what it does to attitude and joints: d = -Hhat^-1 f, with f a random
walk. One filter of all their measurements then knows more of each than one for each.
"""

import dataclasses
import functools
import math
from typing import NamedTuple, Protocol

import numpy as np

from ffsm_drake.common.errors import ScenarioError, one_line
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.sensing import measurement_times

# A filter needs some noise on every measurement: in units of acceleration at least this share of the larger of the
# other measurement's and the walk's, below which the Riccati equation has no solution in double precision.
SMALLEST_RATIO = 1e-7


# Of the work on the gains of late and slow sensors, roughly multiplications: seconds.
_LARGEST = 3e8


class Estimate(NamedTuple):
    """What the law and the force are computed from; arrays (..., nv)."""

    e: np.ndarray
    e_dot: np.ndarray
    base_force: np.ndarray
    base_acceleration: np.ndarray


class Estimator(Protocol):
    """An estimator as a pure function of arrays."""

    def initial_state(self) -> State:
        """Name -> initial value of each piece of the estimator's memory."""
        ...

    def step(self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State) -> tuple[Estimate, State]:
        """One sample: the estimate, and the memory at the next.

        Args:
          sample: what was measured and wanted, and the force that acted.
          nominal_mass_matrix: Hhat (..., nv, nv) at this sample.
          state: the memory at this sample, by name; must not be changed in place.
        """
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneSampleEstimator:
    """Time-delay estimation as published: N(t - L) for N(t), equation (5)."""

    sample_time: float
    num_velocities: int

    def initial_state(self) -> State:
        return {"delayed_velocity": np.zeros(self.num_velocities)}

    def step(self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State) -> tuple[Estimate, State]:
        """One sample; see Estimator. Nothing is known of the acceleration at the very first: it counts as zero."""
        change = sample.v - state["delayed_velocity"]
        acceleration = np.zeros_like(change) if sample.is_first else change * (1.0 / self.sample_time)
        estimate = Estimate(sample.e, sample.e_dot, base_force=sample.applied_force, base_acceleration=acceleration)
        return estimate, {"delayed_velocity": sample.v}


@dataclasses.dataclass(frozen=True, kw_only=True)
class KalmanEstimator:
    """Stationary Kalman estimate of [e, e', d] per coordinate, d = -N.

    It starts from zero error: the planned motion begins at the nominal initial posture.
    """

    sample_time: float
    gain: np.ndarray  # (nv, 3, 2): correction of [e, e', d] per unit of innovation of (e, e')

    def initial_state(self) -> State:
        zeros = np.zeros(self.gain.shape[0])
        names = ("estimated_error", "estimated_error_rate", "estimated_negative_n", "delayed_desired_velocity")
        return dict.fromkeys(names, zeros)

    def step(self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        e, e_dot, d = _predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        innovation = np.stack((sample.e - e, sample.e_dot - e_dot), axis=-1)
        correction = np.einsum("ijk,...ik->...ij", self.gain, innovation)
        e, e_dot, d = e + correction[..., 0], e_dot + correction[..., 1], d + correction[..., 2]
        estimate = Estimate(e, e_dot, base_force=np.zeros_like(d), base_acceleration=-d)
        return estimate, {
            "estimated_error": e,
            "estimated_error_rate": e_dot,
            "estimated_negative_n": d,
            "delayed_desired_velocity": sample.v_d,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class LateKalmanEstimator:
    """Kalman estimate of [e, e', d], and b where the velocity has a bias, from measurements that are late or slow.

    ``gain`` acts on x = [e, e', d, b, past] with ``past`` what e and e' were at each of the last samples, up to the
    measurements' delays: the errors that the present reference would have had then, [q_d(t_k) - q(t_(k-j)), ...].
    """

    sample_time: float
    delay: np.ndarray  # (2 nv) of e, then e': whole control samples
    # (4, 4 nv + sum of the delays, 2): correction of x per unit of innovation of its coordinate's e and e'; the first
    # index says what is new of that coordinate: nothing, the velocity, the position, both
    gain: np.ndarray

    @functools.cached_property
    def _owner(self) -> np.ndarray:
        """Of each entry of ``past``, the entry of [e, e'] that it was (n)."""
        return np.repeat(np.arange(self.delay.size), self.delay)

    @functools.cached_property
    def _source(self) -> np.ndarray:
        """Where each entry of ``past`` stood in [e, e', past] a sample ago (n)."""
        source = self.delay.size - 1 + np.arange(self._owner.size)
        first = np.cumsum(self.delay) - self.delay
        source[first[self.delay > 0]] = np.flatnonzero(self.delay)
        return source

    @functools.cached_property
    def _measured(self) -> np.ndarray:
        """Which entry of [e, e', past] is measured (2 nv)."""
        own = np.arange(self.delay.size)
        return np.where(self.delay > 0, self.delay.size - 1 + np.cumsum(self.delay), own)

    @functools.cached_property
    def _axis(self) -> np.ndarray:
        """The coordinate of each entry of x."""
        nv = self.delay.size // 2
        return np.concatenate((np.tile(np.arange(nv), 4), self._owner % nv))

    def initial_state(self) -> State:
        nv = self.delay.size // 2
        names = ("estimated_error", "estimated_error_rate", "estimated_negative_n", "estimated_velocity_bias")
        return {**dict.fromkeys((*names, "delayed_desired_velocity"), np.zeros(nv)), "past": np.zeros(self._owner.size)}

    def step(self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        nv, bias, past = self.delay.size // 2, state["estimated_velocity_bias"], state["past"]
        e, e_dot, d = _predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        if not sample.is_first:
            # What was is as it was, against a reference that has moved on.
            old_v_d = state["delayed_desired_velocity"]
            moved = np.concatenate((0.5 * self.sample_time * (sample.v_d + old_v_d), sample.v_d - old_v_d), axis=-1)
            before = np.concatenate((state["estimated_error"], state["estimated_error_rate"], past), axis=-1)
            past = before[..., self._source] + moved[..., self._owner]
        x = np.concatenate((e, e_dot, past), axis=-1)
        expected = x[..., self._measured]
        position, rate = sample.e - expected[..., :nv], sample.e_dot - (expected[..., nv:] - bias)
        axis, gain = self._axis, self.gain[3]
        if sample.is_new is not None:
            new = 2 * sample.is_new[..., :nv] + sample.is_new[..., nv:]
            gain = self.gain[new[..., axis], np.arange(axis.size)]
        correction = gain[..., 0] * position[..., axis] + gain[..., 1] * rate[..., axis]
        x = np.concatenate((e, e_dot, d, bias, past), axis=-1) + correction
        e, e_dot, d, bias, past = np.split(x, [nv, 2 * nv, 3 * nv, 4 * nv], axis=-1)
        return Estimate(e, e_dot, base_force=np.zeros_like(d), base_acceleration=-d), {
            "estimated_error": e,
            "estimated_error_rate": e_dot,
            "estimated_negative_n": d,
            "estimated_velocity_bias": bias,
            "delayed_desired_velocity": sample.v_d,
            "past": past,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoupledEstimator:
    """Kalman estimate of [e, e', f] of several coordinates together, d = -(Hhat^-1 f), and of the others one by one."""

    separate: KalmanEstimator
    axes: np.ndarray  # (n,) the coordinates that are taken together
    gain: np.ndarray  # (3 n, 2 n): correction of [e, e', f] per unit of innovation of [e, e']

    def initial_state(self) -> State:
        return {**self.separate.initial_state(), "estimated_force": np.zeros(self.axes.size)}

    def step(self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        predicted = _predict(sample, nominal_mass_matrix, state, step=self.separate.sample_time)
        estimate, after = self.separate.step(sample, nominal_mass_matrix, state)
        e, e_dot, d = estimate.e.copy(), estimate.e_dot.copy(), -estimate.base_acceleration
        old_e, old_rate = (of[..., self.axes] for of in predicted[:2])
        innovation = np.concatenate(
            (sample.e[..., self.axes] - old_e, sample.e_dot[..., self.axes] - old_rate), axis=-1
        )
        of_e, of_rate, of_force = np.split(np.einsum("ij,...j->...i", self.gain, innovation), 3, axis=-1)
        force = state["estimated_force"] + of_force
        # Its effect on the other coordinates is theirs to estimate.
        acting = np.zeros_like(d)
        acting[..., self.axes] = force
        e[..., self.axes], e_dot[..., self.axes] = old_e + of_e, old_rate + of_rate
        d[..., self.axes] = -np.linalg.solve(nominal_mass_matrix, acting[..., None])[..., self.axes, 0]
        kept = {"estimated_error": e, "estimated_error_rate": e_dot, "estimated_negative_n": d}
        return estimate._replace(e=e, e_dot=e_dot, base_acceleration=-d), {**after, **kept, "estimated_force": force}


def _predict(
    sample: Sample, nominal_mass_matrix: np.ndarray, state: State, *, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[e, e', d] of a filter at this sample, before its measurements."""
    e, e_dot = state["estimated_error"], state["estimated_error_rate"]
    d, delayed_v_d = state["estimated_negative_n"], state["delayed_desired_velocity"]
    if not sample.is_first:
        # Over the last period: the reference's mean acceleration, less what the applied force should have given.
        given = np.linalg.solve(nominal_mass_matrix, sample.applied_force[..., None])[..., 0]
        acceleration = (sample.v_d - delayed_v_d) / step - given + d
        e = e + step * e_dot + (0.5 * step * step) * acceleration
        e_dot = e_dot + step * acceleration
    return e, e_dot, d


def kalman_gain(*, position_noise: float, velocity_noise: float, walk: float, sample_time: float) -> np.ndarray:
    """Stationary gain (3, 2) of one coordinate's filter.

    Args:
      position_noise, velocity_noise: standard deviations of the measured e and e'.
      walk: intensity of N's random walk, its standard deviation after one second, rad/s^2 or m/s^2 per sqrt(s).
      sample_time: L, s.
    """
    from scipy.linalg import solve_discrete_are

    step = sample_time
    # In units of acceleration ([L^2, L, 1]) every entry is of order one; in SI units the equation is badly scaled.
    transition = np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    output = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    sigma = np.array([position_noise / step**2, velocity_noise / step])
    noise = np.maximum(sigma, SMALLEST_RATIO * max(*sigma, walk * np.sqrt(step))) ** 2
    scale = noise.min()
    process = np.diag([0.0, 0.0, walk**2 * step]) / scale
    covariance = solve_discrete_are(transition.T, output.T, process, np.diag(noise / scale))
    gain = covariance @ output.T @ np.linalg.inv(output @ covariance @ output.T + np.diag(noise / scale))
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
      inverse_mass_matrix: the part of Hhat^-1 that is the coupled coordinates' (n, n).
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
    """Gains (4, 4 + sum of the delays, 2) of one coordinate of a LateKalmanEstimator, on [e, e', d, b, past].

    One gain for each kind of sample (nothing, velocity, position, both new): where the stationary filter's gain differs
    between samples of one kind, the mean over the common period of the sensors.

    Raises LinAlgError where that filter is not stable.
    """
    step, (lag_e, lag_v) = sample_time, axis.delay
    common = min(axis.delay)
    extra = lag_e - common, lag_v - common  # one of them is 0
    size = 4 + sum(extra)
    # In units of acceleration, as in ``kalman_gain``. The measurements' common delay is a matter of prediction alone:
    # the filter runs where the younger one is of the present.
    core = np.array([[1.0, 1.0, 0.5, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
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
        raise np.linalg.LinAlgError(f"a common period of {samples.size} samples and {size} states are too many")
    new = np.stack([(samples - late) % period == 0 for late, period in zip(extra, axis.period, strict=True)], axis=1)
    kinds = 2 * new[:, 0] + new[:, 1]
    information = {kind: output.T * ([kind // 2, kind % 2] / noise) @ output for kind in set(kinds.tolist())}
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
    sizes = [size_of_e, size_of_rate, 1.0, size_of_rate, *[size_of_e] * lag_e, *[size_of_rate] * lag_v]
    return np.concatenate(rows, axis=1) * np.array(sizes)[:, None] / np.array([size_of_e, size_of_rate])


class _Riccati(NamedTuple):
    """The map P -> h + a P (1 + g P)^-1 a^T of a covariance, and how two of them are one."""

    a: np.ndarray
    g: np.ndarray
    h: np.ndarray

    def then(self, other: "_Riccati") -> "_Riccati":
        """First this map, then the other."""
        inverse = np.linalg.inv(np.eye(len(self.a)) + self.h @ other.g)
        g = self.g + self.a.T @ other.g @ inverse @ self.a
        h = other.h + other.a @ inverse @ self.h @ other.a.T
        return _Riccati(other.a @ inverse @ self.a, 0.5 * (g + g.T), 0.5 * (h + h.T))


def make_estimator(scenario: Scenario, coordinates: Coordinates) -> Estimator:
    """The scenario's estimator. Raises ScenarioError for unknown or missing coordinates."""
    settings, sample_time = scenario.estimator, scenario.sample_time
    if settings.kind == "one_sample":
        return OneSampleEstimator(sample_time=sample_time, num_velocities=len(coordinates.names))
    walk = coordinates.vector(settings.walk, key="estimator.walk")
    bias_walk = coordinates.vector(settings.velocity_bias_walk, key="estimator.velocity_bias_walk", default=0.0)
    period, delay = measurement_times(scenario.sensing, coordinates)
    if settings.delay is not None:
        delay = delay - scenario.sensing.delay + settings.delay
    nv = len(coordinates.names)
    position, velocity = assumed_noise(scenario, coordinates)
    plain = not (bias_walk.any() or (period > 1).any() or delay.any())
    axes = [
        LateAxis(
            position_noise=float(position[i]),
            velocity_noise=float(velocity[i]),
            walk=float(walk[i]),
            bias_walk=float(bias_walk[i]),
            period=(int(period[i]), int(period[nv + i])),
            delay=(int(delay[i]), int(delay[nv + i])),
        )
        for i in range(nv)
    ]
    try:
        gains = {  # the equation is solved once for all coordinates that share their sensors
            axis: kalman_gain(
                position_noise=axis.position_noise,
                velocity_noise=axis.velocity_noise,
                walk=axis.walk,
                sample_time=sample_time,
            )
            if plain
            else late_gains(axis, sample_time=sample_time)
            for axis in dict.fromkeys(axes)
        }
        if settings.kind == "coupled":
            if not plain:
                raise ScenarioError("estimator.kind", "coupled takes no slow or late sensors and no bias; use kalman")
            separate = KalmanEstimator(sample_time=sample_time, gain=np.array([gains[axis] for axis in axes]))
            return _make_coupled(scenario, coordinates, separate, position, velocity)
    except np.linalg.LinAlgError as error:
        remedy = "bring walk and noises, or periods and delays, of position and velocity closer together"
        raise ScenarioError("estimator", f"has no stationary filter ({one_line(error)}); {remedy}") from error
    by_axis = [gains[axis] for axis in axes]
    if plain:
        return KalmanEstimator(sample_time=sample_time, gain=np.array(by_axis))
    # From coordinate by coordinate to entry by entry: all e, all e', all d, all b, the past of all e, of all e'.
    parts = [np.stack([of[:, entry] for of in by_axis], axis=1) for entry in range(4)]
    parts += [of[:, 4 : 4 + axis.delay[0]] for axis, of in zip(axes, by_axis, strict=True)]
    parts += [of[:, 4 + axis.delay[0] :] for axis, of in zip(axes, by_axis, strict=True)]
    return LateKalmanEstimator(sample_time=sample_time, delay=delay, gain=np.concatenate(parts, axis=1))


def _make_coupled(
    scenario: Scenario,
    coordinates: Coordinates,
    separate: KalmanEstimator,
    position_noise: np.ndarray,
    velocity_noise: np.ndarray,
) -> CoupledEstimator:
    """With the gain of the initial posture: that of any other on the way differs by less than its tuning matters."""
    nominal = make_nominal_plant(scenario)
    q = configuration(nominal.plant, scenario.initial_posture, key="initial_posture")
    axes = np.flatnonzero([group != "base_position" for group in coordinates.group_of])
    inverse = np.linalg.inv(nominal.calc_mass_matrix(q))
    gain = coupled_gain(
        inverse[np.ix_(axes, axes)],
        position_noise=position_noise[axes],
        velocity_noise=velocity_noise[axes],
        walk=coordinates.vector(scenario.estimator.force_walk, key="estimator.force_walk")[axes],
        sample_time=scenario.sample_time,
    )
    return CoupledEstimator(separate=separate, axes=axes, gain=gain)


def assumed_noise(scenario: Scenario, coordinates: Coordinates) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (nv) that the filter assumes of the measured positions and velocities.

    Correlated noise counts as the white noise that is as strong at low frequencies.
    """
    sensing, nv = scenario.sensing, len(coordinates.names)
    period, _ = measurement_times(sensing, coordinates)
    time_constant = coordinates.vector(sensing.correlation_time, key="sensing.correlation_time", default=1.0)

    def of(part: str, samples: np.ndarray) -> np.ndarray:
        given = getattr(scenario.estimator, f"{part}_noise")
        if given is not None:
            return coordinates.vector(given, key=f"estimator.{part}_noise", default=0.0)
        white, correlated = (
            coordinates.vector(getattr(sensing, name), key=f"sensing.{name}", default=0.0)
            for name in (f"{part}_noise", f"{part}_correlated_noise")
        )
        kept = np.exp(-samples * scenario.sample_time / time_constant)
        return np.hypot(white, correlated * np.sqrt((1.0 + kept) / (1.0 - kept)))

    return of("position", period[:nv]), of("velocity", period[nv:])
