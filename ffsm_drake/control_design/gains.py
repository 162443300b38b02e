"""Choosing gains: bandwidth and estimator of each coordinate group for a scenario's sensors, period and payload range.

Every group has its natural frequency w (K_P = w^2, K_D = 2 w; ASMC: K_D = K_s = w), the random walk q_N of its Kalman
estimate, and for the laws with an integral surface its K_s. The groups share only the effort, so each is
designed alone on its one-axis loop for a price of effort: it minimizes log(rms error) + price * effort. Lowering the
price traces the front of accuracy against effort. The result is evaluated with the coupled loop of all coordinates
along the plan.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import fmin

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.control_design.stability.margins import sampling_of
from ffsm_drake.control_design.stability.prediction import Plan, Prediction, make_plan, predict
from ffsm_drake.control_design.stability.sampled_loop import LawGains, Sampling, axis_poles, coupled_loop, law_gains
from ffsm_drake.scenario import Estimator, Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.systems.controllers.estimators import kalman_gain

# Prices of effort that the front is drawn for, per unit of ISV.
PRICES = (0.2, 0.08, 0.04, 0.022, 0.012, 0.006)
# The one-axis loop must contract at least this much for every payload.
LARGEST_RADIUS = 0.9995


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupDesign:
    """The design of one coordinate group."""

    omega: float  # rad/s
    walk: float  # rad/s^2 or m/s^2 per sqrt(s)
    k_s: float  # 1/s; zero for TDC


@dataclasses.dataclass(frozen=True, kw_only=True)
class DesignPoint:
    """One point of the front: gains, and the coupled loop's prediction with them."""

    groups: Mapping[str, GroupDesign]
    scenario: Scenario
    prediction: Prediction


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """The chosen gains and what they were chosen from."""

    chosen: DesignPoint
    front: tuple[DesignPoint, ...]
    reference: Prediction  # the scenario as it was
    published: Prediction  # the paper's gains and one-sample estimate with the same sensors
    ideal_isv: float
    budget: float  # ISV
    # True payload mass in kg -> prediction with the chosen gains.
    robustness: Mapping[float, Prediction]


