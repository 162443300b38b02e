"""Choosing gains for a scenario's sensors, period, delays, limits and payload range, never worse than those given.

Candidates are judged alike, by ``predict`` on the closed loop as it is wired: the least error, as the mean of the
groups' log(rms error), that keeps to the budget of effort and to the actuators' limits, and that is stable for every
payload of the range. Where they come from depends on the law:

- *The paper's laws.* Every group has its natural frequency w (K_P = w^2, K_D = 2 w; ASMC: K_D = K_s = w), its K_s
  where the surface has an integral, and the random walk q_N of its Kalman estimate. The groups share only the effort,
  so each is designed alone on its one-axis loop for a price of effort, with either estimate. Lowering the price traces
  the front of accuracy against effort.
- *Every other law, and every loop that the one-axis formulas do not describe* (delays, replaced blocks). The gains
  that the law declares, and the random walks, are varied by group from the best there is, all groups at once, as long
  as that pays at a price of effort.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from scipy.optimize import fmin

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.control_design.limit import Limit, find_limit
from ffsm_drake.control_design.stability.linearization import Linearizer, smooth_sensing
from ffsm_drake.control_design.stability.margins import has_closed_form
from ffsm_drake.control_design.stability.prediction import Demand, Prediction, make_demand, predict
from ffsm_drake.control_design.stability.sampled_loop import LoopGains, Sampling, axis_loop, axis_poles, inertia_ratios
from ffsm_drake.scenario import Estimator, Scenario, controller_key, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.systems.controllers import PAPER_LAWS, complete_gains, declared_gains
from ffsm_drake.systems.controllers.estimators import kalman_gain
from ffsm_drake.systems.reference import make_motion

# Prices of effort that the front is computed for, per unit of ISV.
PRICES = (0.2, 0.08, 0.04, 0.022, 0.012, 0.006)
# The one-axis loop must contract at least this much for every payload.
LARGEST_RADIUS = 0.9995
# s; times the velocity noise, what a filter assumes of positions that are exact: it would else only differentiate them.
_POSITION_NOISE_TIME = 0.1
# By how much the range of inertia ratios is widened for it.
_WIDER = 1.05
# Prices and factors that other laws' gains are varied with.
_VARIED_PRICES = (0.08, 0.022, 0.006)
_FACTORS = (2.0, 1.4)
# Of log(rms error): less is no reason to change gains.
_NEGLIGIBLE = 0.005


_KINDS = {
    "kalman": "Kalman estimate",
    "coupled": "Coupled Kalman estimate",
    "one_sample": "One-sample estimate",
    "varied": "Gains varied by group",
}


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class DesignPoint:
    """A scenario and what is predicted of it."""

    scenario: Scenario
    prediction: Prediction
    radius_by_mass: Mapping[float, float]  # true payload mass in kg -> spectral radius


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """What a design must keep to."""

    budget: float  # largest ISV
    limit: np.ndarray  # (nv,) of the actuators, N m or N; infinite: none

    def violated(self, point: DesignPoint) -> str:
        """One line: which requirement a point does not meet; empty where it meets all."""
        prediction = point.prediction
        if not np.isfinite(prediction.isv):
            return "it diverges"
        unstable = [mass for mass, radius in point.radius_by_mass.items() if radius >= 1.0]
        if unstable:
            return f"unstable for a true payload of {' or '.join(f'{mass:g}' for mass in unstable)} kg"
        if (excess := prediction.peak_effort > self.limit).any():
            i = int(np.argmax(excess))
            peak, limit = prediction.peak_effort[i], self.limit[i]
            return f"it asks {prediction.coordinates.names[i]} for {peak:.3g}, whose actuation.limit is {limit:g}"
        if prediction.isv > self.budget:
            return f"ISV {prediction.isv:.1f} is over the budget of {self.budget:.1f}"
        return ""

    def rank(self, point: DesignPoint) -> tuple[int, float]:
        """By which points are judged, the smaller the better: requirements first, then error, or effort over budget."""
        prediction, violated = point.prediction, self.violated(point)
        if not violated:
            return 0, prediction.mean_log_error
        severe = not violated.startswith("ISV")
        return (2, float(max(point.radius_by_mass.values()))) if severe else (1, prediction.isv)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """The chosen gains and what they were chosen from."""

    chosen: DesignPoint
    given: DesignPoint  # the scenario as it was
    found: Mapping[str, DesignPoint]  # the best of each kind: of estimate, or "varied" gains
    kept: bool  # whether the given gains are the chosen ones
    held_back: str  # what keeps the chosen gains from being better, one line
    front: tuple[FrontPoint, ...]  # with the chosen estimate; empty where none was traced
    limit: Limit  # of the chosen gains
    ideal_isv: float
    requirement: Requirement

    @functools.cached_property
    def published(self) -> Prediction | None:
        """With the paper's gains and one-sample estimate, and the same sensors; None for another law."""
        scenario = self.given.scenario
        return predict(_published(scenario)) if scenario.controller in PAPER_LAWS else None

    @property
    def remarks(self) -> list[str]:
        """What was compared and what limits the choice, a sentence each."""
        after, before = self.chosen.prediction, self.given.prediction
        factor = float(np.exp(before.mean_log_error - after.mean_log_error))
        violated = self.requirement.violated(self.given)
        if self.kept:
            remarks = ["Yours is better: kept. Nothing was found that is more accurate and meets the requirements."]
        elif violated:
            remarks = [f"Yours does not meet the requirements: {violated}."]
            if factor < 1.0:
                remarks.append(f"Where that does not matter, yours is {1.0 / factor:.3g} times as accurate.")
        else:
            remarks = [f"The rms error falls by a factor of {factor:.3g} (geometric mean over the groups)."]
        for kind, point in self.found.items():
            error = np.exp(point.prediction.mean_log_error)
            verdict = self.requirement.violated(point) or f"ISV {point.prediction.isv:.1f}"
            remarks.append(f"{_KINDS[kind]}: mean rms error {error:.3g}, {verdict}.")
        remarks.append(f"Held back by {self.held_back}.")
        if np.isfinite(self.limit.distance):
            remarks.append(
                f"The error is {self.limit.distance:.3g} times the least that any linear controller can have at this "
                "effort (LQG, same noise and demand)."
            )
        return remarks


