"""Choice of gains for a scenario's sensors, period, delays, limits and payload range, never worse
than the given ones.

All candidates are evaluated by ``predict`` on the wired loop. The choice has the least error, as
the mean of the groups' log(rms error), within the budget of effort and the actuators' limits, and
is stable for every payload of the range. The candidates depend on the law:

- *Laws that are designed by axis* (``InjectedDynamics.gains_for``; the paper's). Every group has
  its natural frequency w (K_P = w^2, K_D = 2 w; ASMC: K_D = K_s
  = w), its K_s where the surface has an integral, and the random walk q_N of its Kalman estimate.
  The groups share only the effort, so each is designed alone on its one-axis loop for a price of
  effort, with either estimate. Lowering the price traces the front of accuracy against effort.
- *Every other law, and every loop that does not consist of axes* (delays, user-supplied blocks).
  The declared gains and the random walks are varied by group from the best known, all groups at
  once, as long as the cost falls at a price of effort.
"""

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.control_design.gains.axis_search import (
    LARGEST_RADIUS,
    PRICES,
    AxisSearch,
    FrontPoint,
    eta_range,
    one_sample_law,
    with_true_mass,
)
from ffsm_drake.control_design.gains.requirement import DesignPoint, Requirement
from ffsm_drake.control_design.gains.variation import PRICES_VARIED, varied
from ffsm_drake.control_design.limit import Limit, find_limit
from ffsm_drake.control_design.stability.adaptation import axis_law
from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.control_design.stability.planned_dynamics import Demand, make_demand
from ffsm_drake.control_design.stability.prediction import Prediction, predict, predict_from
from ffsm_drake.control_design.stability.rehearsal import rehearse
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.scenario import Estimator, Scenario
from ffsm_drake.systems.controllers import complete_gains

