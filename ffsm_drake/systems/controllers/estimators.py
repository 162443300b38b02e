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
"""

import dataclasses
from typing import NamedTuple, Protocol

import numpy as np

from ffsm_drake.common.errors import ScenarioError, one_line
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.law import Sample, State

# A filter needs some noise on every measurement: in units of acceleration at least this share of the larger of the
# other measurement's and the walk's, below which the Riccati equation has no solution in double precision.
SMALLEST_RATIO = 1e-7


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
        e, e_dot = state["estimated_error"], state["estimated_error_rate"]
        d, delayed_v_d = state["estimated_negative_n"], state["delayed_desired_velocity"]
        step = self.sample_time
        if not sample.is_first:
            # Over the last period: the reference's mean acceleration, less what the applied force should have given.
            given = np.linalg.solve(nominal_mass_matrix, sample.applied_force[..., None])[..., 0]
            acceleration = (sample.v_d - delayed_v_d) / step - given + d
            e = e + step * e_dot + (0.5 * step * step) * acceleration
            e_dot = e_dot + step * acceleration
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


def make_estimator(scenario: Scenario, coordinates: Coordinates) -> Estimator:
    """The scenario's estimator. Raises ScenarioError for unknown or missing coordinates."""
    settings, sample_time = scenario.estimator, scenario.sample_time
    if settings.kind == "one_sample":
        return OneSampleEstimator(sample_time=sample_time, num_velocities=len(coordinates.names))
    position, velocity = (
        coordinates.vector(getattr(settings, name), key=f"estimator.{name}", default=0.0)
        if getattr(settings, name) is not None
        else coordinates.vector(getattr(scenario.sensing, name), key=f"sensing.{name}", default=0.0)
        for name in ("position_noise", "velocity_noise")
    )
    walk = coordinates.vector(settings.walk, key="estimator.walk")
    axes = list(zip(position.tolist(), velocity.tolist(), walk.tolist(), strict=True))
    try:
        gains = {  # the equation is solved once for all coordinates that share their noises
            axis: kalman_gain(position_noise=axis[0], velocity_noise=axis[1], walk=axis[2], sample_time=sample_time)
            for axis in dict.fromkeys(axes)
        }
    except np.linalg.LinAlgError as error:
        remedy = "bring walk, position_noise and velocity_noise closer together"
        raise ScenarioError("estimator", f"has no stationary filter ({one_line(error)}); {remedy}") from error
    return KalmanEstimator(sample_time=sample_time, gain=np.array([gains[axis] for axis in axes]))
