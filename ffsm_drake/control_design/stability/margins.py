"""Stability of a scenario's sampled loop along its planned motion, and the expected course of its
adaptation.
"""

import dataclasses
import functools
import math

import numpy as np

from ffsm_drake.control_design.stability.linear_loop import LinearLoop
from ffsm_drake.control_design.stability.linearization import Linearizer, has_base_actuators
from ffsm_drake.control_design.stability.rehearsal import Rehearsal, rehearse
from ffsm_drake.control_design.stability.sampled_loop import (
    LawGains,
    LoopGains,
    Sampling,
    axis_loop,
    inertia_ratios,
    largest_sample_time,
    largest_stable_k_s,
    law_gains,
    tolerated_eta,
)
from ffsm_drake.loop.blocks import block_choices
from ffsm_drake.scenario import Scenario, from_grasp
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.flexible import HiddenMode
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import (
    PlantModel,
    make_flexible_plant,
    make_nominal_plant,
    make_true_plant,
)
from ffsm_drake.systems.controllers import PAPER_LAWS, gain_vectors
from ffsm_drake.systems.controllers.estimators import KalmanEstimator, make_estimator
from ffsm_drake.systems.disturbance import make_disturbance
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

# times 2/L: beyond, no loop is stable whose inertia is at least a sixth of the nominal one
_RUN_AWAY = 5.0
_GROWN = 1.5  # times that errors grow, from which on it is said
# fractions of the planned motion that the loop is linearised at
POSTURES = (0.0, 0.25, 0.5, 0.75, 1.0)


