"""Accuracy and effort of a scenario, predicted without simulating it.

The loop is linear near every posture of the planned motion. Its response has two parts: one to the motion,
the error of the nominal payload and the disturbance (deterministic: the loop's recursion, driven by -N along the plan),
and one to the sensors' noise (stationary: a Lyapunov equation). Errors and efforts add as squares.
"""

import dataclasses

import numpy as np
from scipy.interpolate import CubicSpline

from ffsm_drake.control_design.stability.sampled_loop import CoupledLoop, LoopGains, Sampling, coupled_loop
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.systems.disturbance import make_disturbance
from ffsm_drake.systems.reference import make_motion

# Largest of about 2000 Gaussian samples, in standard deviations.
_PEAK = 3.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """The demands of a scenario on any controller: computed once, used for many gains."""

    scenario: Scenario
    coordinates: Coordinates
    times: np.ndarray  # (n,) control samples, s
    demand: np.ndarray  # (n, nv) -N under perfect tracking at mid-period, rad/s^2 or m/s^2
    force: np.ndarray  # (n, nv) generalized force of perfect tracking at mid-period, N m or N
    nominal_acceleration_force: np.ndarray  # (n, nv) Hhat a_d at mid-period, N m or N
    posture_of_sample: np.ndarray  # (n,) index of the posture used for each sample
    mass_matrices: list[tuple[np.ndarray, np.ndarray]]  # (H, Hhat) at the postures
    position_noise: np.ndarray  # (nv,) rad or m, quantisation included
    velocity_noise: np.ndarray  # (nv,)

    @property
    def ideal_isv(self) -> float:
        """Effort of perfect tracking without noise."""
        return float(np.sum(self.force**2) * self.scenario.sample_time)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted figures of a run; all infinite where the loop is unstable somewhere along the plan."""

    coordinates: Coordinates
    spectral_radius: float
    rms_error: np.ndarray  # (nv,) after the settling time, rad or m
    isv: float
    peak_effort: np.ndarray  # (nv,) N m or N

    def by_group(self) -> dict[str, float]:
        """Root mean square error over each group's coordinates."""
        groups = self.coordinates.groups
        return {name: float(np.sqrt(np.mean(self.rms_error[part] ** 2))) for name, part in groups.items()}


def make_plan(scenario: Scenario, *, postures: int = 7, points: int = 201) -> Plan:
    """The plan of a scenario. Raises ModelError or ScenarioError where its model or a value cannot be used."""
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    coordinates = nominal.coordinates
    reference = make_motion(scenario, coordinates)
    disturbance = make_disturbance(scenario.disturbance, coordinates)
    port, context = disturbance.GetOutputPort("generalized_force"), disturbance.CreateDefaultContext()
    samples = (np.arange(scenario.num_control_periods) + 0.5) * scenario.sample_time
    knots = np.linspace(0.0, samples[-1] + 0.5 * scenario.sample_time, points)
    rows = []
    for time in knots:
        q, v, a = reference.evaluate(time)
        context.SetTime(time)
        tau = true.calc_mass_matrix(q) @ a + true.calc_bias(q, v) - port.Eval(context)
        nominal_mass = nominal.calc_mass_matrix(q)
        rows.append(np.concatenate([np.linalg.solve(nominal_mass, tau) - a, tau, nominal_mass @ a]))
    demand, force, nominal_force = np.split(CubicSpline(knots, np.array(rows))(samples), 3, axis=1)
    posture_times = np.linspace(0.0, min(scenario.reference.duration, samples[-1]), postures)
    configurations = [reference.evaluate(time)[0] for time in posture_times]
    # Rounding to a step adds the variance of its sawtooth.
    position_noise, velocity_noise = (
        np.hypot(
            coordinates.vector(getattr(scenario.sensing, f"{part}_noise"), key=f"sensing.{part}_noise", default=0.0),
            coordinates.vector(
                getattr(scenario.sensing, f"{part}_quantization"), key=f"sensing.{part}_quantization", default=0.0
            )
            / np.sqrt(12.0),
        )
        for part in ("position", "velocity")
    )
    return Plan(
        scenario=scenario,
        coordinates=coordinates,
        times=samples - 0.5 * scenario.sample_time,
        demand=demand,
        force=force,
        nominal_acceleration_force=nominal_force,
        posture_of_sample=np.abs(samples[:, None] - posture_times).argmin(axis=1),
        mass_matrices=[(true.calc_mass_matrix(q), nominal.calc_mass_matrix(q)) for q in configurations],
        position_noise=position_noise,
        velocity_noise=velocity_noise,
    )


def predict(plan: Plan, gains: LoopGains, sampling: Sampling, *, settled_after: float = 5.0) -> Prediction:
    """Predict a run with given gains and estimator; the rms error counts from ``settled_after`` (s) on."""
    loops = [
        coupled_loop(gains, true_mass_matrix=h, nominal_mass_matrix=h_hat, sampling=sampling)
        for h, h_hat in plan.mass_matrices
    ]
    nv = plan.demand.shape[1]
    radius = max(loop.spectral_radius for loop in loops)
    if radius >= 1.0:
        infinite = np.full(nv, np.inf)
        return Prediction(
            coordinates=plan.coordinates, spectral_radius=radius, rms_error=infinite, isv=np.inf, peak_effort=infinite
        )
    error, effort = _deterministic(plan, loops)
    variance = {"error": np.zeros(nv), "force": np.zeros(nv)}
    for loop in loops[:: max(1, len(loops) // 3)]:
        response = loop.noise_response(position_noise=plan.position_noise, velocity_noise=plan.velocity_noise)
        for name in variance:
            variance[name] += response[name] ** 2 / len(loops[:: max(1, len(loops) // 3)])
    settled = plan.times > settled_after
    period = plan.scenario.sample_time
    return Prediction(
        coordinates=plan.coordinates,
        spectral_radius=radius,
        rms_error=np.sqrt((error[settled] ** 2).mean(axis=0) + variance["error"]),
        isv=float(np.sum(effort**2) * period + variance["force"].sum() * period * plan.times.size),
        peak_effort=np.abs(effort).max(axis=0) + _PEAK * np.sqrt(variance["force"]),
    )


def _deterministic(plan: Plan, loops: list[CoupledLoop]) -> tuple[np.ndarray, np.ndarray]:
    """True error at the samples and force over the periods (n, nv), without noise."""
    nv = plan.demand.shape[1]
    x = np.zeros(loops[0].a.shape[0])
    error, force = np.empty_like(plan.demand), np.empty_like(plan.demand)
    for k, posture in enumerate(plan.posture_of_sample):
        loop = loops[posture]
        error[k] = x[:nv]
        x = loop.a @ x + loop.f @ plan.demand[k]
        force[k] = loop.force @ x + plan.nominal_acceleration_force[k]
    return error, force
