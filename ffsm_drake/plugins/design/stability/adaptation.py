"""The K_s that adaptation is expected to reach, from the noise and the drift of the sliding
variable.
"""

import math
from collections.abc import Iterator

import numpy as np

from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.one_axis import axis_loop
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.controllers.checked import reaching_gain_of
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl

# times 2/L: above it no loop is stable whose inertia is at least a sixth of the nominal one
_RUN_AWAY = 5.0


def axis_law(linearizer: Linearizer) -> TimeDelayControl | None:
    """The linearizer's control law where its loop consists of axes (``one_axis``): a law by axis
    that adapts as its hook says, without delays, slow sensors and user-supplied blocks; else None.
    """
    scenario = linearizer.given
    sensing, estimator = scenario.sensing, scenario.estimator
    late = (sensing.position_delay, sensing.velocity_delay, estimator.velocity_bias_walk)
    slow = (sensing.position_period, sensing.velocity_period)
    if (
        scenario.blocks.choices()
        or scenario.actuation.delay
        or sensing.delay
        or estimator.delay
        or any(value for values in late for value in values.values())
        or any(value > 1 for values in slow for value in values.values())
        or not linearizer.own_adaptation.is_as_stated
    ):
        return None
    return linearizer.axes


def is_euler(scenario: Scenario) -> bool:
    """Whether the plant steps as explicit Euler at the control period, which is a different plant;
    smaller steps are only inexact.
    """
    config = scenario.simulator_config
    at_period = config.max_step_size >= 0.999 * scenario.sample_time
    return config.integration_scheme == "explicit_euler" and at_period


def expected_gains(linearizer: Linearizer, loop: LinearLoop | None = None) -> dict[str, np.ndarray]:
    """The held gains (``Linearizer.at``) with every K_s at its largest expected value; empty
    without adaptation or a forecast.

    ``loop`` is the loop at the starting gains; default: that of the start.
    """
    law = axis_law(linearizer)
    gain = reaching_gain_of(law)
    if law is None or gain is None or not gain.changes:
        return {}
    loop = linearizer.at(0.0) if loop is None else loop
    _, k_s = forecast_reaching_gain(law, linearizer.planned, loop, points=51)
    return {"reaching_gain": k_s.max(axis=0)}


def adapts(linearizer: Linearizer) -> bool:
    """Whether adaptation can change the K_s of a linearizer's law."""
    gain = reaching_gain_of(linearizer.law)
    if gain is None:
        return False
    return gain.changes or not linearizer.own_adaptation.is_as_stated


def reached_gains(
    linearizer: Linearizer, loop: LinearLoop | None = None
) -> Iterator[tuple[dict[str, np.ndarray], str]]:
    """The held gains (``Linearizer.at``) that adaptation may reach, and words for them: K_s at its
    bounds, if all are finite and hold, then the largest K_s expected, if there is a forecast.

    A loop that is stable with the first needs no second. ``loop``: see ``expected_gains``.
    """
    if not adapts(linearizer):
        return
    gain = reaching_gain_of(linearizer.law)
    keeps_bound = linearizer.own_adaptation.keeps_bound
    if gain is not None and keeps_bound and np.isfinite(gain.largest).all():
        why = "" if axis_law(linearizer) else " (its course cannot be predicted)"
        yield {"reaching_gain": gain.largest}, f" with K_s at its bounds{why}"
    if expected := expected_gains(linearizer, loop):
        yield expected, " with the largest K_s expected"