class StabilityWarning(UserWarning):
    """A scenario whose sampled loop is unstable, or whose adaptation may make it so."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisMargins:
    """What the one-axis loop of the paper's laws says in closed form, for the worst eta along the
    planned motion.
    """

    sampling: Sampling
    law: LawGains
    k_s_limit: np.ndarray  # (nv,) 1/s, NaN for a law without K_s, and of undriven coordinates
    sample_time_limit: np.ndarray  # (nv,) s
    eta_tolerated: np.ndarray  # (nv, 2) at the starting gains
    forecast_times: np.ndarray  # (p,) s
    forecast_k_s: np.ndarray  # (p, nv) 1/s, where adaptation is expected to take K_s

    @property
    def has_k_s(self) -> bool:
        """Whether the law has a reaching gain K_s."""
        return bool(np.isfinite(self.k_s_limit).any())

    @property
    def forecast_leaves(self) -> np.ndarray:
        """(nv,) whether adaptation is expected to take K_s out of its stable range within the
        run.
        """
        return np.nanmax(self.forecast_k_s, axis=0) > np.nan_to_num(self.k_s_limit, nan=np.inf)

    @property
    def may_leave(self) -> np.ndarray:
        """(nv,) whether nothing stops adaptation before the limit."""
        return self.law.k_s_max > np.nan_to_num(self.k_s_limit, nan=np.inf)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Margins:
    """Stability of a scenario's sampled loop along its planned motion, without a simulation."""

    scenario: Scenario
    coordinates: Coordinates
    times: np.ndarray  # (m,) s, the postures looked at
    # (m, na) eigenvalues of H^-1 Hhat of the driven coordinates there, H apparent
    # (calc_apparent_mass_matrix)
    eta: np.ndarray
    loops: tuple[LinearLoop, ...]  # the loop as it is wired, at some of them, at the starting gains
    loops_expected: tuple[LinearLoop, ...]  # the same with every K_s at its largest expected value
    # spectral radius at the worst of these with every K_s at its bound; NaN without bounds
    radius_at_bounds: float
    hidden_modes: tuple[HiddenMode, ...]  # at the start of the motion; none where nothing is hidden
    hidden: tuple[str, ...]  # names of the hidden coordinates
    # smallest and largest eta along the motion with what is hidden locked
    locked_eta: tuple[float, float]
    # None for a controller that is not the paper's, and where something delays
    axes: AxisMargins | None
    # with thrusters or wheels, of a loop that is stable without their limits
    rehearsal: Rehearsal | None = None

    @property
    def worst(self) -> LinearLoop:
        """The loop of the posture with the largest spectral radius, at the starting gains.

        Where a frame is tracked that of the start or the end of the motion: see ``growth``.
        """
        loops = (self.loops[0], self.loops[-1]) if self.loops[0].tracks_frame else self.loops
        return max(loops, key=lambda loop: loop.spectral_radius)

    @property
    def growth(self) -> float:
        """How many times small errors may grow while a tracked frame moves; 1 where none is
        tracked.

        What the joints cannot give of a twist, or hold back from their plan for the frame, makes
        the loop of a posture that is passed slowly unstable without being so anywhere it rests: the
        integral over the motion is what counts.
        """
        if not self.loops[0].tracks_frame:
            return 1.0
        times, step = [loop.time for loop in self.loops], self.loops[0].sample_time
        rates = [max(0.0, math.log(loop.spectral_radius)) / step for loop in self.loops]
        return math.exp(float(np.trapezoid(rates, times)))

    @property
    def edge_time(self) -> float:
        """The time, s, of the posture nearest to the edge: that of the largest spectral radius.

        With hidden coordinates, whose slow poles decay alike everywhere, that of the largest eta.
        """
        return (
            float(self.times[int(np.argmax(self.eta.max(axis=1)))])
            if self.hidden
            else self.worst.time
        )

    @property
    def starts_stable(self) -> bool:
        """Whether the loop contracts at the starting gains at every posture looked at."""
        return self.worst.spectral_radius < 1.0

    @property
    def verdict(self) -> str:
        """One line: "stable", or what is wrong."""
        if not self.starts_stable:
            worst = self.worst
            return (
                f"unstable: the sampled loop of {self.scenario.controller} has spectral radius "
                f"{worst.spectral_radius:.4f} at the posture of t = {worst.time:g} s"
            )
        if self.axes is None:
            return self._with_actuators
        if self.axes.forecast_leaves.any():
            i = int(np.argmax(self.axes.forecast_leaves))
            limit = self.axes.k_s_limit[i]
            time = self.axes.forecast_times[int(np.argmax(self.axes.forecast_k_s[:, i] > limit))]
            return (
                f"unstable: adaptation is expected to take K_s of {self.coordinates.names[i]} "
                "past its limit of "
                f"{limit:.1f} 1/s at t = {time:.1f} s"
            )
        if self.axes.may_leave.any():
            i = int(np.argmax(self.axes.may_leave))
            return (
                f"predicted stable, but nothing stops K_s before its limit "
                f"({self.axes.k_s_limit[i]:.1f} 1/s for {self.coordinates.names[i]}); set k_s_max"
            )
        return self._with_actuators

    @property
    def _with_actuators(self) -> str:
        """The verdict on a loop that is stable while nothing saturates."""
        found = self.rehearsal
        if found is None and self.growth > _GROWN:
            return (
                "stable at rest; while the frame moves, small errors grow by up to "
                f"{self.growth:.2g} times"
            )
        if found is None:
            return "stable"
        if found.share_diverged > 0.0:
            unstable = "unstable" if found.share_diverged >= 0.5 else "at the edge of stability"
            return f"{unstable} with its actuators: {found}"
        names = found.coordinates.names
        tolerance = np.array([
            self.scenario.tolerance_of(name, group)
            for name, group in zip(names, found.coordinates.group_of, strict=True)
        ])  # fmt: skip
        i = int(np.argmax(found.largest_error / tolerance))
        if found.largest_error[i] <= tolerance[i]:
            return f"stable with its actuators: {found}"
        return (
            f"stable with its actuators, but not expected to settle: {names[i]} is off by up to "
            f"{found.largest_error[i]:.2g} {found.coordinates.units[i]} at the end, beyond its "
            "tolerance of "
            f"{tolerance[i]:g}; {found}"
        )

    @property
    def is_stable(self) -> bool:
        """Whether the run starts inside its margin and is expected to stay there."""
        return (
            self.starts_stable
            and (self.axes is None or not bool(self.axes.forecast_leaves.any()))
            and (self.rehearsal is None or self.rehearsal.share_diverged < 0.5)
        )