# Seeds of the noise under which a design must not diverge with its base actuators.
_SEEDS = 2
# Least improvement of log(rms error) for which gains are changed.
_NEGLIGIBLE = 0.005
_KINDS = {
    "kalman": "Kalman estimate",
    "coupled": "Coupled Kalman estimate",
    "one_sample": "One-sample estimate",
    "varied": "Gains varied by group",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """The chosen gains and the candidates."""

    chosen: DesignPoint
    given: DesignPoint  # the scenario as it was
    found: Mapping[str, DesignPoint]  # the best of each kind: of estimate, or "varied" gains
    kept: bool  # whether the given gains are the chosen ones
    active_constraint: str  # the constraint that limits the chosen gains, one line
    front: tuple[FrontPoint, ...]  # with the chosen estimate; empty where none was traced
    limit: Limit  # of the chosen gains
    ideal_isv: float
    requirement: Requirement

    @functools.cached_property
    def with_defaults(self) -> Prediction | None:
        """The prediction with the law's default gains and the default estimator; None where the
        defaults do not fit the spacecraft.
        """
        default = dataclasses.replace(self.given.scenario, controllers={}, estimator=Estimator())
        try:
            return predict(default)
        except ScenarioError:
            return None

    @property
    def remarks(self) -> list[str]:
        """The comparison and the active constraint, a sentence each."""
        after, before = self.chosen.prediction, self.given.prediction
        factor = float(np.exp(before.mean_log_error - after.mean_log_error))
        violated = self.requirement.violated(self.given)
        if self.kept and violated:
            remarks = [
                f"The given gains are kept, though they do not meet the requirements: {violated}. "
                "No better gains were found."
            ]
        elif self.kept:
            remarks = [
                "The given gains are kept: no more accurate ones were found that meet the "
                "requirements."
            ]
        elif violated:
            remarks = [f"The given gains do not meet the requirements: {violated}."]
            if factor < 1.0:
                remarks.append(f"Apart from that they are {1.0 / factor:.3g} times as accurate.")
        else:
            remarks = [
                f"The rms error falls by a factor of {factor:.3g} (geometric mean over the groups)."
            ]
        for kind, point in self.found.items():
            error = np.exp(point.prediction.mean_log_error)
            verdict = self.requirement.violated(point) or f"ISV {point.prediction.isv:.1f}"
            remarks.append(f"{_KINDS[kind]}: mean rms error {error:.3g}, {verdict}.")
        remarks.append(f"Active constraint: {self.active_constraint}.")
        if np.isfinite(self.limit.distance):
            remarks.append(
                f"The error is {self.limit.distance:.3g} times the least of any linear controller "
                "at this effort (LQG, same noise and demand)."
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
      budget: largest predicted ISV; default: 1.1 times that of perfect tracking, or of
        the cheapest gains found where these take more.
      payload_range: lowest and highest true payload mass (kg, inertia in proportion) that the loop
        must be stable for; default: 0.6 to 2.5 times the nominal one.
      progress: called with (steps done, steps in all).

    Raises:
      ScenarioError: no gains meet the budget, or a value of the scenario cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or linearised; the controller
        tracks a frame.
    """
    scenario, demand = complete_gains(scenario), make_demand(scenario)
    masses = _masses(scenario, payload_range)
    requirement = Requirement(
        budget=1.1 * demand.ideal_isv if budget is None else budget,
        limit=demand.coordinates.vector(
            scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
        ),
    )
    evaluate = functools.partial(_evaluate, requirement=requirement, masses=masses)
    given = evaluate(scenario)
    found, searches = _candidates(given, demand, requirement, masses, evaluate, progress)
    best = min(found.values(), key=requirement.rank)
    kept = requirement.rank(given) <= (
        requirement.rank(best)[0],
        requirement.rank(best)[1] + _NEGLIGIBLE,
    )
    chosen = given if kept else best
    if requirement.violated(chosen).startswith("ISV"):
        if budget is None:  # in a slow motion most of the effort is due to noise
            least = 1.1 * chosen.prediction.isv
            return design(scenario, budget=least, payload_range=payload_range, progress=progress)
        cheapest = f"the cheapest gains found need {chosen.prediction.isv:.1f}"
        raise ScenarioError("budget", f"ISV {requirement.budget:.1f} cannot be met; {cheapest}")
    with Linearizer(chosen.scenario) as linearizer:
        radius_by_mass = _radius_by_mass(linearizer, masses)
    search = next((searches.get(kind) for kind, point in found.items() if point is chosen), None)
    shown = search or searches.get("kalman")
    return Design(
        chosen=dataclasses.replace(chosen, radius_by_mass=radius_by_mass),
        given=given,
        found=found,
        kept=kept,
        active_constraint=_active_constraint(chosen, requirement, search),
        front=() if shown is None else shown.front,
        limit=find_limit(chosen.scenario, demand),
        ideal_isv=demand.ideal_isv,
        requirement=requirement,
    )


def _masses(scenario: Scenario, payload_range: tuple[float, float] | None) -> list[float]:
    """True payload masses over the range, kg, ascending."""
    nominal = scenario.payload.nominal.mass
    low, high = payload_range or (0.6 * nominal, 2.5 * nominal)
    if not 0.0 < low < high:
        raise ScenarioError(
            "payload range", f"must be two masses 0 < LOW < HIGH in kg, not {low:g} and {high:g}"
        )
    return [float(mass) for mass in np.linspace(low, high, 5)]


def _evaluate(
    candidate: Scenario, *, requirement: Requirement, masses: Sequence[float]
) -> DesignPoint:
    with Linearizer(candidate) as linearizer:
        if linearizer.loop.tracks_frame:
            raise BlockError(
                f"{candidate.controller} tracks a frame; gains are designed for "
                "errors of coordinates"
            )
        point = DesignPoint(
            scenario=candidate,
            prediction=predict_from(linearizer),
            radius_by_mass=_radius_by_mass(linearizer, (masses[0], masses[-1])),
            is_by_axis=axis_law(linearizer) is not None,
        )
    if not is_rehearsed(candidate) or requirement.violated(point):
        return point
    return dataclasses.replace(point, rehearsal=rehearse(candidate, seeds=_SEEDS))


def _candidates(
    given: DesignPoint,
    demand: Demand,
    requirement: Requirement,
    masses: list[float],
    evaluate: Callable[[Scenario], DesignPoint],
    progress: Callable[[int, int], None] | None,
) -> tuple[dict[str, DesignPoint], dict[str, AxisSearch]]:
    """The best of each kind of estimate, or of varied gains, and the searches by axis."""
    scenario, found, searches = given.scenario, dict[str, DesignPoint](), dict[str, AxisSearch]()
    law = one_sample_law(scenario)
    steps = 2 * len(PRICES) * (law is not None) + len(PRICES_VARIED) * (not given.is_by_axis)
    done = itertools.count(1)

    def step() -> None:
        if progress is not None:
            progress(next(done), steps)

    if law is not None:
        etas = eta_range(scenario, masses)
        for kind in ("kalman", "one_sample"):
            searches[kind] = AxisSearch(scenario, law, demand, kind, etas, on_price=step)
            found[kind] = searches[kind].at_budget(requirement, evaluate)
            if kind == "kalman":
                with contextlib.suppress(ScenarioError):  # for late or slow sensors
                    found["coupled"] = searches[kind].at_budget(
                        requirement, lambda made: evaluate(_with_coupled_estimator(made))
                    )
    if not given.is_by_axis:
        best = min([given, *found.values()], key=requirement.rank)
        tried = list(varied(best, evaluate, on_price=step))
        found["varied"] = min(tried, key=requirement.rank)
    return found, searches


def _with_coupled_estimator(scenario: Scenario) -> Scenario:
    estimator = dataclasses.replace(scenario.estimator, kind="coupled")
    return dataclasses.replace(scenario, estimator=estimator)


def _radius_by_mass(linearizer: Linearizer, masses: Sequence[float]) -> dict[float, float]:
    """The larger spectral radius at both ends of the plan, by true payload mass (kg)."""
    truths = {mass: with_true_mass(linearizer.given, mass).payload.truth for mass in masses}
    ends = [linearizer.motion.part(share) for share in (0.0, 1.0)]
    return {
        mass: max(linearizer.at(time, truth=truth).spectral_radius for time in ends)
        for mass, truth in truths.items()
    }


def _active_constraint(
    point: DesignPoint, requirement: Requirement, search: AxisSearch | None
) -> str:
    """The constraint that a better design would violate."""
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
    return "none; more effort gains less than its lowest price"
