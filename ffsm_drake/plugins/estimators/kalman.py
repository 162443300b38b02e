"""Filters that estimate the lumped uncertainty N in q'' = N + Hhat^-1 tau (equation (2)), in the
place of the estimate a sample ago (``systems.controllers.estimation``).

That one is deadbeat, so the noise of the velocity enters multiplied by 1/L.

*Kalman*: per coordinate, a stationary filter for [e, e', d] with d = -N a random walk, driven by
the known w = q_d'' - Hhat^-1 tau, correcting with the measured e and e'. The noise of the sensors
and the walk's intensity determine its bandwidth. One sample is its limit for exact velocities,
useless positions and an infinitely fast walk. Relatives are the extended state observer and the
disturbance observer in Kalman form (Han 2009, "From PID to active disturbance rejection control",
doi:10.1109/TIE.2008.2011621).

*Kalman with late and slow measurements*: the same filter for sensors with delayed measurements,
periods longer than the control samples, or a velocity bias (then a fourth state b). It keeps e and
e' over the delay, compares a measurement with the values at its own time, and corrects all of them,
the present included. This equals a filter at the time of measurement with a prediction over the
delay under the applied force.

The errors of the base's sensors, a gyro's bias among them, turn with the base. If a bias is
estimated, or assumptions differ along the base's three axes, the filters of its rotation and
its position take innovations along the measured base's axes, and b stays in them.
"""

import dataclasses
import functools
from typing import ClassVar, Self

import numpy as np

from ffsm_drake.common.products import product
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.estimators.assumed_noise import axes_matter, sensed_axes
from ffsm_drake.plugins.estimators.filter_gains import SensedAxis, kalman_gain, sensed_gains
from ffsm_drake.scenario import Grip
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.controllers.estimation import Estimate, Estimator
from ffsm_drake.systems.controllers.law import Sample, State