def stability(scenario: Scenario, *, postures: int = 21) -> Margins:
    """Stability of the sampled loop of a scenario, with any controller and blocks; takes about a
    second.

    Args:
      scenario: what to look at.
      postures: number along the planned motion that the inertia ratios are computed at.

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or run.
    """
    scenario = from_grasp(scenario)
    nominal, true = _models(scenario)
    coordinates, motion = nominal.coordinates, make_motion(scenario, nominal.coordinates)
    times = np.linspace(motion.begin, motion.end, postures)
    eta = np.array([_ratios(true, nominal, motion, time) for time in times])
    locked = eta
    if true.hidden.names:
        rigid = driven_model(make_true_plant(scenario))
        locked = np.array([_ratios(rigid, nominal, motion, time) for time in times])
    instants = [motion.part(share) for share in POSTURES]
    with Linearizer(scenario) as linearizer:
        held, loops = dict[str, np.ndarray](), tuple(linearizer.at(time) for time in instants)
        expected = loops
        axes = (
            _axis_margins(scenario, true, nominal, eta, loops[0])
            if has_closed_form(scenario)
            else None
        )
        if axes is not None and axes.forecast_k_s.max() > axes.law.k_s.max():
            held = {"reaching_gain": axes.forecast_k_s.max(axis=0)}
            expected = tuple(linearizer.at(time, held=held) for time in instants)
        at_bounds, bounds = float("nan"), gain_vectors(scenario, coordinates).get("k_s_max")
        if bounds is not None and np.isfinite(bounds).all():
            worst = max(instants, key=lambda time: expected[instants.index(time)].spectral_radius)
            at_bounds = linearizer.at(worst, held={"reaching_gain": bounds}).spectral_radius
        rehearsal = None
        if (
            has_base_actuators(scenario)
            and max(loop.spectral_radius for loop in (*loops, *expected)) < 1.0
        ):
            mean = linearizer.follow(held=held)
            rehearsal = rehearse(scenario, held=held, mean=mean)
    return Margins(
        scenario=scenario,
        coordinates=coordinates,
        times=times,
        eta=eta,
        loops=loops,
        loops_expected=expected,
        radius_at_bounds=at_bounds,
        hidden_modes=tuple(true.hidden_modes(motion.evaluate(motion.begin)[0])),
        hidden=true.hidden.names,
        locked_eta=(float(locked.min()), float(locked.max())),
        axes=axes,
        rehearsal=rehearsal,
    )


def has_closed_form(scenario: Scenario) -> bool:
    """Whether the one-axis loop is that of the scenario: one of the paper's laws, nothing late,
    slow or replaced.
    """
    if scenario.controller not in PAPER_LAWS or scenario.actuation.delay or block_choices(scenario):
        return False
    sensing, estimator = scenario.sensing, scenario.estimator
    late = (sensing.position_delay, sensing.velocity_delay, estimator.velocity_bias_walk)
    slow = (sensing.position_period, sensing.velocity_period)
    return estimator.kind != "coupled" and not (
        sensing.delay
        or estimator.delay
        or any(value for values in late for value in values.values())
        or any(value > 1 for values in slow for value in values.values())
    )


def _axis_margins(
    scenario: Scenario, true: PlantModel, nominal: PlantModel, eta: np.ndarray, loop: LinearLoop
) -> AxisMargins:
    law, sampling = (
        law_gains(scenario, nominal.coordinates),
        sampling_of(scenario, nominal.coordinates),
    )

    # Coordinates with the same gains have the same limits.
    @functools.cache
    def limits(*gains: float) -> tuple[float, float, float, float]:
        axis = kinds.index(gains)
        etas = np.linspace(eta.min(), eta.max(), 9)
        k_s_limit = (
            math.nan
            if scenario.controller == "tdc"
            else min(largest_stable_k_s(law, axis, eta=x, sampling=sampling) for x in etas)
        )
        period = min(largest_sample_time(law, axis, eta=x, sampling=sampling) for x in etas)
        return k_s_limit, period, *tolerated_eta(law, axis, sampling=sampling)

    filters = (
        () if sampling.kalman_gain is None else sampling.kalman_gain.reshape(law.k_d.size, -1).T
    )
    kinds = list(
        zip(*(column.tolist() for column in (law.k_d, law.k_p, law.k_s, *filters)), strict=True)
    )
    table = np.array([limits(*gains) for gains in kinds])
    forecast_times, forecast_k_s = forecast_reaching_gain(
        scenario, law, sampling, true, nominal, loop
    )
    return AxisMargins(
        sampling=sampling,
        law=law,
        k_s_limit=np.where(nominal.coordinates.is_driven, table[:, 0], np.nan),
        sample_time_limit=table[:, 1],
        eta_tolerated=table[:, 2:],
        forecast_times=forecast_times,
        forecast_k_s=forecast_k_s,
    )


