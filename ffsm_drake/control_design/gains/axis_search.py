"""Designs of the paper's laws, group by group on the one-axis loop."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import fmin

from ffsm_drake.control_design.gains.requirement import DesignPoint, Requirement
from ffsm_drake.control_design.stability.demand import Demand
from ffsm_drake.control_design.stability.linearization import smooth_sensing
from ffsm_drake.control_design.stability.sampled_loop import (
    LoopGains,
    Sampling,
    axis_loop,
    axis_poles,
    inertia_ratios,
)
from ffsm_drake.scenario import Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.free_floating import driven_model
from ffsm_drake.spacecraft.nominal import make_flexible_plant, make_nominal_plant
from ffsm_drake.systems.controllers.filter_gains import kalman_gain
from ffsm_drake.systems.reference import make_motion

# Prices of effort that the front is computed for, per unit of ISV.
PRICES = (0.2, 0.08, 0.04, 0.022, 0.012, 0.006)
# The one-axis loop must contract at least this much for every payload.
LARGEST_RADIUS = 0.9995
# s; times the velocity noise, what a filter assumes of positions that are exact: it would else only
# differentiate them.
_POSITION_NOISE_TIME = 0.1
# By how much the range of inertia ratios is widened for it.
_WIDER = 1.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupDesign:
    """The design of one coordinate group of one of the paper's laws."""

    omega: float  # rad/s
    walk: float  # rad/s^2 or m/s^2 per sqrt(s); NaN for the one-sample estimate
    k_s: float  # 1/s; zero for TDC


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrontPoint:
    """One point of the front of accuracy against effort."""

    isv: float
    rms_error: Mapping[str, float]  # by group, rad or m