def design(
    scenario: Scenario,
    *,
    budget: float | None = None,
    payload_range: tuple[float, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Design:
    """Design the gains of the scenario's controller and, for a law with one, its estimator.

    Args:
      budget: largest predicted ISV; default: 1.1 times that of perfect tracking.
      payload_range: lowest and highest true payload mass (kg, inertia in proportion) that the loop must be stable for;
        default: 0.6 to 2.5 times the nominal one.
      progress: called with (steps done, steps in all).

    Raises:
      ScenarioError: no gains meet the budget, or a value of the scenario cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or linearised.
    """
    scenario, demand = complete_gains(scenario), make_demand(scenario)
    nominal = scenario.payload.nominal.mass
    low, high = payload_range or (0.6 * nominal, 2.5 * nominal)
    if not 0.0 < low < high:
        raise ScenarioError("payload range", f"must be two masses 0 < LOW < HIGH in kg, not {low:g} and {high:g}")
    masses = [float(mass) for mass in np.linspace(low, high, 5)]
    requirement = Requirement(
        budget=1.1 * demand.ideal_isv if budget is None else budget,
        limit=demand.coordinates.vector(scenario.actuation.limit or {}, key="actuation.limit", default=np.inf),
    )

    def evaluate(candidate: Scenario) -> DesignPoint:
        return DesignPoint(
            scenario=candidate,
            prediction=predict(candidate),
            radius_by_mass={mass: _radius(_with_true_mass(candidate, mass)) for mass in (masses[0], masses[-1])},
        )

    given, found, searches = evaluate(scenario), dict[str, DesignPoint](), dict[str, _Search]()
    by_formula = scenario.controller in PAPER_LAWS
    varies = not has_closed_form(scenario)
    steps = 2 * len(PRICES) * by_formula + len(_VARIED_PRICES) * varies
    done = 0

    def step() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, steps)

    if by_formula:
        for kind in ("kalman", "one_sample"):
            searches[kind] = search = _Search(scenario, demand, kind, masses, on_price=step)
            found[kind] = search.at_budget(requirement, evaluate)
            if kind == "kalman":
                with contextlib.suppress(ScenarioError):  # late or slow sensors, which it does not take
                    found["coupled"] = search.at_budget(
                        requirement, lambda made: evaluate(_with_estimator(made, kind="coupled"))
                    )
    if varies:
        best = min([given, *found.values()], key=requirement.rank)
        tried = list(_varied(best, evaluate, on_price=step))
        found["varied"] = min(tried, key=requirement.rank)
    best = min(found.values(), key=requirement.rank)
    kept = requirement.rank(given) <= (requirement.rank(best)[0], requirement.rank(best)[1] + _NEGLIGIBLE)
    chosen = given if kept else best
    if requirement.violated(chosen).startswith("ISV"):
        cheapest = f"the cheapest gains found need {chosen.prediction.isv:.1f}"
        raise ScenarioError("budget", f"ISV {requirement.budget:.1f} cannot be met; {cheapest}")
    radius_by_mass = {mass: _radius(_with_true_mass(chosen.scenario, mass)) for mass in masses}
    search_of_chosen = next(
        (searches[kind] for kind, point in found.items() if point is chosen and kind in searches), None
    )
    shown = search_of_chosen or searches.get("kalman")
    return Design(
        chosen=dataclasses.replace(chosen, radius_by_mass=radius_by_mass),
        given=given,
        found=found,
        kept=kept,
        held_back=_held_back(chosen, requirement, search_of_chosen),
        front=() if shown is None else shown.front,
        limit=find_limit(chosen.scenario, demand),
        ideal_isv=demand.ideal_isv,
        requirement=requirement,
    )


def _with_estimator(scenario: Scenario, **settings: Any) -> Scenario:
    return dataclasses.replace(scenario, estimator=dataclasses.replace(scenario.estimator, **settings))


def _radius(scenario: Scenario) -> float:
    with Linearizer(scenario) as linearizer:
        return max(linearizer.at(part * scenario.reference.duration).spectral_radius for part in (0.0, 1.0))


def _held_back(point: DesignPoint, requirement: Requirement, search: "_Search | None") -> str:
    """What a better design would run into."""
    peak, limit = point.prediction.peak_effort, requirement.limit
    if point.prediction.isv > 0.98 * requirement.budget:
        return f"the budget of effort, ISV {requirement.budget:.1f}"
    if (peak > 0.95 * limit).any():
        i = int(np.argmax(peak / limit))
        return f"actuation.limit of {point.prediction.coordinates.names[i]}, {limit[i]:g}"
    if max(point.radius_by_mass.values()) > LARGEST_RADIUS:
        worst = max(point.radius_by_mass, key=lambda mass: point.radius_by_mass[mass])
        return f"stability for a true payload of {worst:g} kg"
    if search is not None and (groups := search.at_the_edge()):
        return f"stability over the payload range, in {', '.join(groups)}"
    return "nothing that was looked at: what more effort buys is below its lowest price"


class _Search:
    """The designs of one of the paper's laws with one kind of estimate, group by group on the one-axis loop."""

    def __init__(
        self, scenario: Scenario, demand: Demand, kind: str, masses: list[float], *, on_price: Callable[[], None]
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

    def at_budget(self, requirement: Requirement, evaluate: Callable[[Scenario], DesignPoint]) -> DesignPoint:
        """The point that spends the budget, by bisection on the price; the cheapest where none is within it."""
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
            if any(not np.isfinite(axis.cost(x + step[: x.size])[0]) for x in [self._chosen[group]] for step in steps)
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
        return self._demand.ideal_isv + sum(axis.cost(point[group])[1] for group, axis in self._axes.items())

    def _with_gains(self, point: Mapping[str, np.ndarray]) -> Scenario:
        """The scenario with designed gains, three digits each."""
        scenario, groups = self._scenario, {group: self._axes[group].read(x) for group, x in point.items()}

        def each(value: Callable[[GroupDesign], float]) -> dict[str, float]:
            return {name: float(f"{value(group):.3g}") for name, group in groups.items()}

        data: dict[str, Any] = scenario_to_dict(scenario)
        data["estimator"]["kind"] = self._kind
        if self._kind == "kalman":
            data["estimator"]["walk"] = each(lambda group: group.walk)
            if any(axis.assumed != axis.noise for axis in self._axes.values()):
                assumed = {group: axis.assumed for group, axis in self._axes.items()}
                data["estimator"]["position_noise"] = {group: position for group, (position, _) in assumed.items()}
                data["estimator"]["velocity_noise"] = {group: velocity for group, (_, velocity) in assumed.items()}
        gains = data["controllers"].setdefault(scenario.controller, {})
        if scenario.controller == "asmc":
            gains |= {"k_d": each(lambda group: group.omega), "k_s": each(lambda group: group.k_s)}
        else:
            gains |= {"k_d": each(lambda group: 2.0 * group.omega), "k_p": each(lambda group: group.omega**2)}
        if scenario.controller in ("aismc", "tde_aismc"):
            # Real noise drives |s| far past the laws' thresholds, so K_s would adapt to its bound, which is the design.
            gains |= {"k_s_initial": each(lambda group: group.k_s), "k_s_max": each(lambda group: group.k_s)}
        return scenario_from_dict(data)


class _Axis:
    """One group's one-axis loop as a function of the logarithms of its design: [omega, K_s if any, walk if any]."""

    def __init__(self, scenario: Scenario, demand: Demand, group: str, kind: str, etas: np.ndarray) -> None:
        part, sensing = demand.coordinates.groups[group], smooth_sensing(scenario)
        self.controller, self.etas, self.kalman = scenario.controller, etas, kind == "kalman"
        self.period = scenario.sample_time
        self.duration = demand.times.size * self.period
        self.demand = demand.lumped[:, part]
        self.late = demand.times + self.period > min(5.0, 0.25 * self.duration)  # at the end of each sample
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

    def start(self) -> np.ndarray:
        """Logarithms of a first guess: a slow loop that is stable for any sensors."""
        return np.log([3.0, *([0.5] if self.integral else []), *([1e-3] if self.kalman else [])])

    def read(self, x: np.ndarray) -> GroupDesign:
        omega = float(np.exp(x[0]))
        k_s = float(np.exp(x[1])) if self.integral else omega if self.controller == "asmc" else 0.0
        return GroupDesign(omega=omega, walk=float(np.exp(x[-1])) if self.kalman else np.nan, k_s=k_s)

    def cost(self, x: np.ndarray) -> tuple[float, float]:
        """Mean square error (rad^2 or m^2) and effort of the noise (ISV); infinite outside the stable region."""
        group, gain = self.read(x), None
        if self.kalman:
            position, velocity = self.assumed
            gain = kalman_gain(
                position_noise=position, velocity_noise=velocity, walk=group.walk, sample_time=self.period
            )[None]
        sampling = Sampling(sample_time=self.period, kalman_gain=gain)
        omega, k_s = group.omega, group.k_s
        if self.controller == "asmc":
            gains = LoopGains(k_v=2.0 * omega, k_p=omega**2, k_i=0.0)
        else:
            gains = LoopGains(k_v=2.0 * omega + k_s, k_p=omega**2 + 2.0 * k_s * omega, k_i=k_s * omega**2)
        if np.abs(axis_poles(gains, eta=self.etas, sampling=sampling)).max() > LARGEST_RADIUS:
            return np.inf, np.inf
        loop = axis_loop(gains, sampling=sampling)
        covariance = loop.covariance(position_noise=self.noise[0], velocity_noise=self.noise[1])
        force = loop.force @ covariance @ loop.force
        # The error's response to the demand of one sample, its length doubled until it covers the run.
        count = len(self.demand)
        columns, power = loop.f[:, None], loop.a
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


def _varied(
    start: DesignPoint, evaluate: Callable[[Scenario], DesignPoint], *, on_price: Callable[[], None]
) -> Iterator[DesignPoint]:
    """All that is tried while the declared gains are varied by group; a step is kept for the groups that it helps."""
    best = start
    yield best
    for price in _VARIED_PRICES:
        for factor in _FACTORS:
            for name in _tunable(best.scenario):
                for step in (factor, 1.0 / factor):
                    point = evaluate(_scaled(best.scenario, name, dict.fromkeys(_groups(best), step)))
                    yield point
                    before, after = _group_costs(best, price), _group_costs(point, price)
                    better = {group: step for group in before if after[group] < before[group] - 1e-3}
                    if not better:
                        continue
                    joined = point if len(better) == len(before) else evaluate(_scaled(best.scenario, name, better))
                    yield joined
                    if sum(_group_costs(joined, price).values()) < sum(before.values()):
                        best = joined
                        break
        on_price()


def _group_costs(point: DesignPoint, price: float) -> dict[str, float]:
    """log(rms error) + price * effort by group; infinite where the point is unstable for some payload."""
    prediction, groups = point.prediction, _groups(point)
    if max(point.radius_by_mass.values()) >= 1.0 or not np.isfinite(prediction.isv):
        return dict.fromkeys(groups, np.inf)
    errors = prediction.by_group()
    return {
        name: float(np.log(errors[name]) + price * prediction.isv_by_coordinate[part].sum())
        for name, part in groups.items()
    }


def _groups(point: DesignPoint) -> Mapping[str, slice]:
    return point.prediction.coordinates.groups


def _tunable(scenario: Scenario) -> list[str]:
    """What ``_scaled`` takes: feedback gains by coordinate, bounds apart, and the estimator's walk."""
    gains = declared_gains(scenario)
    names = [name for name, gain in gains.items() if gain.feedback and not gain.bound and not gain.scalar]
    walks = {"kalman": ["walk"], "coupled": ["walk", "force_walk"]}.get(scenario.estimator.kind, [])
    return [*names, *(walks if scenario.controller in PAPER_LAWS else [])]


def _scaled(scenario: Scenario, name: str, factors: Mapping[str, float]) -> Scenario:
    """The scenario with one tunable value times a factor by group, and with it the bound it must stay below."""
    coordinates = make_nominal_plant(scenario).coordinates
    data: dict[str, Any] = scenario_to_dict(scenario)
    if name in ("walk", "force_walk"):
        data["estimator"][name] = _times(data["estimator"][name], factors, coordinates)
        return scenario_from_dict(data)
    gains = data["controllers"][controller_key(scenario.controller)]
    bound = f"{name.removesuffix('_initial')}_max"
    for each in (name, bound) if gains.get(bound) is not None else (name,):
        gains[each] = _times(gains[each], factors, coordinates)
    return scenario_from_dict(data)


def _times(value: Mapping[str, float], factors: Mapping[str, float], coordinates: Coordinates) -> dict[str, float]:
    """Values by coordinate times factors by group, three digits, by group where a group's are equal."""
    vector = coordinates.vector(value, key="")
    result: dict[str, float] = {}
    for group, part in coordinates.groups.items():
        scaled = [float(f"{number * factors.get(group, 1.0):.3g}") for number in vector[part].tolist()]
        equal = len(set(scaled)) == 1
        result |= {group: scaled[0]} if equal else dict(zip(coordinates.names[part], scaled, strict=True))
    return result


def _eta_range(scenario: Scenario, masses: list[float]) -> np.ndarray:
    """Five inertia ratios over what the payload range and the planned motion hold, and a little more on both sides.

    The axes are coupled, and the motion moves the poles.
    """
    pairs = [pair for mass in masses for pair in _mass_matrices(_with_true_mass(scenario, mass), [0.0, 0.5, 1.0])]
    spread = np.array([inertia_ratios(true, nominal) for true, nominal in pairs])
    return np.linspace(spread.min() / _WIDER, spread.max() * _WIDER, 5)


def _mass_matrices(scenario: Scenario, parts: list[float]) -> list[tuple[np.ndarray, np.ndarray]]:
    """(H, Hhat) at fractions of the planned motion."""
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    motion = make_motion(scenario, nominal.coordinates)
    configurations = [motion.evaluate(part * scenario.reference.duration)[0] for part in parts]
    return [(true.calc_mass_matrix(q), nominal.calc_mass_matrix(q)) for q in configurations]


def _published(scenario: Scenario) -> Scenario:
    """The scenario with the paper's gains and estimate."""
    return dataclasses.replace(scenario, controllers={}, estimator=Estimator())


def _with_true_mass(scenario: Scenario, mass: float) -> Scenario:
    data = scenario_to_dict(scenario)
    truth = data["payload"]["truth"]
    truth["inertia"] = [value * mass / truth["mass"] for value in truth["inertia"]]
    truth["mass"] = mass
    return scenario_from_dict(data)