def stability_warning(scenario: Scenario) -> str:
    """One line when a scenario starts unstable or its adaptation may become so; empty otherwise.

    A fast check at the start of the motion, made by ``simulate`` before a run without user-supplied
    blocks.
    """
    scenario = from_grasp(scenario)
    with Linearizer(scenario) as linearizer:
        if remark := _warning(scenario, linearizer):
            return remark
        if not has_base_actuators(scenario):
            return ""
        found = rehearse(scenario, seeds=1, held=expected_gains(linearizer))
    return (
        f"with its actuators the sampled loop is expected to diverge: {found}"
        if found.share_diverged
        else ""
    )


def _warning(scenario: Scenario, linearizer: Linearizer) -> str:
    radius = linearizer.at(0.0).spectral_radius
    remedy = f"see 'ffsm stability' for the margins of {scenario.controller}"
    if radius >= 1.0:
        return (
            "the sampled loop is unstable at the starting gains (spectral radius "
            f"{radius:.4f}); {remedy}"
        )
    if not has_closed_form(scenario):
        return ""
    nominal, true = _models(scenario)
    law, sampling = (
        law_gains(scenario, nominal.coordinates),
        sampling_of(scenario, nominal.coordinates),
    )
    if np.array_equal(law.k_s_max, law.k_s):
        return ""
    unbounded = ~np.isfinite(law.k_s_max)
    if (
        not unbounded.any()
        and linearizer.at(0.0, held={"reaching_gain": law.k_s_max}).spectral_radius < 1.0
    ):
        return ""
    eta = _ratios(true, nominal, make_motion(scenario, nominal.coordinates), 0.0)[-1]
    axis = int(np.argmax(law.k_s_max))
    limit = largest_stable_k_s(law, axis, eta=eta, sampling=sampling)
    bound = "is not bounded" if unbounded.any() else f"may grow to {law.k_s_max.max():g} 1/s"
    return (
        f"K_s {bound}, but the sampled loop is stable only below about {limit:.0f} 1/s; set "
        f"k_s_max, or {remedy}"
    )


def expected_gains(linearizer: Linearizer, loop: LinearLoop | None = None) -> dict[str, np.ndarray]:
    """What adaptation is expected to make of a law's held gains (``Linearizer.at``): every K_s at
    its largest.

    ``loop`` is that at the starting gains, where it is known; default: at the start. Empty where
    nothing adapts or no forecast is known.
    """
    scenario = linearizer.given
    if not has_closed_form(scenario):
        return {}
    nominal, true = _models(scenario)
    law, sampling = (
        law_gains(scenario, nominal.coordinates),
        sampling_of(scenario, nominal.coordinates),
    )
    if np.array_equal(law.k_s_max, law.k_s):
        return {}
    loop = linearizer.at(0.0) if loop is None else loop
    _, k_s = forecast_reaching_gain(scenario, law, sampling, true, nominal, loop, points=51)
    return {"reaching_gain": k_s.max(axis=0)}