class AxisSearch:
    """The designs of one of the paper's laws with one kind of estimate, group by group on the
    one-axis loop.
    """

    def __init__(
        self,
        scenario: Scenario,
        demand: Demand,
        kind: str,
        masses: list[float],
        *,
        on_price: Callable[[], None],
    ) -> None:
        self._scenario, self._demand, self._kind = scenario, demand, kind
        etas = _eta_range(scenario, masses)
        groups = dict.fromkeys(demand.coordinates.group_of)
        self._axes = {group: _Axis(scenario, demand, group, kind, etas) for group in groups}
        self._designs, point = [], {group: axis.start() for group, axis in self._axes.items()}
        for price in PRICES:
            point = self._minimize(price, point)
            self._designs.append(point)
            on_price()
        self._chosen = self._designs[0]

    @property
    def front(self) -> tuple[FrontPoint, ...]:
        """What the one-axis loops promise at each price."""
        points = []
        for point in self._designs:
            costs = {group: axis.cost(point[group]) for group, axis in self._axes.items()}
            errors = {group: float(np.sqrt(square)) for group, (square, _) in costs.items()}
            points.append(FrontPoint(isv=self._isv(point), rms_error=errors))
        return tuple(points)

    def at_budget(
        self, requirement: Requirement, evaluate: Callable[[Scenario], DesignPoint]
    ) -> DesignPoint:
        """The point that spends the budget, by bisection on the price; the cheapest where none is
        within it.
        """
        budget, allowed = requirement.budget, requirement.budget
        tried = list[tuple[DesignPoint, dict[str, np.ndarray]]]()
        for _ in range(2):  # the loop of all coordinates costs more or less than its axes alone
            chosen = self._within(allowed)
            tried.append((evaluate(self._with_gains(chosen)), chosen))
            excess = tried[-1][0].prediction.isv - budget
            last = self._designs[0] if excess > 0.0 else self._designs[-1]
            spent = -0.1 * (budget - self._demand.ideal_isv) < excess <= 0.0
            if spent or chosen is last or not np.isfinite(excess):
                break
            allowed = self._isv(chosen) - (1.05 if excess > 0.0 else 0.95) * excess
        best, self._chosen = min(tried, key=lambda each: requirement.rank(each[0]))
        return best

    def at_the_edge(self) -> list[str]:
        """The groups whose chosen design would leave the stable region by a small step."""
        steps = 0.05 * np.vstack([np.eye(3), -np.eye(3)])
        return [
            group
            for group, axis in self._axes.items()
            if group in self._demand.coordinates.driven_groups
            and any(
                not np.isfinite(axis.cost(x + step[: x.size])[0])
                for x in [self._chosen[group]]
                for step in steps
            )
        ]

    def _within(self, budget: float) -> dict[str, np.ndarray]:
        efforts = [self._isv(point) for point in self._designs]
        if efforts[-1] <= budget:
            return self._designs[-1]
        first = next(k for k, effort in enumerate(efforts) if effort > budget)
        if first == 0:
            return self._designs[0]
        low, high, best = np.log(PRICES[first]), np.log(PRICES[first - 1]), self._designs[first - 1]
        start = best
        for _ in range(4):
            price = 0.5 * (low + high)
            point = self._minimize(float(np.exp(price)), start)
            if self._isv(point) <= budget:
                best, high = point, price
            else:
                low = price
        return best

    def _minimize(self, price: float, start: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {group: axis.minimize(price, start[group]) for group, axis in self._axes.items()}

    def _isv(self, point: Mapping[str, np.ndarray]) -> float:
        return self._demand.ideal_isv + sum(
            axis.cost(point[group])[1] for group, axis in self._axes.items()
        )

    def _with_gains(self, point: Mapping[str, np.ndarray]) -> Scenario:
        """The scenario with designed gains, three digits each."""
        scenario, groups = (
            self._scenario,
            {group: self._axes[group].read(x) for group, x in point.items()},
        )

        def each(value: Callable[[GroupDesign], float]) -> dict[str, float]:
            return {name: float(f"{value(group):.3g}") for name, group in groups.items()}

        data: dict[str, Any] = scenario_to_dict(scenario)
        data["estimator"]["kind"] = self._kind
        if self._kind == "kalman":
            data["estimator"]["walk"] = each(lambda group: group.walk)
            if any(axis.assumed != axis.noise for axis in self._axes.values()):
                assumed = {group: axis.assumed for group, axis in self._axes.items()}
                data["estimator"]["position_noise"] = {
                    group: position for group, (position, _) in assumed.items()
                }
                data["estimator"]["velocity_noise"] = {
                    group: velocity for group, (_, velocity) in assumed.items()
                }
        gains = data["controllers"].setdefault(scenario.controller, {})
        if scenario.controller == "asmc":
            gains |= {"k_d": each(lambda group: group.omega), "k_s": each(lambda group: group.k_s)}
        else:
            gains |= {
                "k_d": each(lambda group: 2.0 * group.omega),
                "k_p": each(lambda group: group.omega**2),
            }
        if scenario.controller in ("aismc", "tde_aismc"):
            # Real noise drives |s| far past the laws' thresholds, so K_s would adapt to its bound,
            # which is the design.
            gains |= {
                "k_s_initial": each(lambda group: group.k_s),
                "k_s_max": each(lambda group: group.k_s),
            }
        return scenario_from_dict(data)


class _Axis:
    """One group's one-axis loop as a function of the logarithms of its design: [omega, K_s if any,
    walk if any].
    """

    def __init__(
        self, scenario: Scenario, demand: Demand, group: str, kind: str, etas: np.ndarray
    ) -> None:
        part, sensing = demand.coordinates.groups[group], smooth_sensing(scenario)
        self.controller, self.etas, self.kalman = scenario.controller, etas, kind == "kalman"
        self.period = scenario.sample_time
        self.duration = demand.times.size * self.period
        # Of the run's demand, padded: by it the error is a product.
        self.spectrum = np.fft.rfft(demand.lumped[:, part].T, 2 * demand.times.size)
        # at the end of each sample
        self.late = demand.times + self.period > min(5.0, 0.25 * self.duration)
        # The group's worst sensors.
        self.noise = tuple(
            float(demand.coordinates.vector(noise, key="sensing", default=0.0)[part].max())
            for noise in (sensing.position_noise, sensing.velocity_noise)
        )
        position, velocity = self.noise
        self.assumed = position or _POSITION_NOISE_TIME * velocity, velocity
        # What a unit of Hhat^-1 tau costs: columns of Hhat at mid-motion.
        self.weight = float((_mass_matrices(scenario, [0.5])[0][1] ** 2).sum(axis=0)[part].sum())
        self.integral = self.controller in ("aismc", "tde_aismc")
        # The search comes back to a design, with another estimate of the same gains from its
        # beginning.
        self._costs = dict[bytes, tuple[float, float]]()
        self._designs = dict[tuple[float, bytes], np.ndarray]()

    def start(self) -> np.ndarray:
        """Logarithms of a first guess: a slow loop that is stable for any sensors."""
        return np.log([3.0, *([0.5] if self.integral else []), *([1e-3] if self.kalman else [])])

    def read(self, x: np.ndarray) -> GroupDesign:
        omega = float(np.exp(x[0]))
        k_s = float(np.exp(x[1])) if self.integral else omega if self.controller == "asmc" else 0.0
        return GroupDesign(
            omega=omega, walk=float(np.exp(x[-1])) if self.kalman else np.nan, k_s=k_s
        )

    def cost(self, x: np.ndarray) -> tuple[float, float]:
        """Mean square error (rad^2 or m^2) and effort of the noise (ISV); infinite outside the
        stable region.
        """
        key = x.tobytes()
        if key not in self._costs:
            self._costs[key] = self._cost(x)
        return self._costs[key]

    def _cost(self, x: np.ndarray) -> tuple[float, float]:
        group, gain = self.read(x), None
        if self.kalman:
            position, velocity = self.assumed
            gain = kalman_gain(
                position_noise=position,
                velocity_noise=velocity,
                walk=group.walk,
                sample_time=self.period,
            )[None]
        sampling = Sampling(sample_time=self.period, kalman_gain=gain)
        omega, k_s = group.omega, group.k_s
        if self.controller == "asmc":
            gains = LoopGains(k_v=2.0 * omega, k_p=omega**2, k_i=0.0)
        else:
            gains = LoopGains(
                k_v=2.0 * omega + k_s, k_p=omega**2 + 2.0 * k_s * omega, k_i=k_s * omega**2
            )
        if np.abs(axis_poles(gains, eta=self.etas, sampling=sampling)).max() > LARGEST_RADIUS:
            return np.inf, np.inf
        loop = axis_loop(gains, sampling=sampling)
        covariance = loop.covariance(position_noise=self.noise[0], velocity_noise=self.noise[1])
        force = loop.force @ covariance @ loop.force
        # The error's response to the demand of one sample, its length doubled until it covers the
        # run.
        count = self.late.size
        columns, power = loop.f[:, None], loop.a
        while columns.shape[1] < count:
            columns, power = np.hstack([columns, power @ columns]), power @ power
        response = np.fft.rfft(columns[0, :count], 2 * count)
        error = np.fft.irfft(response * self.spectrum)[:, :count]
        return float((error[:, self.late] ** 2).mean() + covariance[0, 0]), float(
            self.duration * force * self.weight
        )

    def minimize(self, price: float, start: np.ndarray) -> np.ndarray:
        """The design (logarithms) that is best for a price of effort."""
        key = price, start.tobytes()
        if key not in self._designs:
            self._designs[key] = self._minimize(price, start)
        return self._designs[key]

    def _minimize(self, price: float, start: np.ndarray) -> np.ndarray:

        def objective(x: np.ndarray) -> float:
            square, effort = self.cost(x)
            return 0.5 * np.log(square) + price * effort if np.isfinite(square) else 1e3

        simplex = np.vstack([start, *(start + step for step in 0.5 * np.eye(start.size))])
        found: np.ndarray = fmin(
            objective,
            start,
            xtol=0.02,
            ftol=1e-4,
            maxiter=80 * start.size,
            initial_simplex=simplex,
            disp=False,
        )
        return found


def _eta_range(scenario: Scenario, masses: list[float]) -> np.ndarray:
    """Five inertia ratios over what the payload range and the planned motion hold, and a little
    more on both sides.

    The axes are coupled, and the motion moves the poles.
    """
    pairs = [
        pair
        for mass in masses
        for pair in _mass_matrices(with_true_mass(scenario, mass), [0.0, 0.5, 1.0])
    ]
    spread = np.array([inertia_ratios(true, nominal) for true, nominal in pairs])
    return np.linspace(spread.min() / _WIDER, spread.max() * _WIDER, 5)


def _mass_matrices(scenario: Scenario, parts: list[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """(H, Hhat) at fractions of the planned motion."""
    nominal, true = (
        driven_model(make_nominal_plant(scenario)),
        driven_model(make_flexible_plant(scenario)),
    )
    pick = np.ix_(nominal.coordinates.driven, nominal.coordinates.driven)
    motion = make_motion(scenario, nominal.coordinates)
    configurations = [motion.evaluate(motion.part(share))[0] for share in parts]
    return [
        (true.calc_apparent_mass_matrix(q)[pick], nominal.calc_mass_matrix(q)[pick])
        for q in configurations
    ]


def with_true_mass(scenario: Scenario, mass: float) -> Scenario:
    """The scenario with another true payload mass (kg), the inertia in proportion."""
    data = scenario_to_dict(scenario)
    truth = data["payload"]["truth"]
    truth["inertia"] = [value * mass / truth["mass"] for value in truth["inertia"]]
    truth["mass"] = mass
    return scenario_from_dict(data)
