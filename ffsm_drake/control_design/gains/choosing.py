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
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.common.guard import guarded
from ffsm_drake.control_design.gains.axis_search import (
    LARGEST_RADIUS,
    AxisSearch,
    FrontPoint,
    eta_range,
    one_sample_law,
    with_true_mass,
)
from ffsm_drake.control_design.gains.requirement import (
    TOLERANCE,
    Baseline,
    DesignPoint,
    Requirement,
)
from ffsm_drake.control_design.gains.variation import vary
from ffsm_drake.control_design.limit import Limit, find_limit
from ffsm_drake.control_design.stability.adaptation import axis_law, expected_gains
from ffsm_drake.control_design.stability.boundaries import Boundaries, find_boundaries
from ffsm_drake.control_design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.control_design.stability.planned_dynamics import make_demand
from ffsm_drake.control_design.stability.prediction import Prediction, predict, predict_noise
from ffsm_drake.control_design.stability.rehearsal import rehearse
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.scenario import Estimator, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers import complete_gains
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl

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
    ended_by: str = ""  # what ended the search before its end

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
                "requirements and are nowhere worse."
            ]
        elif violated:
            remarks = [f"The given gains do not meet the requirements: {violated}."]
            if factor < 1.0:
                remarks.append(f"Apart from that they are {1.0 / factor:.3g} times as accurate.")
        else:
            remarks = [
                f"The rms error falls by a factor of {factor:.3g} (geometric mean over the groups)."
            ]
        if self.ended_by:
            remarks.append(f"The search was ended by {self.ended_by}: this is the best so far.")
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


@guarded
def design(
    scenario: Scenario,
    *,
    budget: float | None = None,
    payload_range: tuple[float, float] | None = None,
    trade: Collection[str] = (),
    time_limit: float | None = None,
    progress: Callable[[int, str], None] | None = None,
) -> Design:
    """Design the gains of the scenario's controller and, for a law with one, its estimator.

    Args:
      budget: largest predicted ISV; default: what the given gains take, with ``trade`` of
        effort at least 1.1 times that of perfect tracking; the latter, or 1.1 times that of the
        cheapest gains found, where the given ones are unstable.
      payload_range: lowest and highest true payload mass (kg, inertia in proportion) that the loop
        must be stable for; default: 0.6 to 2.5 times the nominal one.
      trade: what may get worse than with the given gains by more than 2 %, of ``TRADES``: any
        group's rms error, the effort, the margins.
      time_limit: s; the best so far counts when it is over, as on Ctrl-C; None: none.
      progress: called with the number of candidates tried, and what they are.

    Raises:
      ScenarioError: no gains meet the budget, or a value of the scenario cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or linearised; the controller
        tracks a frame.
    """
    search = _Search(complete_gains(scenario), budget, payload_range, tuple(trade), progress)
    search.until = math.inf if time_limit is None else time.monotonic() + time_limit
    try:
        search.go()
    except _TimeUp:
        search.ended_by = "the time limit"
    except KeyboardInterrupt:
        search.ended_by = "an interrupt"
    return search.result()


class _TimeUp(Exception):
    """The search has had its time."""