def forecast_reaching_gain(
    law: TimeDelayControl, planned: PlannedDynamics, loop: LinearLoop, *, points: int = 101
) -> tuple[np.ndarray, np.ndarray]:
    """The expected course of K_s: times (p,) in s, K_s (p, nv) in 1/s; zero for a law without K_s.

    Adaptation is driven by |s|. The steady part of s follows the planned motion: it is the response
    to a steadily changing N (-Ntilde / K_s for the one-sample estimate, with Ntilde the change of N
    over one sample). The noise part is Gaussian: its deviation at the starting gains is taken
    from ``loop``, and changes with K_s as in the one-axis loop with eta equal to the coordinate's
    entry of H^-1 Hhat at the time of ``loop``. The sign term adds an oscillation at half the
    sampling rate. The mean of the law over this distribution is integrated. A K_s beyond the grid
    is returned as its upper bound.
    """
    scenario = planned.scenario
    times = np.linspace(0.0, scenario.num_control_periods * scenario.sample_time, points)
    size, gain = planned.coordinates.num_velocities, reaching_gain_of(law)
    if gain is None or gain.rate is None:
        return times, np.tile(np.zeros(size) if gain is None else gain.start, (points, 1))
    switching = law.initial_state().get("switching_gain", np.zeros(size))
    drift = planned.drift(times)
    grid = np.linspace(1.0, 2.0 / scenario.sample_time, 20)
    curves = np.stack(_sliding_response(law, planned, loop, grid))
    k_s = np.empty((points, size))
    k_s[0] = gain.start
    for j in range(points - 1):
        now, step = k_s[j], times[j + 1] - times[j]
        sigma, per_drift, per_sign = np.array([
            [np.interp(x, grid, own) for x, own in zip(now, curve.T, strict=True)]
            for curve in curves
        ])  # fmt: skip
        mean = np.hypot(drift[j] * per_drift, switching * per_sign)
        seen = _mean_signed_magnitude(mean, sigma, gain.rest(now))
        after = np.maximum(now + gain.rate * seen * step, 0.0)
        k_s[j + 1] = np.minimum(np.minimum(after, gain.largest), grid[-1])
    return times, np.where(k_s < grid[-1], k_s, np.minimum(gain.largest, _RUN_AWAY * grid[-1]))


def _mean_signed_magnitude(
    mean: np.ndarray, sigma: np.ndarray, threshold: np.ndarray
) -> np.ndarray:
    """E[|s| sgn(|s| - threshold)] for Gaussian s; arrays (n)."""
    spread = np.where(sigma > 0.0, sigma, 1.0)
    z = (np.stack([-threshold, 0.0 * threshold, threshold]) - mean) / (spread * math.sqrt(2.0))
    # without SciPy, which a first run does not load
    error_function = np.array([math.erf(each) for each in z.ravel().tolist()]).reshape(z.shape)
    # integral of s times its density, up to a constant
    below, zero, above = 0.5 * mean * error_function - spread / math.sqrt(2.0 * math.pi) * np.exp(
        -z * z
    )
    fixed = np.abs(mean) * np.copysign(1.0, np.abs(mean) - threshold)
    return np.where(sigma > 0.0, 2.0 * (zero - below - above), fixed)


def _sliding_response(
    law: TimeDelayControl, planned: PlannedDynamics, wired: LinearLoop, grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Response of s for each K_s of the grid (k, nv): standard deviation under the noise; |s| per
    unit of dN/dt; amplitude per unit of G, the gain from u to s at z = -1, as the sign term
    alternates every sample.
    """
    scenario, coordinates = planned.scenario, planned.coordinates
    position, velocity = (
        coordinates.vector(
            getattr(scenario.sensing, f"{name}_noise"), key=f"sensing.{name}_noise", default=0.0
        )
        for name in ("position", "velocity")
    )
    eta = np.diagonal(np.linalg.solve(*planned.mass_matrices(wired.time)))
    many = law.with_reaching_gain(grid[:, None])
    loop = axis_loop(many, eta=eta, euler=is_euler(scenario), also="sliding_variable")
    s, step = loop.part("sliding_variable"), scenario.sample_time
    stable = loop.spectral_radius <= 1.0 - 1e-9
    covariance = loop.covariance(position_noise=position, velocity_noise=velocity)
    eye, a = np.eye(loop.a.shape[-1]), np.where(stable[..., None, None], loop.a, 0.0)
    ramp = np.linalg.solve(eye - a, loop.f[..., None] * step)
    drift = np.linalg.solve(eye - a, ramp)[..., s, 0]
    alternating = np.linalg.solve(-eye - a, loop.g[..., None])[..., s, 0]
    with np.errstate(invalid="ignore"):  # unstable loops
        deviation = np.sqrt(np.maximum(covariance[..., s, s], 0.0))

    def bounded(values: np.ndarray) -> np.ndarray:
        """Values with one far above every threshold where the loop is unstable."""
        largest = np.where(stable, values, 0.0).max(axis=0)
        return np.where(stable, values, np.where(largest > 0.0, 10.0 * largest, 1e3))

    deviation = bounded(deviation)
    start = law.initial_state()["reaching_gain"]
    alone = np.array([np.interp(start[i], grid, deviation[:, i]) for i in range(start.size)])
    found = wired.noise_response(scenario.num_control_periods).get("sliding_variable", alone)
    usable = np.isfinite(found) & (alone > 0.0)
    factor = np.divide(found, alone, out=np.ones_like(alone), where=usable)
    return factor * deviation, bounded(np.abs(drift)), bounded(np.abs(alternating))
