"""Choice of gains for the sensors, period, delays, limits and payload range of a scenario.

``predict`` evaluates all candidates on the wired loop. The chosen gains have the smallest error
(the mean of log(rms error) over the groups) within the budget of effort and the actuator limits.
They are stable for every payload of the range, and never worse than the given gains. The candidates
depend on the law:

- *Laws designed by axis* (``InjectedDynamics.gains_for``, such as the laws of the paper). Every
  group has a natural frequency w (K_P = w^2, K_D = 2 w; ASMC: K_D = K_s = w), K_s if the surface
  has an integral, and the random walk q_N of its Kalman estimate. The groups share only the effort,
  so each group is designed separately on its one-axis loop for a price of effort, with both kinds
  of estimate. Lower prices give the front of accuracy against effort.
- *Every other law, and every coupled loop* (delays, user-supplied blocks). The declared gains and
  the random walks are varied by group from the best gains found, all groups at once, as long as the
  cost at a price of effort falls.
"""

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.interrupts import current, interruptible
from ffsm_drake.common.numbers import counted, number
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.gains.axis_search import (
    LARGEST_RADIUS,
    AxisSearch,
    eta_range,
    one_sample_law,
    with_true_mass,
)
from ffsm_drake.plugins.design.gains.requirement import (
    ROOM,
    TOLERANCE,
    Baseline,
    DesignPoint,
    Requirement,
)
from ffsm_drake.plugins.design.gains.result import Design
from ffsm_drake.plugins.design.gains.variation import vary
from ffsm_drake.plugins.design.limit import find_limit
from ffsm_drake.plugins.design.stability.adaptation import adapts, axis_law, expected_gains
from ffsm_drake.plugins.design.stability.boundaries import Boundaries, find_boundaries
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer
from ffsm_drake.plugins.design.stability.outputs import Outputs
from ffsm_drake.plugins.design.stability.planned_dynamics import Demand, make_demand
from ffsm_drake.plugins.design.stability.prediction import Prediction, predict_noise
from ffsm_drake.plugins.design.stability.rehearsal import rehearse
from ffsm_drake.scenario import Scenario, checked
from ffsm_drake.systems.controllers import complete_gains
from ffsm_drake.systems.controllers.time_delay import TimeDelayControl
from ffsm_drake.systems.mission_limits import actuation_limit

# Confirming a choice takes at least this many evaluations, and s beyond the expected time.
_CONFIRMING, _GRACE = 4.0, 1.0
_AFTER_INTERRUPT = 2.0  # s; an interrupted process is soon ended
_TRANSIENT = 5.0  # s, at the start, which is not counted as the motion
# Seeds of the noise under which a design must not diverge with its base actuators.
_SEEDS = 2
# Least improvement of log(rms error) for which gains are changed.
_NEGLIGIBLE = 0.005
INTERRUPT = "an interrupt"


@guarded
def design(
    scenario: Scenario,
    *,
    budget: float | None = None,
    payload_range: tuple[float, float] | None = None,
    trade: Collection[str] = (),
    time_limit: float | None = None,
    predict_mission: Callable[[Scenario], str] = lambda scenario: "",
    progress: Callable[[int, str], None] | None = None,
) -> Design:
    """Choose the gains of a scenario's controller and, if the law has one, its estimator.

    Ctrl-C ends the search like the time limit. A second Ctrl-C ends the process.

    Args:
      scenario: the scenario, with the gains to start from.
      budget: largest predicted ISV; default: the ISV with the given gains, and with a ``trade`` of
        effort at least 1.1 times the ISV of perfect tracking; with unstable given gains, the
        latter, or 1.1 times the ISV of the cheapest gains found.
      payload_range: lowest and highest true payload mass (kg, inertia in proportion) with a stable
        loop; default: 0.6 to 2.5 times the nominal one.
      trade: criteria of ``TRADES`` allowed to get worse than with the given gains by more than
        2 %: any group's rms error, the effort, the margins.
      time_limit: s of wall time to choose and confirm the best gains; the given gains are
        evaluated in any case. None: no limit. Outside of the main thread a candidate is finished
        first.
      predict_mission: scenario -> obstacle to its mission, one line, empty if it is expected to go
        as planned; called for the given gains and for those to be chosen.
      progress: called with the number of candidates tried, and a line for the user.

    Raises:
      ScenarioError: no gains meet the budget, or a value of the scenario cannot be used.
      BlockError: a user-supplied block cannot be loaded, built, wired or linearised.

    Example:
      >>> from ffsm_drake import design, load_scenario
      >>> scenario = load_scenario("flight_sensors", ["controller=tdc"])
      >>> found = design(scenario, time_limit=1.0)
      >>> found.ended_by
      'the time limit'
    """
    end = math.inf if time_limit is None else time.monotonic() + time_limit
    search = _Search(
        complete_gains(checked(scenario)),
        budget,
        payload_range,
        tuple(trade),
        predict_mission,
        progress,
    )
    search.run(end)
    return search.result()


