"""Designs of laws by axis, group by group on the one-axis loop (``one_axis``)."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import fmin

from ffsm_drake.common.memo import memoized
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.gains.requirement import DesignPoint, Requirement
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.design.stability.linear_settings import smooth_sensing
from ffsm_drake.plugins.design.stability.one_axis import axis_loop, of_axes
from ffsm_drake.plugins.design.stability.planned_dynamics import Demand, PlannedDynamics
from ffsm_drake.plugins.design.stability.separate_axes import law_of_axes
from ffsm_drake.plugins.estimators.filter_gains import kalman_gain
from ffsm_drake.plugins.estimators.kalman import KalmanEstimator
from ffsm_drake.scenario import (
    Estimator,
    Scenario,
    scenario_from_dict,
    scenario_to_dict,
)
from ffsm_drake.systems.controllers import make_law
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl

# Prices of effort along the front, per unit of ISV.
PRICES = (0.2, 0.08, 0.04, 0.022, 0.012, 0.006)
# The largest spectral radius of a one-axis loop for every payload.
LARGEST_RADIUS = 0.9995
# s; times the velocity noise: assumed noise of exact positions; without it a filter would only
# differentiate them.
_POSITION_NOISE_TIME = 0.1
_KEPT = 10_000  # remembered costs and designs of a group
# Price of log(force) beyond what the actuators leave.
_BEYOND = 5.0
# Factor by which the range of inertia ratios is widened.
_WIDER = 1.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class FrontPoint:
    """One point of the front of accuracy against effort."""

    isv: float
    rms_error: Mapping[str, float]  # by group, rad or m


class AxisSearch:
    """The designs of a law with one kind of estimate, group by group on the one-axis loop."""

    def __init__(
        self,
        scenario: Scenario,
        law: TimeDelayControl,
        demand: Demand,
        kind: str,
        etas: np.ndarray,
        *,
        room: np.ndarray,
        on_price: Callable[[], None],
    ) -> None:
        self._scenario, self._demand, self._kind = scenario, demand, kind
        planned = PlannedDynamics(Mission(scenario))
        coordinates = demand.coordinates
        # The cost of a unit of Hhat^-1 tau: columns of Hhat at mid-motion.
        nominal = planned.mass_matrices(planned.motion.part(0.5))[1]
        weight = (nominal[coordinates.driven] ** 2).sum(axis=0)
        self._axes = {
            group: _Axis(
                scenario,
                law,
                demand,
                group,
                kind,
                etas,
                float(weight[part].sum()),
                nominal[part, part],
                room[part],
            )
            for group, part in coordinates.groups.items()
            if part.stop > part.start
        }
        self._designs, point = [], {group: axis.start() for group, axis in self._axes.items()}
        for price in PRICES:
            point = self._minimize(price, point)
            self._designs.append(point)
            on_price()
        self._chosen = self._designs[0]

    @property
    def front(self) -> tuple[FrontPoint, ...]:
        """Prediction of the one-axis loops at each price."""
        points = []
        for point in self._designs:
            costs = {group: axis.cost(point[group]) for group, axis in self._axes.items()}
            errors = {group: float(np.sqrt(square)) for group, (square, _) in costs.items()}
            points.append(FrontPoint(isv=self._isv(point), rms_error=errors))
        return tuple(points)

    def at_budget(
        self, requirement: Requirement, evaluate: Callable[[Scenario], DesignPoint]
    ) -> DesignPoint:
        """The point at the budget, by bisection on the price; the cheapest where none is within
        it.
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
        """The groups whose chosen design is next to the limit of stability."""
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
        data: dict[str, Any] = scenario_to_dict(self._scenario)
        estimator, axes = data["estimator"], self._axes.items()
        estimator["kind"] = self._kind
        if self._kind == "kalman":
            estimator["walk"] = {group: rounded(np.exp(point[group][-1])) for group, _ in axes}
            if any(axis.assumed != axis.noise for _, axis in axes):
                for k, name in enumerate(("position_noise", "velocity_noise")):
                    estimator[name] = {group: axis.assumed[k] for group, axis in axes}
        designed = {group: axis.gains(point[group]) for group, axis in axes}
        gains = data["controllers"].setdefault(self._scenario.controller_key, {})
        for name in next(iter(designed.values())):
            gains[name] = {group: rounded(each[name]) for group, each in designed.items()}
        return scenario_from_dict(data)


def one_sample_law(scenario: Scenario) -> TimeDelayControl | None:
    """The scenario's law with the one-sample estimate; None for one that is not designed by
    axis.
    """
    one_sample = dataclasses.replace(scenario, estimator=Estimator())
    mission = Mission(one_sample)
    law = law_of_axes(make_law(mission, mission.craft.nominal()))
    return law if law is not None and law.dynamics.gains_for(1.0, 1.0) else None


