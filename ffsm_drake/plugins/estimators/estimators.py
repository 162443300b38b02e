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

*Coupled*: the disturbance is a force, and H couples its effects on attitude and joints: d =
-Hhat^-1 f, with f a random walk. One filter of all their measurements is then more accurate than
separate filters. Biases are states of it, as above. H changes along a motion, and the gain of a
posture with H_0 makes the filter unstable if an eigenvalue of H^-1 H_0 exceeds about 2.4. Gains are
therefore computed for enough postures of the plan, and the gain of the posture nearest to the
desired one is used.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.products import product
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.estimators.filter_gains import (
    SensedAxis,
    coupled_gain,
    kalman_gain,
    late_gains,
)
from ffsm_drake.scenario import Grip, Scenario, planned_part
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    Coordinates,
)
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import files_read
from ffsm_drake.systems.controllers.estimation import Estimate, Estimator
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.reference import make_motion
from ffsm_drake.systems.sensing.errors import measurement_times

# Largest eigenvalue of the inertia of a posture with a gain of its own relative to its neighbour's.
_NEIGHBOURS = 1.15
_MOST_POSTURES = 41  # 3 to 4 ms each
_INSTANTS = 201  # instants of a plan, candidates for these postures


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
        scenario: Scenario,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> "KalmanEstimator | LateKalmanEstimator":
        axes, step = _axes(scenario, coordinates), scenario.sample_time
        of_base = jacobian is None and _axes_matter(axes)
        if of_base or not all(axis.is_plain for axis in axes):
            return LateKalmanEstimator.make(scenario, coordinates, jacobian, grip)
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
        e, e_dot, d = _predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        position, rate = sample.e - e, sample.e_dot - e_dot
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
        scenario: Scenario,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> Self:
        axes, solve = _axes(scenario, coordinates), functools.cache(late_gains)
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
            in_base=_axes_matter(axes),
            gain=np.concatenate([*present, *of_e, *of_rate], axis=1),
        )

    @functools.cached_property
    def _owner(self) -> np.ndarray:
        """The entry of [e, e'] for each entry of ``past`` (n)."""
        return np.repeat(np.arange(self.delay.size), self.delay)

    @functools.cached_property
    def _source(self) -> np.ndarray:
        """Place of each entry of ``past`` in [e, e', past] a sample ago (n)."""
        source = self.delay.size - 1 + np.arange(self._owner.size)
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
        return np.concatenate((np.tile(np.arange(nv), 4), self._owner % nv))

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
            "past": np.zeros(self._owner.size),
        }

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        nv, bias, past = self.delay.size // 2, state["estimated_velocity_bias"], state["past"]
        e, e_dot, d = _predict(sample, nominal_mass_matrix, state, step=self.sample_time)
        if not sample.is_first:
            past = self._moved_past(state, sample.v_d)
        expected = np.concatenate((e, e_dot, past))[self._measured]
        position = sample.e - expected[:nv]
        if self.in_base:
            back = matrix_of(sample.q[:4]).T
            position = _turned(back, position)
            rate = _turned(back, sample.e_dot - expected[nv:]) + bias
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

    def _moved_past(self, state: State, v_d: np.ndarray) -> np.ndarray:
        """Past values relative to a reference that has moved on to the velocity v_d."""
        old_v_d = state["delayed_desired_velocity"]
        moved = np.concatenate((0.5 * self.sample_time * (v_d + old_v_d), v_d - old_v_d))
        names = ("estimated_error", "estimated_error_rate", "past")
        before = np.concatenate([state[name] for name in names])
        past: np.ndarray = before[self._source] + moved[self._owner]
        return past


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoupledEstimator(Estimator):
    """Kalman estimate of [e, e', f] of several coordinates together, d = -(Hhat^-1 f), and of the
    others one by one.
    """

    random_walks: ClassVar[tuple[str, ...]] = ("walk", "force_walk")
    by_sample: ClassVar[tuple[str, ...]] = ("gain",)
    in_phase: ClassVar[tuple[str, ...]] = ("postures",)  # compiled, ``at_samples`` alone reads them
    separate: KalmanEstimator | LateKalmanEstimator
    axes: np.ndarray  # (n,) the coordinates that are taken together
    biased: np.ndarray  # (k,) those of them whose velocities have a bias
    # postures (m, nq) of the gains, and gains (m, 3 n + k, 2 n): correction of [e, e', f, b] per
    # unit of innovation of [e, e']
    postures: np.ndarray
    gain: np.ndarray

    @classmethod
    def make(
        cls,
        scenario: Scenario,
        coordinates: Coordinates,
        jacobian: np.ndarray | None,
        grip: Grip,
    ) -> Self:
        sensed = _axes(scenario, coordinates)
        if not all(axis.is_prompt for axis in sensed) or len(set(sensed[:3])) > 1:
            raise ScenarioError(
                "estimator.kind",
                "coupled needs sensors without delay or longer periods, and one noise and walk for "
                "the base's three axes; set kalman",
            )
        axes = np.flatnonzero([group != "base_position" for group in coordinates.group_of])
        position, velocity = assumed_noise(scenario, coordinates)
        walk = coordinates.vector(scenario.estimator.force_walk, key="estimator.force_walk")
        bias_walk = np.array([axis.bias_walk for axis in sensed])
        postures, gain = _gains_along(
            planned_part(scenario),
            grip,
            axes=axes,
            position_noise=position[axes],
            velocity_noise=velocity[axes],
            walk=walk[axes],
            bias_walk=bias_walk[axes],
        )
        separate = KalmanEstimator.make(scenario, coordinates, None, grip)
        biased = axes[bias_walk[axes] > 0.0]
        return cls(separate=separate, axes=axes, biased=biased, postures=postures, gain=gain)

    def initial_state(self) -> State:
        return {**self.separate.initial_state(), "estimated_force": np.zeros(self.axes.size)}

    def gain_at(self, q_d: np.ndarray) -> np.ndarray:
        """Return the gain (..., 3 n + k, 2 n) of the posture nearest to q_d (..., nq) by the angle
        of the base's rotation and the joints' positions, rad or m.
        """
        if len(self.gain) == 1 and q_d.ndim == 1:
            return self.gain[0]
        nearest: np.ndarray = self.gain[self.nearest(q_d)]
        return nearest

    def nearest(self, q_d: np.ndarray) -> np.ndarray:
        """The index of that gain."""
        return _nearest(self.postures, q_d)

    def at_samples(self, q_d: np.ndarray) -> Mapping[str, np.ndarray]:
        """The gains at postures q_d (samples, nq), for the compiled engine."""
        return {"gain": self.gain_at(q_d)}

    def step(
        self, sample: Sample, nominal_mass_matrix: np.ndarray, state: State
    ) -> tuple[Estimate, State]:
        """One sample; see Estimator."""
        predicted = _predict(sample, nominal_mass_matrix, state, step=self.separate.sample_time)
        estimate, after = self.separate.step(sample, nominal_mass_matrix, state)
        e, e_dot, d = estimate.e.copy(), estimate.e_dot.copy(), -estimate.base_acceleration
        n, axes = self.axes.size, self.axes
        old_e, old_rate = (of[axes] for of in predicted[:2])
        rate = sample.e_dot[axes] - old_rate
        if self.biased.size:
            R, bias = matrix_of(sample.q[:4]), state["estimated_velocity_bias"]
            rate = rate + _turned(R, bias)[axes]
        innovation = np.concatenate((sample.e[axes] - old_e, rate))
        of_e, of_rate, of_force, of_bias = np.split(
            self.gain_at(sample.q_d).dot(innovation), [n, 2 * n, 3 * n]
        )
        force = state["estimated_force"] + of_force
        # Its effect on the other coordinates is theirs to estimate.
        acting = np.zeros_like(d)
        acting[axes] = force
        e[axes], e_dot[axes] = old_e + of_e, old_rate + of_rate
        d[axes] = -np.linalg.solve(nominal_mass_matrix, acting)[axes]
        kept = {"estimated_error": e, "estimated_error_rate": e_dot, "estimated_negative_n": d}
        if self.biased.size:  # in the base's axes
            correction = np.zeros_like(d)
            correction[self.biased] = of_bias
            bias = bias + _turned(R.T, correction)
            of_others = after["estimated_velocity_bias"]
            coupled = np.isin(np.arange(bias.size), axes)
            kept["estimated_velocity_bias"] = np.where(coupled, bias, of_others)
        return estimate._replace(e=e, e_dot=e_dot, base_acceleration=-d), {
            **after,
            **kept,
            "estimated_force": force,
        }