@contextlib.contextmanager
def _until(end: float) -> Iterator[None]:
    """Raise TimeLimit in the block at an end by ``time.monotonic``, s."""
    left = end - time.monotonic()
    if left <= 0.0:
        raise TimeLimit
    with contextlib.nullcontext() if math.isinf(left) else time_limit(left):
        yield


class _Search:
    """The search for one scenario, and all that it has tried so far."""

    def __init__(
        self,
        scenario: Scenario,
        budget: float | None,
        payload_range: tuple[float, float] | None,
        trade: Sequence[str],
        predict_mission: Callable[[Scenario], str],
        progress: Callable[[int, str], None] | None,
    ) -> None:
        begin = time.monotonic()
        self._asked, self._predict_mission, self._progress = budget, predict_mission, progress
        self._demand, self._masses = (
            make_demand(Mission(scenario)),
            _masses(scenario, payload_range),
        )
        limit = self._demand.coordinates.vector(
            scenario.actuation.limit or {}, key="actuation.limit", default=np.inf
        )
        self._search_end, self.ended_by = math.inf, ""
        self._margins = dict[int, Boundaries]()  # by id of a confirmed point
        self._objections = dict[int, str]()  # likewise: the objection to it
        self._tried, self._searches = list[tuple[str, DesignPoint]](), dict[str, AxisSearch]()
        ideal = 1.1 * self._demand.ideal_isv
        self.requirement = Requirement(
            budget=ideal if budget is None else budget,
            limit=limit,
            room=_room(scenario, self._demand),
        )
        self.given = self.chosen = self._judge(scenario, whole=True)
        self._evaluation_time, self._trade = time.monotonic() - begin, trade
        # by default the effort may not exceed the given one
        if budget is None and self._is_usable:
            isv = TOLERANCE * self.given.prediction.isv
            self._loosen(max(ideal, isv) if "effort" in trade else isv)

    def _loosen(self, budget: float) -> None:
        self.requirement = dataclasses.replace(self.requirement, budget=budget)

    @property
    def _is_usable(self) -> bool:
        """Whether the given gains are stable, as predicted."""
        prediction, rehearsal = self.given.prediction, self.given.rehearsal
        diverges = rehearsal is not None and rehearsal.share_diverged > 0.0
        return not diverges and math.isfinite(prediction.isv) and prediction.spectral_radius < 1.0

    def run(self, end: float) -> None:
        """Search and choose, up to an end by ``time.monotonic``, s; an interrupt leaves time
        to confirm the choice.
        """
        # diverging runs end early
        reserve = _CONFIRMING * self._evaluation_time
        try:
            with interruptible(), _until(end):
                begin = time.monotonic()
                self._look_at_the_given()
                # so that as much can be said of the choice
                reserve = max(reserve, time.monotonic() - begin)
            self._search_end = end - reserve
            with interruptible(), _until(self._search_end):
                self._search()
        except TimeLimit:
            self.ended_by = "the time limit"
        except KeyboardInterrupt:
            self.ended_by = INTERRUPT
            end, reserve = 0.0, min(reserve, _AFTER_INTERRUPT)
        self._search_end = math.inf
        try:
            with _until(max(end, time.monotonic() + reserve + _GRACE)):
                self.chosen = self._confirmed()
        except TimeLimit:
            self.ended_by = self.ended_by or "the time limit"

    def _look_at_the_given(self) -> None:
        """Predict the given gains and their margins."""
        alarm = self._obstacle(self.given.scenario)
        self.given = self.chosen = dataclasses.replace(self.given, alarm=alarm)
        if alarm or not self._is_usable:
            return  # any scenario expected to go as planned is better
        boundaries, time_of_edge = _boundaries(self.given.scenario)
        # without margins none can be lost
        trade = [*self._trade, *(["margins"] if math.isnan(boundaries.gains) else [])]
        baseline = Baseline(point=self.given, boundaries=boundaries, time=time_of_edge, trade=trade)
        self.requirement = dataclasses.replace(self.requirement, baseline=baseline)

    def _search(self) -> None:
        """Try candidates. Raises TimeLimit."""
        law = one_sample_law(self.given.scenario)
        if law is not None:
            self._by_axis(law)
        better = self._better_ones()
        if not self.given.is_by_axis or not better:
            vary(
                better[0] if better else self.given,
                functools.partial(self._evaluate, "varied"),
                requirement=self.requirement,
                on_price=self._check_time,
            )

    def _by_axis(self, law: TimeDelayControl) -> None:
        scenario = self.given.scenario
        etas = eta_range(scenario, self._masses)
        for kind in ("kalman", "one_sample"):
            search = AxisSearch(
                scenario,
                law,
                self._demand,
                kind,
                etas,
                room=self.requirement.room,
                on_price=self._check_time,
            )
            self._searches[kind] = search
            search.at_budget(self.requirement, functools.partial(self._evaluate, kind))
            if kind == "kalman":
                with contextlib.suppress(ScenarioError):  # for late or slow sensors
                    search.at_budget(
                        self.requirement,
                        lambda made: self._evaluate("coupled", _with_coupled_estimator(made)),
                    )

    def _better_ones(self) -> list[DesignPoint]:
        """The points that are better than the given gains by more than a trifle, the best first."""
        rank, given = self.requirement.rank, self.given

        def is_better(point: DesignPoint) -> bool:
            least, error = rank(point)
            may_be = point.is_run and not self.requirement.worse(point)
            return may_be and (least, error + _NEGLIGIBLE) < rank(given)

        return sorted((point for _, point in self._tried if is_better(point)), key=rank)

    def _confirmed(self) -> DesignPoint:
        """The best point without an objection; the given gains where there is none."""
        better = self._better_ones()
        if self._asked is None and better and self.requirement.violated(better[0])[:3] == "ISV":
            # in a slow motion most of the effort is due to noise
            self._loosen(1.1 * better[0].prediction.isv)
            better = self._better_ones()
        return next((point for point in better if not self._objection(point)), self.given)

    def _objection(self, point: DesignPoint) -> str:
        """A further objection to a point, one line: a worse margin at its own critical posture, or
        the prediction for its mission.
        """
        if id(point) not in self._objections:
            worse, baseline = "", self.requirement.baseline
            if baseline is not None:
                self._margins[id(point)], _ = _boundaries(point.scenario)
                worse = baseline.worse_margin(self._margins[id(point)])
            self._objections[id(point)] = worse or self._obstacle(point.scenario)
        return self._objections[id(point)]

    def _obstacle(self, scenario: Scenario) -> str:
        """The obstacle to a mission. Raises KeyboardInterrupt, otherwise handled within its run."""
        alarm = self._predict_mission(scenario)
        if current().number and not self.ended_by:
            raise KeyboardInterrupt
        return alarm

    def _check_time(self) -> None:
        if (
            time.monotonic() > self._search_end
        ):  # the alarm of ``_until`` is raised in the main thread
            raise TimeLimit
        if self._progress is not None:
            better = sum(not self.requirement.violated(point) for _, point in self._tried)
            line = (
                f"{counted(len(self._tried), 'set')} of gains tried, {better or 'none'} acceptable"
            )
            self._progress(len(self._tried), line if self._tried else "evaluating the first gains")

    def _evaluate(self, kind: str, candidate: Scenario) -> DesignPoint:
        self._check_time()
        known = (point for _, point in self._tried if point.scenario == candidate)
        point = next(known, None) or self._judge(candidate)
        self._tried.append((kind, point))
        return point

    def _judge(self, candidate: Scenario, *, whole: bool = False) -> DesignPoint:
        """A candidate's prediction. What takes least time comes first: its radii with other
        payloads, its noise, the margins that it must keep, its actuators, and its run last.
        ``whole``: it is run in any case.
        """
        period, force, requirement = candidate.sample_time, self._demand.force, self.requirement
        with Linearizer(candidate) as linearizer:
            if whole:
                linearizer.refuse_marginal(linearizer.at(linearizer.motion.part(1.0)))
            radii = _radius_by_mass(linearizer, (self._masses[0], self._masses[-1]))
            stable = max(radii.values()) < 1.0
            held = expected_gains(linearizer) if stable or whole else {}
            noise = (
                predict_noise(linearizer, held)
                if stable or whole
                else _diverged(linearizer.outputs)
            )
            point = DesignPoint(
                scenario=candidate,
                prediction=noise.with_mean(np.zeros((len(force), 1)), force, period=period),
                radius_by_mass=radii,
                is_by_axis=axis_law(linearizer) is not None,
                is_run=False,
            )
            if not whole and not self._is_rejected(point) and requirement.baseline is not None:
                lost = requirement.baseline.margin_lost_by(candidate)
                point = dataclasses.replace(point, lost_margin=lost)
            if (
                is_rehearsed(candidate)
                and (whole or not self._is_rejected(point))
                and (rehearsal := rehearse(candidate, seeds=_SEEDS)) is not None
            ):
                noise = dataclasses.replace(noise, noise_error=rehearsal.rms_error)
                point = dataclasses.replace(point, rehearsal=rehearsal)
            if not whole and self._is_rejected(point):
                return point
            error, force = linearizer.follow(held=held)
            if point.rehearsal is not None:  # the error of whole runs
                error = np.zeros_like(error)
            prediction = noise.with_mean(error, force, period=period)
            return dataclasses.replace(point, prediction=prediction, is_run=True)

    def _is_rejected(self, point: DesignPoint) -> bool:
        """Whether a point fails before it is run, by what noise and the motion alone ask."""
        requirement = self.requirement
        baseline = requirement.baseline
        if requirement.failed(point):
            return True
        return baseline is not None and bool(
            point.lost_margin
            or baseline.worse_error(point)
            or point.prediction.isv > max(requirement.budget, baseline.point.prediction.isv)
        )

    def result(self) -> Design:
        """The choice among what was tried. Raises ScenarioError: nothing meets the budget."""
        chosen, baseline = self.chosen, self.requirement.baseline
        if self._asked is not None and self.requirement.violated(chosen).startswith("ISV"):
            raise self._too_little(chosen)
        with Linearizer(chosen.scenario) as linearizer:
            radius_by_mass = _radius_by_mass(linearizer, self._masses)
            can_adapt = adapts(linearizer)
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
            margins={} if baseline is None else baseline.margins(self._margins.get(id(chosen))),
            adapts=can_adapt,
            ended_by=self.ended_by,
        )

    def _too_little(self, chosen: DesignPoint) -> ScenarioError:
        budget = self.requirement.budget
        known = dataclasses.replace(self.requirement, baseline=None)
        within = [point for _, point in self._tried if not known.violated(point)]
        reason = (
            "within it they lose accuracy or margins: see --trade"
            if within
            else f"the cheapest gains found need {number(chosen.prediction.isv)}"
        )
        return ScenarioError("budget", f"ISV {number(budget)} cannot be met; {reason}")