def forecast_reaching_gain(
    scenario: Scenario,
    law: LawGains,
    sampling: Sampling,
    true: PlantModel,
    nominal: PlantModel,
    loop: LinearLoop,
    *,
    points: int = 101,
) -> tuple[np.ndarray, np.ndarray]:
    """Where laws (9) and (21) are expected to take K_s: times (p,) in s, K_s (p, nv) in 1/s.

    The laws see |s|. Its steady part follows the planned motion: what a steadily changing N leaves
    of s (-Ntilde / K_s for the one-sample estimate, with Ntilde the change of N over one sample).
    The noise part is Gaussian: its deviation at the starting gains is that of ``loop``, and changes
    with K_s as that of the one-axis loop does whose eta is the coordinate's own entry of H^-1 Hhat
    at the time of ``loop``. The sign term adds its own oscillation at half the sampling rate. The
    mean of the law over that distribution is integrated. A K_s that grows past all that this covers
    is given as the largest that it can become.
    """
    times = np.linspace(0.0, scenario.num_control_periods * scenario.sample_time, points)
    coordinates = nominal.coordinates
    gains = gain_vectors(scenario, coordinates)
    if "alpha" not in gains:
        return times, np.tile(law.k_s, (points, 1))
    alpha, beta = gains["alpha"], gains["beta"]
    switching = gains.get("g_initial", np.zeros_like(alpha))
    noise = [
        coordinates.vector(
            getattr(scenario.sensing, f"{name}_noise"), key=f"sensing.{name}_noise", default=0.0
        )
        for name in ("position", "velocity")
    ]
    locked = driven_model(make_true_plant(scenario)) if true.hidden.names else true
    drift = _lumped_uncertainty_drift(scenario, locked, nominal, times)
    square = scenario.controller == "aismc"

    # Per coordinate, the deviation of s and the sign term's amplitude against K_s, on a grid.
    grid = np.linspace(1.0, 2.0 / scenario.sample_time, 20)
    motion = make_motion(scenario, coordinates)
    eta = np.diagonal(np.linalg.solve(*_mass_matrices(true, nominal, motion, loop.time)))
    response = _sliding_response(law, grid, noise, sampling, eta)
    alone = np.array(
        [np.interp(law.k_s[i], grid, response["deviation"][i]) for i in range(law.k_s.size)]
    )
    wired = loop.noise_response(scenario.num_control_periods).get("sliding_variable", alone)
    factor = np.divide(
        wired, alone, out=np.ones_like(alone), where=np.isfinite(wired) & (alone > 0.0)
    )

    k_s = np.empty((points, law.k_s.size))
    k_s[0] = law.k_s
    for j in range(points - 1):
        for i in range(law.k_s.size):
            now = k_s[j, i]
            sigma = factor[i] * np.interp(now, grid, response["deviation"][i])
            chatter = switching[i] * np.interp(now, grid, response["sign_amplitude"][i])
            mean = math.hypot(
                drift[j, i] * np.interp(now, grid, response["drift_gain"][i]), chatter
            )
            threshold = now * now / beta[i] if square else now / beta[i]
            rate = alpha[i] * _mean_signed_magnitude(mean, sigma, threshold)
            k_s[j + 1, i] = min(
                max(now + rate * (times[j + 1] - times[j]), 0.0), law.k_s_max[i], grid[-1]
            )
    return times, np.where(k_s < grid[-1], k_s, np.minimum(law.k_s_max, _RUN_AWAY * grid[-1]))


def _mean_signed_magnitude(mean: float, sigma: float, threshold: float) -> float:
    """E[|s| sgn(|s| - threshold)] for a Gaussian s."""
    if sigma <= 0.0:
        return abs(mean) * math.copysign(1.0, abs(mean) - threshold)

    def partial(a: float, b: float) -> float:
        """Integral of s times the density from a to b."""
        za, zb = (a - mean) / (sigma * math.sqrt(2.0)), (b - mean) / (sigma * math.sqrt(2.0))
        density = sigma / math.sqrt(2.0 * math.pi) * (math.exp(-za * za) - math.exp(-zb * zb))
        return density + 0.5 * mean * (math.erf(zb) - math.erf(za))

    inside = partial(0.0, threshold) - partial(-threshold, 0.0)
    far = abs(mean) + 12.0 * sigma + threshold
    outside = partial(threshold, far) - partial(-far, -threshold)
    return outside - inside