def _nearest(postures: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Index of the posture (m, nq) nearest to q (..., nq), see ``gain_at``."""
    each = q[..., None, :]
    joints = (each - postures)[..., NUM_BASE_POSITIONS:]
    cosine = np.abs((each * postures)[..., :4].sum(axis=-1))  # cosine of half the angle
    nearest: np.ndarray = np.argmin((joints * joints).sum(axis=-1) - 8.0 * cosine, axis=-1)
    return nearest


def _axes_matter(axes: Sequence[SensedAxis]) -> bool:
    """Whether it matters along which axes the filters of the base's coordinates are."""
    base = axes[:NUM_BASE_VELOCITIES]
    alike = len(set(base[:3])) == len(set(base[3:])) == 1
    return not alike or any(axis.bias_walk > 0.0 for axis in base)


def _turned(R: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (nv) along the coordinates, the base's vectors turned by R (3, 3)."""
    turned = values.copy()
    vectors = product(values[:NUM_BASE_VELOCITIES].reshape(2, 3), R.T)  # as rows
    turned[:NUM_BASE_VELOCITIES] = vectors.reshape(NUM_BASE_VELOCITIES)
    return turned


def _predict(
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


def _axes(scenario: Scenario, coordinates: Coordinates) -> list[SensedAxis]:
    """Noise assumptions of a filter for each coordinate."""
    settings, nv = scenario.estimator, len(coordinates.names)
    walk = coordinates.vector(settings.walk, key="estimator.walk")
    bias_walk = coordinates.vector(
        settings.velocity_bias_walk, key="estimator.velocity_bias_walk", default=0.0
    )
    period, delay = measurement_times(scenario.sensing, coordinates)
    if settings.delay is not None:
        delay = delay - scenario.sensing.delay + settings.delay
    position, velocity = assumed_noise(scenario, coordinates)
    return [
        SensedAxis(
            position_noise=float(position[i]),
            velocity_noise=float(velocity[i]),
            walk=float(walk[i]),
            bias_walk=float(bias_walk[i]),
            period=(int(period[i]), int(period[nv + i])),
            delay=(int(delay[i]), int(delay[nv + i])),
        )
        for i in range(nv)
    ]


# a run's check, the run and its report make the same law
@memoized(maxsize=16, files=files_read)
def _gains_along(
    scenario: Scenario,
    grip: Grip,
    *,
    axes: np.ndarray,
    **noises: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Postures (m, nq) of a scenario's plan, with the coupled gain of each (m, 3 n, 2 n).

    With a capture it is the plan of the phase with ``grip``. The relative eigenvalues of the
    inertias of neighbours stay within ``_NEIGHBOURS``, if ``_MOST_POSTURES`` are enough.

    Args:
      scenario: with its model and plan.
      axes, noises: arguments of ``coupled_gain``.
    """
    model = driven_model(make_nominal_plant(scenario, grip))
    motion = make_motion(scenario, model.coordinates, grip)
    q, _, _ = motion.evaluate(np.linspace(motion.begin, motion.end, _INSTANTS))
    inverse = np.linalg.inv(model.calc_mass_matrix(q))[:, axes[:, None], axes]
    # Distances by the logarithm of the eigenvalue farthest from one: they add up along the motion.
    ratios = np.linalg.eigvals(np.linalg.solve(inverse[1:], inverse[:-1])).real
    passed = np.cumsum([0.0, *np.abs(np.log(ratios)).max(axis=1)])
    steps = passed[-1] / math.log(_NEIGHBOURS) - 1e-9  # but for rounding
    count = min(math.ceil(steps) + 1, _MOST_POSTURES)
    chosen = np.abs(passed - np.linspace(0.0, passed[-1], count)[:, None]).argmin(axis=1)
    gains = [
        coupled_gain(each, sample_time=scenario.sample_time, **noises) for each in inverse[chosen]
    ]
    return q[chosen], np.array(gains)


def assumed_noise(scenario: Scenario, coordinates: Coordinates) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (nv) of the measured positions and velocities assumed by the filter.

    Correlated noise counts as white noise of equal strength at low frequencies.
    """
    sensing, nv = scenario.sensing, len(coordinates.names)
    period, _ = measurement_times(sensing, coordinates)
    time_constant = coordinates.vector(
        sensing.correlation_time, key="sensing.correlation_time", default=1.0
    )

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