def _boundaries(scenario: Scenario) -> tuple[Boundaries, float]:
    """The margins at the starting K_s and the posture with the largest spectral radius, and its
    time, s.
    """
    with Linearizer(scenario) as linearizer:
        times = [linearizer.part(share) for share in POSTURES]
        if linearizer.tracks_frame:  # as ``at_rest``
            times = [times[0], times[-1]]
        edge = max(times, key=lambda time: linearizer.at(time).spectral_radius)
    return find_boundaries(scenario, time=edge, adapted=False), edge


def _room(scenario: Scenario, demand: Demand) -> np.ndarray:
    """``Requirement.room``; a motion that takes more than half of a limit counts as half."""
    if not is_rehearsed(scenario):
        return np.full(demand.coordinates.num_velocities, np.inf)
    limit = actuation_limit(scenario, demand.coordinates).upper
    motion = np.abs(demand.force[demand.times > _TRANSIENT]).max(axis=0, initial=0.0)
    return np.maximum(limit - motion, 0.5 * limit) / ROOM


def _diverged(outputs: Outputs) -> Prediction:
    values = np.full(outputs.coordinates.num_velocities, np.inf)
    return Prediction(
        coordinates=outputs.coordinates,
        groups=outputs.groups,
        spectral_radius=math.inf,
        rms_error=np.full(outputs.size, np.inf),
        noise_error=np.full(outputs.size, np.inf),
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
    try:
        return {
            mass: max(linearizer.at(time, truth=truth).spectral_radius for time in ends)
            for mass, truth in truths.items()
        }
    except NotLinear:  # as a user-supplied law that has left its plan
        return dict.fromkeys(masses, math.inf)


def _active_constraint(
    point: DesignPoint, requirement: Requirement, search: AxisSearch | None
) -> str:
    """The constraint that a better design would violate."""
    peak, limit = point.prediction.peak_effort, requirement.limit
    if point.prediction.isv > 0.98 * requirement.budget:
        return f"the budget of effort, ISV {number(requirement.budget)}"
    if (peak > 0.95 * limit).any():
        i = int(np.argmax(peak / limit))
        return f"actuation.limit of {point.prediction.coordinates.names[i]}, {limit[i]:g}"
    if max(point.radius_by_mass.values()) > LARGEST_RADIUS:
        worst = max(point.radius_by_mass, key=lambda mass: point.radius_by_mass[mass])
        return f"stability for a true payload of {worst:g} kg"
    if search is not None and (groups := search.at_the_edge()):
        return f"stability over the payload range, in {', '.join(groups)}"
    return "none; more effort brings less accuracy than it costs"