def _sliding_response(
    law: LawGains, grid: np.ndarray, noise: list[np.ndarray], sampling: Sampling, eta: np.ndarray
) -> dict[str, np.ndarray]:
    """Response of one axis's s to its inputs, by coordinate and K_s of the grid (nv, k).

    ``deviation`` under the noise; ``drift_gain``, |s| per unit of dN/dt; ``sign_amplitude``, per
    unit of G: the sign term's oscillation alternates every sample, so its amplitude is the loop's
    gain from u to s at z = -1.
    """
    k_d, k_p, position, velocity, ratio = (
        values[:, None] for values in (law.k_d, law.k_p, *noise, eta)
    )
    if sampling.kalman_gain is not None:
        sampling = dataclasses.replace(
            sampling, kalman_gain=np.repeat(sampling.kalman_gain, grid.size, axis=0)
        )
    gains = LoopGains(k_v=k_d + grid, k_p=k_p + grid * k_d, k_i=grid * k_p)
    loop = axis_loop(gains, sampling=sampling, eta=ratio)
    stable = loop.spectral_radius <= 1.0 - 1e-9
    covariance = loop.covariance(position_noise=position, velocity_noise=velocity)
    # s = v + K_D e + K_P I of what the law works on, and where a unit of u enters.
    step, size = sampling.sample_time, loop.f.shape[-1]
    enter = np.zeros(size)
    enter[[0, 1, 3]] = 0.0 if sampling.euler else -0.5 * step**2, -step, 1.0
    if sampling.kalman_gain is None:  # measured values
        read = np.stack(np.broadcast_arrays(k_d, 1.0, k_p, 0.0, 0.0), axis=-1)
        direct = (k_d * position) ** 2 + velocity**2
    else:  # estimates, as the state holds them after the update
        read = np.stack(
            np.broadcast_arrays(0.0, 0.0, k_p, 0.0, k_d - step * k_p, 1.0, 0.0), axis=-1
        )
        direct = np.zeros_like(k_d)
    eye, a = np.eye(size), np.where(stable[..., None, None], loop.a, 0.0)
    ramp = np.linalg.solve(eye - a, loop.f[..., None] * step)
    drift = np.linalg.solve(eye - a, ramp)[..., 0]
    alternating = np.linalg.solve(-eye - a, enter[:, None])[..., 0]
    with np.errstate(invalid="ignore"):  # of the unstable ones
        variance = np.einsum("...i,...ij,...j->...", read, covariance, read) + direct
        deviation = np.sqrt(np.maximum(variance, 0.0))
    result = {
        "deviation": deviation,
        "drift_gain": np.abs((read * drift).sum(axis=-1)),
        "sign_amplitude": np.abs((read * alternating).sum(axis=-1)),
    }
    for name, values in result.items():
        # Past the limit s grows without bound; a value far beyond every threshold stands for it.
        largest = np.where(stable, values, 0.0).max(axis=-1, keepdims=True)
        result[name] = np.where(stable, values, np.where(largest > 0.0, 10.0 * largest, 1e3))
    return result


def _lumped_uncertainty_drift(
    scenario: Scenario, true: PlantModel, nominal: PlantModel, times: np.ndarray
) -> np.ndarray:
    """dN/dt (p, nv) along the planned motion under perfect tracking, N = a_d - Hhat^-1 tau
    (equation (2)).
    """
    reference = make_motion(scenario, nominal.coordinates)
    disturbance = make_disturbance(scenario.disturbance, nominal.coordinates)
    port, context = (
        disturbance.GetOutputPort("generalized_force"),
        disturbance.CreateDefaultContext(),
    )
    lumped = []
    for time in times:
        q, v, a = reference.evaluate(time)
        context.SetTime(time)
        tau = true.calc_mass_matrix(q) @ a + true.calc_bias(q, v) - port.Eval(context)
        lumped.append(a - np.linalg.solve(nominal.calc_mass_matrix(q), tau))
    return np.gradient(np.array(lumped), times, axis=0)


def _models(scenario: Scenario) -> tuple[PlantModel, PlantModel]:
    """The nominal and the true plant, of the driven coordinates."""
    return driven_model(make_nominal_plant(scenario)), driven_model(make_flexible_plant(scenario))


def _ratios(
    true: PlantModel, nominal: PlantModel, motion: PlannedMotion, time: float
) -> np.ndarray:
    """eta (na) of the driven coordinates at a time of the motion."""
    pick = np.ix_(motion.coordinates.driven, motion.coordinates.driven)
    return inertia_ratios(*(matrix[pick] for matrix in _mass_matrices(true, nominal, motion, time)))


def _mass_matrices(
    true: PlantModel, nominal: PlantModel, motion: PlannedMotion, time: float
) -> tuple[np.ndarray, np.ndarray]:
    q, _, _ = motion.evaluate(time)
    return true.calc_apparent_mass_matrix(q), nominal.calc_mass_matrix(q)


def sampling_of(scenario: Scenario, coordinates: Coordinates) -> Sampling:
    """How a scenario's loop is sampled, its estimator included."""
    config = scenario.simulator_config
    estimator = make_estimator(scenario, coordinates)
    return Sampling(
        sample_time=scenario.sample_time,
        # Explicit Euler at the control period is a plant of its own; with smaller steps it is just
        # inexact.
        euler=config.integration_scheme == "explicit_euler"
        and config.max_step_size >= 0.999 * scenario.sample_time,
        kalman_gain=estimator.gain if isinstance(estimator, KalmanEstimator) else None,
    )
