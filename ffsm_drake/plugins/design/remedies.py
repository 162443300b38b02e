"""Remedies for a mission not expected to go as planned: single changes, each tried before it is
reported.

For an unstable linear loop of a leg: a lighter nominal payload, a smaller K_s, smaller gains, a
shorter control period, less delay. For a stable loop that diverges under its force limits with some
noise sequences: larger limits, smaller gains, a longer motion. For unknown faults: detection. The
mildest sufficient change of each kind is reported. Saturated base actuators have their own advice
(``load.advice``).
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.steps import step
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.mission import Mission, kept, make_mission
from ffsm_drake.plugins.design.remarks import posture_limits
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.design.stability.adaptation import axis_law, is_euler
from ffsm_drake.plugins.design.stability.boundaries import feedback_gains
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.mission import LegVerdict, linear_verdict
from ffsm_drake.plugins.design.stability.one_axis import tolerated_eta
from ffsm_drake.plugins.design.stability.rehearsal import MANY, shares_diverged
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Scenario, override_scenario
from ffsm_drake.systems.controllers import complete_gains, declared_gains
from ffsm_drake.systems.parts.advice import Advice

# factors, the mildest first
_LESS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.42, 0.35, 0.25, 0.15, 0.1, 0.05, 0.02)
_TOO_LIGHT = 9  # number of these factors considered for a nominal payload
_SOONER = (0.8, 0.5, 0.4, 0.25, 0.2, 0.1)  # factors on the sample time; they divide other durations
_MORE = (1.1, 1.25, 1.5, 2.0, 3.0)
_LIGHTER = "a lighter nominal payload"
Changes = dict[str, Any]


@step("searching for a change that helps")
def remedies(scenario: Scenario | Mission, *, fails: bool) -> tuple[Advice, ...]:
    """Return remedies for a mission with an unstable linear loop, or with a run that ``fails``.

    The search takes seconds. There is no search for a mission that is expected to go as planned, or
    if a posture outside the joint limits is the cause.
    """
    try:
        mission = make_mission(scenario)
        return () if posture_limits(mission) else _found(mission, fails)
    except FfsmError:  # the loop cannot be linearised or built
        return ()


@kept  # a report and the verdict ask for the same
def _found(mission: Mission, fails: bool) -> tuple[Advice, ...]:
    scenario = complete_gains(mission.scenario)
    legs = [leg for leg in linear_verdict(mission.of(scenario)).legs if leg.status == "unstable"]
    if legs:
        return tuple(_of_the_loop(scenario, legs))
    if not fails:
        return ()
    return (*_of_limits(scenario), *_of_faults(scenario))


def _of_the_loop(scenario: Scenario, legs: Sequence[LegVerdict]) -> Iterator[Advice]:
    """Changes that stabilise the linear loop."""

    def may_help(changed: Scenario) -> bool:
        return all(_radius(changed, leg) < 1.0 for leg in legs)

    def helps(changed: Scenario) -> bool:
        return may_help(changed) and not linear_verdict(changed).is_alarm

    for reason, trials in (
        (_too_heavy(scenario, legs[0]), _lighter(scenario)),
        (
            "a smaller K_s",
            _smaller(
                scenario, [name for name in declared_gains(scenario) if name.startswith("k_s")]
            ),
        ),
        ("smaller gains", _smaller(scenario, feedback_gains(scenario))),
        (
            "a shorter control period",
            ({"sample_time": rounded(each * scenario.sample_time)} for each in _SOONER),
        ),
        ("less delay, or the right delay in the estimator", _less_delay(scenario)),
    ):
        lighter = reason.startswith(_LIGHTER)  # which may be too light in the end
        limit = None if lighter else may_help
        yield from _first(scenario, trials, helps, reason, may_help=limit)


def _of_limits(scenario: Scenario) -> Iterator[Advice]:
    """Changes that keep the loop from diverging under its limits, if noise drives it there."""
    limit = scenario.actuation.limit
    if limit is None or is_rehearsed(scenario):
        return

    def stays(changed: Scenario) -> bool:
        return shares_diverged([changed], seeds=MANY) == [0.0]

    if stays(scenario):
        return
    for reason, trials in (
        (
            "larger limits",
            ({"actuation.limit": _scaled(scenario, limit, factor)} for factor in _MORE),
        ),
        ("smaller gains", _smaller(scenario, feedback_gains(scenario))),
        ("a longer motion", _longer(scenario)),
    ):
        yield from _first(scenario, trials, stays, reason)


def _of_faults(scenario: Scenario) -> Iterator[Advice]:
    """Fault detection, if the run fails because its faults are not detected."""

    def settles(changed: Scenario) -> bool:
        rollout = make_rollout(changed)
        try:
            return rollout.run().ending.is_settled
        finally:
            rollout.release()

    if scenario.faults is None or not scenario.faults.events or scenario.faults.detection:
        return
    known = iter([Changes({"faults.detection": {}})])
    yield from _first(scenario, known, settles, "the flight software detects the faults")


def _first(
    scenario: Scenario,
    trials: Iterator[Changes],
    helps: Callable[[Scenario], bool],
    reason: str,
    *,
    may_help: Callable[[Scenario], bool] | None = None,
) -> Iterator[Advice]:
    """The first of some changes that helps, if there is one; none where even the last may not."""

    def holds(test: Callable[[Scenario], bool], changes: Changes) -> bool:
        try:
            return test(override_scenario(scenario, [changes]))
        except FfsmError:  # it is refused, or not linear any more
            return False

    every = list(trials)
    if every and may_help is not None and not holds(may_help, every[-1]):
        return
    for k, changes in enumerate(every):
        with step(f"{reason.partition(':')[0]}, trial {k + 1} of {len(every)}"):
            is_enough = holds(helps, changes)
        if is_enough:
            yield Advice(changes=changes, reason=reason)
            return


def _radius(scenario: Scenario, leg: LegVerdict) -> float:
    """The spectral radius at the instant where a leg was worst."""
    approach = leg.leg == "approach"
    begin = 0.0 if approach else scenario.grasp_time
    with Linearizer(scenario, approach=approach) as linearizer:
        return linearizer.at(max(leg.time - begin, 0.0)).spectral_radius


def _too_heavy(scenario: Scenario, leg: LegVerdict) -> str:
    """Why a lighter nominal payload helps: by how much its inertia is over-estimated."""
    told = _LIGHTER
    if leg.leg == "approach":
        return told
    with Linearizer(scenario) as linearizer:
        law, time = axis_law(linearizer), max(leg.time - scenario.grasp_time, 0.0)
        if law is None:
            return told
        eta = float(linearizer.planned.ratios(time).max())
        most = float(tolerated_eta(law, 0, euler=is_euler(scenario))[1])
    return f"{told}: eta is up to {eta:.3g}, and {scenario.controller} tolerates {most:.3g}"


def _lighter(scenario: Scenario) -> Iterator[Changes]:
    """Only the mass, then mass and inertia, down to a payload that is too light."""
    nominal = scenario.payload.nominal
    for factor in _LESS[:_TOO_LIGHT]:
        mass = {"payload.nominal.mass": rounded(factor * nominal.mass)}
        inertia = [rounded(factor * each) for each in nominal.inertia]
        yield from (mass, {**mass, "payload.nominal.inertia": inertia})


def _smaller(scenario: Scenario, chosen: Collection[str]) -> Iterator[Changes]:
    """Chosen gains of the law, as a whole; a K_s without a bound gets one."""
    key = scenario.controller_key
    gains = {name: x for name, x in scenario.gains.items() if name in chosen}
    for factor in _LESS if gains else ():
        yield {
            f"controllers.{key}.{name}": _scaled(scenario, x, factor) for name, x in gains.items()
        }


def _scaled(scenario: Scenario, given: Any, factor: float) -> Any:
    if given is None:
        return rounded(factor * 2.0 / scenario.sample_time)
    if isinstance(given, Mapping):
        return {name: rounded(factor * value) for name, value in given.items()}
    return rounded(factor * given)


def _less_delay(scenario: Scenario) -> Iterator[Changes]:
    sensing, actuation = scenario.sensing.delay, scenario.actuation.delay
    if sensing and scenario.estimator.delay not in (None, sensing):
        yield {"estimator.delay": None}
    for less in range(1, max(sensing, actuation) + 1):
        delays = {"sensing.delay": sensing, "actuation.delay": actuation}
        timed = {} if scenario.sensing.delay_time is None else {"sensing.delay_time": None}
        yield timed | {key: max(delay - less, 0) for key, delay in delays.items() if delay}


def _longer(scenario: Scenario) -> Iterator[Changes]:
    given = scenario.reference.duration
    if given is None or scenario.reference.kind == "optimal":
        return
    for factor in _MORE:
        duration = math.ceil(factor * given)
        yield {
            "reference.duration": float(duration),
            "duration": scenario.duration + duration - given,
        }