@dataclasses.dataclass(frozen=True, kw_only=True)
class KalmanEstimator(Estimator):
    """Stationary Kalman estimate of [e, e', d] per coordinate, d = -N.

    It starts from zero error: the planned motion begins at the nominal initial posture.
    """

    by_axis: ClassVar[bool] = True
    random_walks: ClassVar[tuple[str, ...]] = ("walk",)
    sample_time: float
    # (nv, 3, 2): correction of [e, e', d] per unit of innovation of (e, e')
    gain: np.ndarray

    @classmethod
    def make(
        cls,
        mission: Mission,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> "KalmanEstimator | LateKalmanEstimator":
        scenario = mission.scenario
        axes, step = sensed_axes(scenario, coordinates), scenario.sample_time
        of_base = jacobian is None and axes_matter(axes)
        if of_base or not all(axis.is_plain for axis in axes):
            return LateKalmanEstimator.make(mission, coordinates, jacobian, grip)
        noises = np.array([[axis.position_noise, axis.velocity_noise, axis.walk] for axis in axes])
        if jacobian is not None:
            noises = np.sqrt(jacobian**2 @ noises**2)
        gains = [
            kalman_gain(
                position_noise=position, velocity_noise=velocity, walk=walk, sample_time=step
            )
            for position, velocity, walk in noises.tolist()
        ]
        return cls(sample_time=step, gain=np.array(gains))

    @property
    def owner(self) -> np.ndarray:
        """No past is kept; see LateKalmanEstimator."""
        return np.arange(0)

    def past(self, sample: Sample, state: State) -> np.ndarray:
        """No past is kept; see LateKalmanEstimator."""
        return np.zeros(0)

    def expected(self, e: np.ndarray, e_dot: np.ndarray, past: np.ndarray) -> np.ndarray:
        """Values (2 nv) of [e, e'] at the times of the measurements, now."""
        return np.concatenate((e, e_dot))

    def initial_state(self) -> State:
        zeros = np.zeros(self.gain.shape[-3])
        names = (
            "estimated_error",
            "estimated_error_rate",
            "estimated_negative_n",
            "delayed_desired_velocity",
        )
        return dict.fromkeys(names, zeros)

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        e, e_dot, d = predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        position, rate = sample.e - e, sample.e_dot - e_dot
        if sample.is_new is not None:  # a reading was lost
            new_position, new_rate = np.split(sample.is_new, 2)
            position, rate = np.where(new_position, position, 0.0), np.where(new_rate, rate, 0.0)
        correction = self.gain[..., 0] * position[..., None] + self.gain[..., 1] * rate[..., None]
        e, e_dot, d = e + correction[..., 0], e_dot + correction[..., 1], d + correction[..., 2]
        estimate = Estimate(e, e_dot, base_force=np.zeros_like(d), base_acceleration=-d)
        return estimate, {
            "estimated_error": e,
            "estimated_error_rate": e_dot,
            "estimated_negative_n": d,
            "delayed_desired_velocity": sample.v_d,
        }


@dataclasses.dataclass(frozen=True, kw_only=True)
class LateKalmanEstimator(Estimator):
    """Kalman estimate of [e, e', d], and b with a velocity bias, from late or slow measurements.

    ``gain`` acts on x = [e, e', d, b, past]. ``past`` holds e and e' at each of the last samples,
    up to the measurements' delays, relative to the present reference: [q_d(t_k) - q(t_(k-j)), ...].
    """

    random_walks: ClassVar[tuple[str, ...]] = ("walk",)
    sample_time: float
    delay: np.ndarray  # (2 nv) of e, then e': whole control samples
    # whether the gains of the base's coordinates, and its bias, are along its axes
    in_base: bool
    # (4, 4 nv + sum of the delays, 2): correction of x per unit of innovation of its coordinate's e
    # and e'; the first index is the new measurement of that coordinate: none, velocity, position,
    # both
    gain: np.ndarray

    @classmethod
    def make(
        cls,
        mission: Mission,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> Self:
        scenario = mission.scenario
        axes, solve = sensed_axes(scenario, coordinates), functools.cache(_gains_by_kind)
        gains = [solve(axis, sample_time=scenario.sample_time) for axis in axes]
        delays = np.array([axis.delay for axis in axes])
        # From coordinate by coordinate to entry by entry: all e, all e', all d, all b, the past of
        # all e, of all e'.
        present = [np.stack([of[:, entry] for of in gains], axis=1) for entry in range(4)]
        of_e = [of[:, 4 : 4 + lag] for of, (lag, _) in zip(gains, delays, strict=True)]
        of_rate = [of[:, 4 + lag :] for of, (lag, _) in zip(gains, delays, strict=True)]
        return cls(
            sample_time=scenario.sample_time,
            delay=delays.T.ravel(),
            in_base=axes_matter(axes),
            gain=np.concatenate([*present, *of_e, *of_rate], axis=1),
        )

    @functools.cached_property
    def owner(self) -> np.ndarray:
        """The entry of [e, e'] for each entry of ``past`` (n)."""
        return np.repeat(np.arange(self.delay.size), self.delay)

    @functools.cached_property
    def _source(self) -> np.ndarray:
        """Place of each entry of ``past`` in [e, e', past] a sample ago (n)."""
        source = self.delay.size - 1 + np.arange(self.owner.size)
        first = np.cumsum(self.delay) - self.delay
        source[first[self.delay > 0]] = np.flatnonzero(self.delay)
        return source

    @functools.cached_property
    def _measured(self) -> np.ndarray:
        """Index of the measured entry of [e, e', past] (2 nv)."""
        own = np.arange(self.delay.size)
        return np.where(self.delay > 0, self.delay.size - 1 + np.cumsum(self.delay), own)

    @functools.cached_property
    def _axis(self) -> np.ndarray:
        """The coordinate of each entry of x."""
        nv = self.delay.size // 2
        return np.concatenate((np.tile(np.arange(nv), 4), self.owner % nv))

    @functools.cached_property
    def _of_base(self) -> np.ndarray:
        """Vectors of the base among the entries of x without b, as rows (m, 3)."""
        nv = self.delay.size // 2
        axis = self._axis.copy()
        axis[3 * nv : 4 * nv] = nv
        of = [np.flatnonzero(axis == each) for each in range(NUM_BASE_VELOCITIES)]
        return np.concatenate([np.stack(of[first : first + 3], axis=1) for first in (0, 3)])

    def initial_state(self) -> State:
        nv = self.delay.size // 2
        names = (
            "estimated_error",
            "estimated_error_rate",
            "estimated_negative_n",
            "estimated_velocity_bias",
        )
        return {
            **dict.fromkeys((*names, "delayed_desired_velocity"), np.zeros(nv)),
            "past": np.zeros(self.owner.size),
        }

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        nv, bias = self.delay.size // 2, state["estimated_velocity_bias"]
        e, e_dot, d = predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        past = self.past(sample, state)
        expected = self.expected(e, e_dot, past)
        position = sample.e - expected[:nv]
        if self.in_base:
            back = matrix_of(sample.q[:4]).T
            position = turned(back, position)
            rate = turned(back, sample.e_dot - expected[nv:]) + bias
        else:
            rate = sample.e_dot - (expected[nv:] - bias)
        axis = self._axis
        none, of_rate, of_position, gain = self.gain
        if sample.is_new is not None:
            new_position, new_rate = np.split(sample.is_new[:, None], 2)
            without = np.where(new_rate[axis], of_rate, none)
            gain = np.where(new_rate[axis], gain, of_position)
            gain = np.where(new_position[axis], gain, without)
        correction = gain[:, 0] * position[axis] + gain[:, 1] * rate[axis]
        if self.in_base:  # rows: R v is v R'
            correction[self._of_base] = product(correction[self._of_base], back)
        x = np.concatenate((e, e_dot, d, bias, past)) + correction
        e, e_dot, d, bias, past = np.split(x, [nv, 2 * nv, 3 * nv, 4 * nv])
        return Estimate(e, e_dot, base_force=np.zeros_like(d), base_acceleration=-d), {
            "estimated_error": e,
            "estimated_error_rate": e_dot,
            "estimated_negative_n": d,
            "estimated_velocity_bias": bias,
            "delayed_desired_velocity": sample.v_d,
            "past": past,
        }

    def resume(self, state: State, ratio: np.ndarray, v_d: np.ndarray) -> State:
        """See Estimator. What is measured late is from before the grasp for a while, against the
        velocity after it.
        """
        return {**super().resume(state, ratio, v_d), "past": self._moved_past(state, v_d)}

    def past(self, sample: Sample, state: State) -> np.ndarray:
        """``past`` at this sample, before its measurements."""
        return state["past"] if sample.is_first else self._moved_past(state, sample.v_d)

    def expected(self, e: np.ndarray, e_dot: np.ndarray, past: np.ndarray) -> np.ndarray:
        """Values (2 nv) of [e, e'] at the times of the measurements."""
        values: np.ndarray = np.concatenate((e, e_dot, past))[self._measured]
        return values

    def _moved_past(self, state: State, v_d: np.ndarray) -> np.ndarray:
        """Past values relative to a reference that has moved on to the velocity v_d."""
        old_v_d = state["delayed_desired_velocity"]
        moved = np.concatenate((0.5 * self.sample_time * (v_d + old_v_d), v_d - old_v_d))
        names = ("estimated_error", "estimated_error_rate", "past")
        before = np.concatenate([state[name] for name in names])
        past: np.ndarray = before[self._source] + moved[self.owner]
        return past


def _gains_by_kind(axis: SensedAxis, *, sample_time: float) -> np.ndarray:
    """Gains (4, size, 2) of one coordinate; see ``LateKalmanEstimator.gain``."""
    kinds, (gains,) = sensed_gains([axis], responses=np.ones((1, 1, 1)), sample_time=sample_time)
    of_kind = np.zeros((4, *gains.shape[1:]))
    of_kind[kinds @ [2, 1]] = gains
    return of_kind


def turned(R: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (nv) along the coordinates, the base's vectors turned by R (3, 3)."""
    turned = values.copy()
    vectors = product(values[:NUM_BASE_VELOCITIES].reshape(2, 3), R.T)  # as rows
    turned[:NUM_BASE_VELOCITIES] = vectors.reshape(NUM_BASE_VELOCITIES)
    return turned


def predict(
    sample: Sample, nominal_mass_matrix: np.ndarray, state: State, *, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[e, e', d] of a filter at this sample, before its measurements."""
    e, e_dot = state["estimated_error"], state["estimated_error_rate"]
    d, delayed_v_d = state["estimated_negative_n"], state["delayed_desired_velocity"]
    if not sample.is_first:
        # Over the last period: the reference's mean acceleration, less what the applied force
        # should have given.
        given = np.linalg.solve(nominal_mass_matrix, sample.applied_force[..., None])[..., 0]
        acceleration = (sample.v_d - delayed_v_d) / step - given + d
        e = e + step * e_dot + (0.5 * step * step) * acceleration
        e_dot = e_dot + step * acceleration
    return e, e_dot, d