class _Search:
    """The search for one scenario, and all that it has tried so far."""

    def __init__(
        self,
        scenario: Scenario,
        budget: float | None,
        payload_range: tuple[float, float] | None,
        trade: Sequence[str],
        progress: Callable[[int, str], None] | None,
    ) -> None:
        self._asked, self._progress = budget, progress
        self._demand, self._masses = make_demand(scenario), _masses(scenario, payload_range)
        limit = self._demand.coordinates.vector(
            scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
        )
        self.until, self.ended_by = math.inf, ""
        self._confirmed = dict[int, str]()  # by id of a point: the margin it loses
        self._tried, self._searches = list[tuple[str, DesignPoint]](), dict[str, AxisSearch]()
        ideal = 1.1 * self._demand.ideal_isv
        self.requirement = Requirement(budget=ideal if budget is None else budget, limit=limit)
        self.given = self._judge(scenario, whole=True)
        prediction, rehearsal = self.given.prediction, self.given.rehearsal
        diverges = rehearsal is not None and rehearsal.share_diverged > 0.0
        if diverges or not (np.isfinite(prediction.isv) and prediction.spectral_radius < 1.0):
            return
        # unless asked, as much effort as it was may be spent, and no more
        isv = TOLERANCE * self.given.prediction.isv
        if budget is None:
            self._loosen(max(ideal, isv) if "effort" in trade else isv)
        boundaries, time_of_edge = _boundaries(self.given.scenario)
        if math.isnan(boundaries.gains):  # without margins there are none to lose
            trade = [*trade, "margins"]
        baseline = Baseline(point=self.given, boundaries=boundaries, time=time_of_edge, trade=trade)
        self.requirement = dataclasses.replace(self.requirement, baseline=baseline)

    def _loosen(self, budget: float) -> None:
        self.requirement = dataclasses.replace(self.requirement, budget=budget)

    def go(self) -> None:
        """Try candidates. Raises _TimeUp."""
        law = one_sample_law(self.given.scenario)
        if law is not None:
            self._by_axis(law)
        best = self.best()
        if not self.given.is_by_axis or best is self.given:
            self._vary(best)

    def _by_axis(self, law: TimeDelayControl) -> None:
        scenario = self.given.scenario
        etas = eta_range(scenario, self._masses)
        for kind in ("kalman", "one_sample"):
            search = AxisSearch(scenario, law, self._demand, kind, etas, on_price=self._check_time)
            self._searches[kind] = search
            search.at_budget(self.requirement, functools.partial(self._evaluate, kind))
            if kind == "kalman":
                with contextlib.suppress(ScenarioError):  # for late or slow sensors
                    search.at_budget(
                        self.requirement,
                        lambda made: self._evaluate("coupled", _with_coupled_estimator(made)),
                    )

    def _vary(self, start: DesignPoint) -> None:
        vary(
            start,
            functools.partial(self._evaluate, "varied"),
            baseline=self.requirement.baseline,
            on_price=self._check_time,
        )

    def best(self) -> DesignPoint:
        """The best so far: the given gains unless others are better by more than a trifle."""
        rank = self.requirement.rank
        for point in sorted((point for _, point in self._tried), key=rank):
            if self.requirement.worse(point):
                continue
            least, error = rank(point)
            if rank(self.given) <= (least, error + _NEGLIGIBLE):
                return self.given
            if least > 0 or not self._loses_a_margin(point):
                return point
        return self.given

    def _loses_a_margin(self, point: DesignPoint) -> str:
        """The first margin, at the posture of its own, that is worse than it was, one line."""
        baseline = self.requirement.baseline
        if baseline is None or "margins" in baseline.trade:
            return ""
        if id(point) not in self._confirmed:
            self._confirmed[id(point)] = baseline.worse_margin(_boundaries(point.scenario)[0])
        return self._confirmed[id(point)]

    def _check_time(self) -> None:
        if time.monotonic() > self.until:
            raise _TimeUp
        if self._progress is not None:
            better = sum(not self.requirement.violated(point) for _, point in self._tried)
            self._progress(len(self._tried), f"candidates, {better} of them meet all")

    def _evaluate(self, kind: str, candidate: Scenario) -> DesignPoint:
        self._check_time()
        point = self._judge(candidate)
        self._tried.append((kind, point))
        return point

    def _judge(self, candidate: Scenario, *, whole: bool = False) -> DesignPoint:
        """A candidate's prediction. What rejects it soonest comes first, its run last; ``whole``:
        it is run in any case.
        """
        period, force, requirement = candidate.sample_time, self._demand.force, self.requirement
        with Linearizer(candidate) as linearizer:
            if linearizer.loop.tracks_frame:
                raise BlockError(
                    f"{candidate.controller} tracks a frame; gains are designed for "
                    "errors of coordinates"
                )
            radii = _radius_by_mass(linearizer, (self._masses[0], self._masses[-1]))
            stable = max(radii.values()) < 1.0
            held = expected_gains(linearizer) if stable or whole else {}
            noise = (
                predict_noise(linearizer, held)
                if stable or whole
                else _diverged(linearizer.loop.coordinates)
            )
            point = DesignPoint(
                scenario=candidate,
                prediction=noise.with_mean(np.zeros_like(force), force, period=period),
                radius_by_mass=radii,
                is_by_axis=axis_law(linearizer) is not None,
                is_run=False,
            )
            if is_rehearsed(candidate) and (whole or not self._is_rejected(point)):
                rehearsal = rehearse(candidate, seeds=_SEEDS)
                noise = dataclasses.replace(noise, noise_error=rehearsal.rms_error)
                point = dataclasses.replace(point, rehearsal=rehearsal)
            if self._is_rejected(point) and not whole:
                return point
            prediction = noise.with_mean(*linearizer.follow(held=held), period=period)
            point = dataclasses.replace(point, prediction=prediction, is_run=True)
        baseline = requirement.baseline
        if baseline is None or whole or requirement.violated(point):
            return point
        return dataclasses.replace(point, lost_margin=baseline.margin_lost_by(candidate))

    def _is_rejected(self, point: DesignPoint) -> bool:
        """Whether a point fails before it is run, by what noise and the motion alone ask."""
        requirement = self.requirement
        baseline = requirement.baseline
        if requirement.failed(point):
            return True
        return baseline is not None and bool(
            baseline.worse_error(point)
            or point.prediction.isv > max(requirement.budget, baseline.point.prediction.isv)
        )

    def result(self) -> Design:
        """The choice among what was tried. Raises ScenarioError: nothing meets the budget."""
        chosen = self.best()
        if self.requirement.violated(chosen).startswith("ISV"):
            if self._asked is not None:
                raise self._too_little(chosen)
            # in a slow motion most of the effort is due to noise
            self._loosen(1.1 * chosen.prediction.isv)
            chosen = self.best()
        with Linearizer(chosen.scenario) as linearizer:
            radius_by_mass = _radius_by_mass(linearizer, self._masses)
        kinds = dict.fromkeys(kind for kind, _ in self._tried)
        found = {
            kind: min((p for k, p in self._tried if k == kind), key=self.requirement.rank)
            for kind in kinds
        }
        kind = next((kind for kind, point in self._tried if point is chosen), "")
        search = self._searches.get(kind)
        shown = search or self._searches.get("kalman")
        return Design(
            chosen=dataclasses.replace(chosen, radius_by_mass=radius_by_mass),
            given=self.given,
            found=found,
            kept=chosen is self.given,
            active_constraint=_active_constraint(chosen, self.requirement, search),
            front=() if shown is None else shown.front,
            limit=find_limit(chosen.scenario, self._demand),
            ideal_isv=self._demand.ideal_isv,
            requirement=self.requirement,
            ended_by=self.ended_by,
        )

    def _too_little(self, chosen: DesignPoint) -> ScenarioError:
        budget = self.requirement.budget
        known = dataclasses.replace(self.requirement, baseline=None)
        within = [point for _, point in self._tried if not known.violated(point)]
        reason = (
            "within it they lose accuracy or margins: see --trade"
            if within
            else f"the cheapest gains found need {chosen.prediction.isv:.1f}"
        )
        return ScenarioError("budget", f"ISV {budget:.1f} cannot be met; {reason}")


def _boundaries(scenario: Scenario) -> tuple[Boundaries, float]:
    """The margins at the posture with the largest spectral radius, and its time, s."""
    with Linearizer(scenario) as linearizer:
        shares = {share: linearizer.at(linearizer.part(share)) for share in POSTURES}
        share = max(shares, key=lambda each: shares[each].spectral_radius)
        edge = linearizer.part(share)
    return find_boundaries(scenario, time=edge), edge


def _diverged(coordinates: Coordinates) -> Prediction:
    values = np.full(len(coordinates.names), np.inf)
    return Prediction(
        coordinates=coordinates,
        spectral_radius=math.inf,
        rms_error=values,
        noise_error=values,
        noise_force=values,
        isv_by_coordinate=values,
        peak_effort=values,
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