class _Axis:
    """One group's one-axis loop as a function of the logarithms of its design: [omega, K_s if any,
    walk if any].
    """

    def __init__(
        self,
        scenario: Scenario,
        law: TimeDelayControl,
        demand: Demand,
        group: str,
        kind: str,
        etas: np.ndarray,
        weight: float,
        mass: np.ndarray,
        room: np.ndarray,
    ) -> None:
        part, sensing = (
            demand.coordinates.groups[group],
            smooth_sensing(scenario, demand.coordinates),
        )
        self.kalman, self.period = kind == "kalman", scenario.sample_time
        self.law, self.weight = of_axes(law, [part.start]), weight
        self.etas = np.append(etas, 1.0)[:, None]
        self.duration = demand.times.size * self.period
        # Spectrum of the run's demand, padded, for a convolution.
        self.spectrum = np.fft.rfft(demand.lumped[:, part].T, 2 * demand.times.size)
        # at the end of each sample
        self.late = demand.times + self.period > min(5.0, 0.25 * self.duration)
        # The largest effort of the noise for which the actuators have room.
        self.most = self.duration * weight * float((room**2 / (mass**2).sum(axis=1)).min())
        # The largest noise within the group.
        position, velocity = self.noise = tuple(
            float(demand.coordinates.vector(noise, key="sensing", default=0.0)[part].max())
            for noise in (sensing.position_noise, sensing.velocity_noise)
        )
        self.assumed = position or _POSITION_NOISE_TIME * velocity, velocity
        # The search returns to a design; with another estimator it starts from the same gains.
        self.cost = memoized(maxsize=_KEPT)(self._cost)
        self.minimize = memoized(maxsize=_KEPT)(self._minimize)

    def start(self) -> np.ndarray:
        """Logarithms of a first guess: a slow loop that is stable for any sensors."""
        chooses = self.law.dynamics.chooses_k_s
        return np.log([3.0, *([0.5] if chooses else []), *([1e-3] if self.kalman else [])])

    def gains(self, x: np.ndarray) -> dict[str, float]:
        """The law's gains of a design."""
        omega, second = np.exp(x[[0, min(1, x.size - 1)]]).tolist()
        return self.law.dynamics.gains_for(omega, second)

    def _with(self, x: np.ndarray) -> TimeDelayControl:
        gains: dict[str, Any] = {name: np.array([value]) for name, value in self.gains(x).items()}
        dynamics: Any = self.law.dynamics
        law = dataclasses.replace(self.law, dynamics=dataclasses.replace(dynamics, **gains))
        if not self.kalman:
            return law
        position, velocity = self.assumed
        gain = kalman_gain(
            position_noise=position,
            velocity_noise=velocity,
            walk=float(np.exp(x[-1])),
            sample_time=self.period,
        )
        estimator = KalmanEstimator(sample_time=self.period, gain=gain[None])
        return dataclasses.replace(law, estimator=estimator)

    def _cost(self, x: np.ndarray) -> tuple[float, float]:
        """Mean square error (rad^2 or m^2) and effort of the noise (ISV); infinite outside the
        stable region.
        """
        loops = axis_loop(self._with(x), eta=self.etas)
        if np.abs(np.linalg.eigvals(loops.a[:-1])).max() > LARGEST_RADIUS:
            return np.inf, np.inf
        loop = loops[-1, 0]
        covariance = loop.covariance(position_noise=self.noise[0], velocity_noise=self.noise[1])
        force = loop.part("force")
        # Response of the error to the demand of one sample, doubled in length up to the run's.
        count = self.late.size
        columns, power = loop.f[:, None], loop.a
        while columns.shape[1] < count:
            columns, power = np.hstack([columns, power @ columns]), power @ power
        response = np.fft.rfft(columns[0, :count], 2 * count)
        error = np.fft.irfft(response * self.spectrum)[:, :count]
        return float((error[:, self.late] ** 2).mean() + covariance[0, 0]), float(
            self.duration * covariance[force, force] * self.weight
        )

    def _minimize(self, price: float, start: np.ndarray) -> np.ndarray:
        """The design (logarithms) that is best for a price of effort."""

        def objective(x: np.ndarray) -> float:
            square, effort = self.cost(x)
            if not np.isfinite(square):
                return 1e3
            beyond = 0.5 * np.log(max(1.0, effort / self.most))
            return 0.5 * np.log(square) + price * effort + _BEYOND * beyond

        simplex = np.vstack([start, *(start + step for step in 0.5 * np.eye(start.size))])
        return fmin(
            objective,
            start,
            xtol=0.02,
            ftol=1e-4,
            maxiter=80 * start.size,
            initial_simplex=simplex,
            disp=False,
        )


def eta_range(scenario: Scenario, masses: list[float]) -> np.ndarray:
    """Five inertia ratios over the range of payloads and postures, widened a little: the axes are
    coupled, and the motion moves the poles.
    """
    spread = list[np.ndarray]()
    for mass in masses:
        planned = PlannedDynamics(Mission(with_true_mass(scenario, mass)))
        spread += [planned.ratios(planned.motion.part(share)) for share in (0.0, 0.5, 1.0)]
    return np.linspace(np.min(spread) / _WIDER, np.max(spread) * _WIDER, 5)


def with_true_mass(scenario: Scenario, mass: float) -> Scenario:
    """The scenario with another true payload mass (kg), the inertia in proportion."""
    data = scenario_to_dict(scenario)
    truth = data["payload"]["truth"]
    truth["inertia"] = [value * mass / truth["mass"] for value in truth["inertia"]]
    truth["mass"] = mass
    return scenario_from_dict(data)