def design(
    scenario: Scenario,
    *,
    budget: float | None = None,
    payload_range: tuple[float, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Design:
    """Design the gains of the scenario's controller, with the Kalman estimate.

    Args:
      budget: largest predicted ISV; default: 1.1 times that of perfect tracking.
      payload_range: lowest and highest true payload mass (kg, inertia in proportion) that the loop must be stable for;
        default: 0.6 to 2.5 times the nominal one.
      progress: called with (prices tried, prices in all).

    Raises:
      ScenarioError: no gains meet the budget, or a value of the scenario cannot be used.
    """
    plan = make_plan(scenario)
    reference, published = _predict(plan, scenario), _predict(plan, _published(scenario))
    budget = 1.1 * plan.ideal_isv if budget is None else budget
    nominal = scenario.payload.nominal.mass
    low, high = payload_range or (0.6 * nominal, 2.5 * nominal)
    if not 0.0 < low < high:
        raise ScenarioError("payload range", f"must be two masses 0 < LOW < HIGH in kg, not {low:g} and {high:g}")
    masses = np.linspace(low, high, 5)
    plans = {float(mass): make_plan(_with_true_mass(scenario, float(mass)), postures=3) for mass in masses}
    pairs = [pair for other in plans.values() for pair in other.mass_matrices]
    spread = np.array([np.linalg.eigvals(np.linalg.solve(h, h_hat)).real for h, h_hat in pairs])
    etas = np.linspace(spread.min(), spread.max(), 5)

    axes = {group: _Axis(plan, group, scenario.controller, etas) for group in dict.fromkeys(plan.coordinates.group_of)}
    search = {group: axis.start() for group, axis in axes.items()}
    searches, front = [], []
    for tried, price in enumerate(PRICES, start=1):
        search = {group: axes[group].minimize(price, search[group]) for group in axes}
        searches.append(search)
        front.append(_point(plan, scenario, axes, search))
        if progress is not None:
            progress(tried, len(PRICES))
        if front[0].prediction.isv > budget:  # the highest price: effort only rises from here
            cheapest = f"the cheapest gains found need {front[0].prediction.isv:.1f}"
            raise ScenarioError("budget", f"ISV {budget:.1f} cannot be met; {cheapest}")
    chosen = _at_budget(plan, scenario, axes, front, searches, budget)
    return Design(
        chosen=chosen,
        front=tuple(front),
        reference=reference,
        published=published,
        ideal_isv=plan.ideal_isv,
        budget=budget,
        robustness={mass: _predict(other, chosen.scenario) for mass, other in plans.items()},
    )


class _Axis:
    """One group's one-axis loop as a function of the logarithms of its design."""

    def __init__(self, plan: Plan, group: str, controller: str, etas: np.ndarray) -> None:
        part = plan.coordinates.groups[group]
        self.controller, self.etas = controller, etas
        self.period = plan.scenario.sample_time
        self.duration = plan.times.size * self.period
        self.demand = plan.demand[:, part]
        self.late = plan.times + self.period > min(5.0, 0.25 * self.duration)  # at the end of each sample
        # The group's worst sensors.
        self.noise = plan.position_noise[part].max(), plan.velocity_noise[part].max()
        # What a unit of Hhat^-1 tau costs: columns of Hhat at mid-motion.
        _, h_hat = plan.mass_matrices[len(plan.mass_matrices) // 2]
        self.weight = float((h_hat**2).sum(axis=0)[part].sum())
        self.integral = controller in ("aismc", "tde_aismc")

    def start(self) -> np.ndarray:
        """Logarithms of a first guess: a slow loop that is stable for any sensors."""
        return np.log([3.0, 1e-3, 0.5] if self.integral else [3.0, 1e-3])

    def read(self, x: np.ndarray) -> GroupDesign:
        omega, walk, *rest = np.exp(x)
        k_s = rest[0] if self.integral else omega if self.controller == "asmc" else 0.0
        return GroupDesign(omega=float(omega), walk=float(walk), k_s=float(k_s))

    def cost(self, x: np.ndarray) -> tuple[float, float]:
        """Mean square error (rad^2 or m^2) and effort of the noise (ISV); infinite outside the stable region."""
        group = self.read(x)
        one = np.ones((1, 1))
        gain = kalman_gain(
            position_noise=self.noise[0], velocity_noise=self.noise[1], walk=group.walk, sample_time=self.period
        )
        sampling = Sampling(sample_time=self.period, kalman_gain=gain[None])
        gains = _law(self.controller, group).at()
        if np.abs(axis_poles(gains, eta=self.etas, sampling=sampling)).max() > LARGEST_RADIUS:
            return np.inf, np.inf
        loop = coupled_loop(gains, true_mass_matrix=one, nominal_mass_matrix=one, sampling=sampling)
        covariance = loop.covariance(position_noise=np.array([self.noise[0]]), velocity_noise=np.array([self.noise[1]]))
        force = (loop.force @ covariance @ loop.force.T)[0, 0]
        # The error's response to the demand of one sample, its length doubled until it covers the run.
        count = len(self.demand)
        columns, power = loop.f, loop.a
        while columns.shape[1] < count:
            columns, power = np.hstack([columns, power @ columns]), power @ power
        response = np.fft.rfft(columns[:1, :count].T, 2 * count, axis=0)
        error = np.fft.irfft(response * np.fft.rfft(self.demand, 2 * count, axis=0), axis=0)[:count]
        return float((error[self.late] ** 2).mean() + covariance[0, 0]), float(self.duration * force * self.weight)

    def minimize(self, price: float, start: np.ndarray) -> np.ndarray:
        """The design (logarithms) that is best for a price of effort."""

        def objective(x: np.ndarray) -> float:
            square, effort = self.cost(x)
            return 0.5 * np.log(square) + price * effort if np.isfinite(square) else 1e3

        simplex = np.vstack([start, *(start + step for step in 0.5 * np.eye(start.size))])
        found: np.ndarray = fmin(
            objective, start, xtol=0.02, ftol=1e-4, maxiter=80 * start.size, initial_simplex=simplex, disp=False
        )
        return found


def _law(controller: str, group: GroupDesign) -> LawGains:
    one = np.ones(1)
    k_d, k_p = (group.omega, 0.0) if controller == "asmc" else (2.0 * group.omega, group.omega**2)
    integral = controller not in ("tdc", "asmc")
    return LawGains(k_d=k_d * one, k_p=k_p * one, integral=integral, k_s=group.k_s * one, k_s_max=one)


def _at_budget(
    plan: Plan,
    scenario: Scenario,
    axes: Mapping[str, _Axis],
    front: list[DesignPoint],
    searches: list[dict[str, np.ndarray]],
    budget: float,
) -> DesignPoint:
    """The point of the front that spends the budget, by bisection on the price."""
    efforts = [point.prediction.isv for point in front]
    if efforts[-1] <= budget:
        return front[-1]
    first = next(k for k, effort in enumerate(efforts) if effort > budget)
    low, high, best = np.log(PRICES[first]), np.log(PRICES[first - 1]), front[first - 1]
    start = searches[first - 1]
    for _ in range(4):
        price = 0.5 * (low + high)
        found = {group: axis.minimize(float(np.exp(price)), start[group]) for group, axis in axes.items()}
        point = _point(plan, scenario, axes, found)
        if point.prediction.isv <= budget:
            best, high = point, price
        else:
            low = price
    return best


def _point(plan: Plan, scenario: Scenario, axes: Mapping[str, "_Axis"], found: Mapping[str, np.ndarray]) -> DesignPoint:
    groups = {group: axes[group].read(x) for group, x in found.items()}
    designed = _with_gains(scenario, groups)
    return DesignPoint(groups=groups, scenario=designed, prediction=_predict(plan, designed))


def _predict(plan: Plan, scenario: Scenario) -> Prediction:
    gains = law_gains(scenario, plan.coordinates).at()
    return predict(plan, gains, sampling_of(scenario, plan.coordinates))


def _with_gains(scenario: Scenario, groups: Mapping[str, GroupDesign]) -> Scenario:
    """The scenario with designed gains, three digits each."""

    def each(value: Callable[[GroupDesign], float]) -> dict[str, float]:
        return {name: float(f"{value(group):.3g}") for name, group in groups.items()}

    data: dict[str, Any] = scenario_to_dict(scenario)
    data["estimator"] |= {"kind": "kalman", "walk": each(lambda group: group.walk)}
    gains = data["controllers"].setdefault(scenario.controller, {})
    if scenario.controller == "asmc":
        gains |= {"k_d": each(lambda group: group.omega), "k_s": each(lambda group: group.k_s)}
    else:
        gains |= {"k_d": each(lambda group: 2.0 * group.omega), "k_p": each(lambda group: group.omega**2)}
    if scenario.controller in ("aismc", "tde_aismc"):
        # Real noise drives |s| far past the laws' thresholds, so K_s would adapt to its bound: the bound is the design.
        gains |= {"k_s_initial": each(lambda group: group.k_s), "k_s_max": each(lambda group: group.k_s)}
    return scenario_from_dict(data)


def _published(scenario: Scenario) -> Scenario:
    """The scenario with the paper's gains and estimate."""
    return dataclasses.replace(scenario, controllers={}, estimator=Estimator())


def _with_true_mass(scenario: Scenario, mass: float) -> Scenario:
    data = scenario_to_dict(scenario)
    truth = data["payload"]["truth"]
    truth["inertia"] = [value * mass / truth["mass"] for value in truth["inertia"]]
    truth["mass"] = mass
    return scenario_from_dict(data)
