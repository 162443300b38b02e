"""The verdict on a mission before it runs, in lines with their scope.

Linear: the wired loop of every leg along the plan, without limits and noise. Load: the force that a
capture needs, compared with its limits. Rehearsed: a run of the mission, with its limits, its noise
and its grasp. Limits: further runs with other noise, if there are actuators of the base, or if the
run nearly reaches force limits. Parts of the verdict can disagree, and a line reports this.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.numbers import number, percent
from ffsm_drake.common.registrations import Registry
from ffsm_drake.common.steps import step
from ffsm_drake.loop.blocks import is_rehearsed
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.momentum import momentum_budget, momentum_lines
from ffsm_drake.plugins.design.limits_left import CLEARANCE, limits_left
from ffsm_drake.plugins.design.remarks import plan_clearance, plan_limits, plan_remarks
from ffsm_drake.plugins.design.remedies import remedies
from ffsm_drake.plugins.design.remedy_file import run_advice
from ffsm_drake.plugins.design.stability import Margins, adaptation_remark, stability
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.load import advice, predicted_load, saturated_shares
from ffsm_drake.plugins.design.stability.mission import LinearVerdict, linear_verdict
from ffsm_drake.plugins.design.stability.rehearsal import (
    FAR,
    MANY,
    SEEDS,
    Rehearsal,
    is_near_limits,
    rehearse,
)
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.ending import NOT_SETTLED, Ending
from ffsm_drake.runs.exceeded_limits import broken_limits
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import Scenario, checked
from ffsm_drake.systems.parts.advice import Advice

_ALONE = ", each by itself"  # of remedies that may help without the others
# What the linear results cover of a mission with barriers, which they leave out.
LINEAR_REMARKS = Registry[Callable[[Mission], str]]("linear_remarks")
_RARE = 0.02  # share of noise sequences with divergence that is no alarm


@dataclasses.dataclass(frozen=True, kw_only=True)
class RehearsedRun:
    """A run of the mission with its own random seed."""

    ending: Ending
    limits: dict[str, float]  # limits that it exceeded -> when first, s
    broken: tuple[str, ...] = ()  # ``broken_limits``: those that nothing enforces

    @property
    def fails(self) -> bool:
        """Whether it failed, ended off its plan, or far from where it should."""
        far = self.ending.status == NOT_SETTLED and self.ending.excess > FAR
        return self.ending.is_failure or far or self.ending.gave_up

    @property
    def is_alarm(self) -> bool:
        """Whether it fails, or breaks a limit that nothing enforces."""
        return self.fails or bool(self.broken) or CLEARANCE in self.limits

    @property
    def sentence(self) -> str:
        """The run's ending and the first limit that it exceeded."""
        if self.broken:
            return f"{self.ending.sentence} Limits exceeded: {'; '.join(self.broken)}."
        if not self.limits:
            return self.ending.sentence
        return f"{self.ending.sentence} First limit exceeded: {self.first_limit}."

    @property
    def first_limit(self) -> str:
        """The first limit that it exceeded, with the time."""
        first = min(self.limits, key=lambda name: self.limits[name])
        return f"{first} at t = {self.limits[first]:.2f} s"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """Expectations for a mission; a part that was not requested, or does not apply, is None."""

    linear: LinearVerdict | None
    not_linear: str  # why there is no linear verdict; empty if there is one
    barriers: str = ""  # what the linear results cover of them; empty: there are none
    load: float | None  # with a capture: largest force as a fraction of its limit
    noises: Rehearsal | None  # runs with other noise, if the force may saturate
    run: RehearsedRun | None
    planned: tuple[str, ...] = ()  # without a run: ``plan_limits``
    margins: Margins | None = None
    not_margins: str = ""  # why there are no margins; empty if there are, or none were requested
    adaptation: str = ""  # ``adaptation_remark``, or what of a user's adaptation is not covered
    advice: tuple[Advice, ...] = ()  # remedies for saturated base actuators
    remedies: tuple[Advice, ...] = ()  # remedies if it is not expected to go as planned

    @property
    def is_alarm(self) -> bool:
        """Whether the mission is not expected to go as planned.

        A run of the mission takes precedence: with a run, the linear verdict is an alarm only if
        the run, too, ends without settling, and the load and the plan are no alarms.
        """
        if self.planned or self._diverges_by_noise:
            return True
        if self.run is None:
            return self.is_linearly_unstable or self._overloaded
        unstable = self.is_linearly_unstable and not self.run.ending.is_settled
        return self.run.is_alarm or unstable

    @property
    def _diverges_by_noise(self) -> bool:
        return self.noises is not None and self.noises.share_diverged > _RARE

    @property
    def is_linearly_unstable(self) -> bool:
        """Whether the linear loop of a leg is unstable, regardless of a run."""
        return self.linear is not None and self.linear.is_alarm

    @property
    def _linear_is_known(self) -> bool:
        return self.linear is not None and self.linear.status != "cannot say"

    @property
    def _overloaded(self) -> bool:
        return self.load is not None and self.load > 1.0

    @property
    def is_as_planned(self) -> bool:
        """Whether nothing speaks against the mission as planned: no alarm, a stable linear loop
        and, with a run, one that settles within its limits.
        """
        settles = self.run is None or (self.run.ending.is_settled and not self.run.limits)
        return settles and not self.is_alarm and not self.is_linearly_unstable

    @property
    def lines(self) -> list[str]:
        """The results of each part, a line each, and their disagreements."""
        return list(self._lines())

    def _lines(self) -> Iterator[str]:
        if self.linear is not None:
            yield f"linear: {self.linear.sentence}"
        elif self.not_linear:
            yield f"linear: cannot say: {self.not_linear}"
        if self.barriers:
            yield f"barriers: {self.barriers}"
        if self.load is not None and math.isfinite(self.load):
            saturates = ", so the force saturates" if self._overloaded else ""
            share = f"{number(100.0 * self.load, 3)} %"
            yield f"load after the grasp (no noise): {share} of the force limit{saturates}"
        if self.not_margins:
            yield f"margins: cannot say: {self.not_margins}"
        if self.margins is not None:
            yield f"margins (after the grasp): {self.margins.verdict}"
        if self.noises is not None and not self._is_in_margins:
            yield f"limits ({self.noises.sequences}): {self.noises}"
        for each in self.planned:
            yield f"plan: {each}"
        if self.run is not None:
            yield f"rehearsed (one run with limits and noise): {self.run.sentence}"
            if self.is_linearly_unstable and self.run.ending.is_settled:
                yield (
                    "linear and rehearsed disagree: the linear loop is unstable, but the run "
                    "settles"
                )
            if self._linear_is_known and not self.is_linearly_unstable and self.run.fails:
                yield (
                    "linear and rehearsed disagree: small errors decay, so the run fails because "
                    "of limits, noise, a lasting error, or the transient at the start"
                )
        if self.advice:
            yield helps(self.advice)
        if self.remedies:
            yield helps(self.remedies, _ALONE)

    @property
    def _is_in_margins(self) -> bool:
        return self.margins is not None and self.noises is self.margins.rehearsal

    @property
    def conclusion(self) -> str:
        """One line: the expectation and its scope. Only a run predicts how the mission ends."""
        without = " without barriers" if self.barriers else ""
        covers = [
            name
            for name, part in (
                (f"linear loop of every leg{without}", self._linear_is_known or None),
                ("load after the grasp", self.load),
                (self.noises.sequences if self.noises else "", self.noises),
                ("one run with limits and noise", self.run),
                ("limits of the plan", self.planned or None),
            )
            if part is not None
        ]
        scope = f" (checked: {'; '.join(covers) or 'nothing'})"
        if self.is_alarm:
            return f"not expected to go as planned{scope}"
        if not covers:
            return f"no prediction; leave out --no-rehearsal{scope}"
        if self.run is None:
            return (
                "no alarm, but the mission was not rehearsed; to predict how it ends, leave out "
                f"--no-rehearsal{scope}"
            )
        if self.is_linearly_unstable:
            return (
                "expected to settle, but the linear loop is unstable: confirm it with other seeds "
                f"(--seed N){scope}"
            )
        if not self.run.ending.is_settled:
            return f"not expected to settle: {self._unsettled}{scope}"
        if self.run.limits:
            return (
                "expected to settle, with commands beyond their limits, first "
                f"{self.run.first_limit}; raise the limit or lengthen the motion{scope}"
            )
        return f"expected to go as planned{scope}"

    @property
    def _unsettled(self) -> str:
        ending: Ending = self.run.ending  # type: ignore[union-attr]
        if ending.excess <= 1.0:
            return "the run ends before the planned motion; lengthen duration"
        return (
            f"{ending.coordinate} ends at {number(ending.excess, 3)} tolerances; lengthen duration "
            "or change the controller"
        )

    @property
    def warnings(self) -> list[str]:
        """A line where the mission is not expected to go as planned, and one on adaptation."""
        found, reasons = [self.adaptation] if self.adaptation else [], list(self._reasons())
        if self.is_alarm and reasons:  # limits that a plan exceeds are remarks of their own
            found.insert(0, f"not expected to go as planned: {'; '.join(reasons)}")
        return found

    def as_data(self) -> dict[str, Any]:
        """Plain data."""
        linear, run = self.linear, self.run
        return {
            "alarm": self.is_alarm,
            "conclusion": self.conclusion,
            "lines": self.lines,
            "linear": None if linear is None else [dataclasses.asdict(leg) for leg in linear.legs],
            "load": self.load,
            "advice": [dict(each.changes) for each in self.advice],
            "remedies": [dict(each.changes) for each in self.remedies],
            "beyond": [*self.planned, *(() if self.run is None else self.run.broken)],
            "share_diverged": None if self.noises is None else self.noises.share_diverged,
            "run": None
            if run is None
            else {**dataclasses.asdict(run.ending), "first_beyond": run.limits},
        }

    def _reasons(self) -> Iterator[str]:
        if self.linear is not None and self.linear.is_alarm:
            yield self.linear.sentence
        if self._overloaded:
            load = self.load or 0.0
            needs = f"the force reaches {number(100.0 * load, 3)} % of its limit"
            grows = "the force grows without bound"
            yield f"after the grasp {needs if math.isfinite(load) else grows}"
        if self.noises is not None and self._diverges_by_noise:
            yield f"under the limits: {self.noises}"
        if self.run is not None and self.run.is_alarm:
            yield f"rehearsed: {self.run.sentence}"


@guarded
def verdict(
    scenario: Scenario | Mission,
    *,
    rehearsal: bool = True,
    margins: bool = False,
    advises: bool = True,
) -> Verdict:
    """The verdict on a mission.

    Args:
      scenario: the scenario, or its mission.
      rehearsal: run the mission, in the time of a run; otherwise only results without a run.
      margins: find the margins from the grasp on, too; a reason replaces missing ones.
      advises: with a rehearsal, search ``remedies`` for a failing mission (seconds).

    Raises:
      ModelError, ScenarioError: the scenario's model or a value in it cannot be used.
      BlockError: with ``rehearsal``, a user-supplied block fails.
    """
    mission = scenario if isinstance(scenario, Mission) else Mission(checked(scenario))
    found: dict[str, Any] = dict.fromkeys(("linear", "load", "noises", "run"))
    saturated = dict[str, float]()
    if mission.scenario.command_filter.barriers is not None:
        found["barriers"] = LINEAR_REMARKS.load("barriers", "command_filter.barriers")(mission)
    try:
        with Linearizer(mission) as linearizer:
            _without_a_run(found, mission, linearizer, margins=margins)
    except (BlockError, np.linalg.LinAlgError) as error:
        found["not_linear"] = one_line(error)
        if margins and found.get("margins") is None:
            found["not_margins"] = found["not_linear"]
        if isinstance(error, NotLinear) and found["linear"] is None:
            found["linear"] = linear_verdict(mission)  # which says so of its leg
    if rehearsal:
        log = _rehearsed(found, saturated, mission)
        with suppress(BlockError, np.linalg.LinAlgError):
            _under_limits(found, mission, log)
    else:
        found["planned"] = tuple(plan_limits(mission))
    expected = Verdict(**{"not_linear": "", **found})
    if expected.noises is not None:
        for name, shares in expected.noises.saturated.items():
            saturated[name] = max(saturated.get(name, 0.0), float(np.median(shares)))
    settles = not expected.is_alarm and (expected.run is None or expected.run.ending.is_settled)
    is_lost = expected._diverges_by_noise or (expected.run is not None and expected.run.fails)
    return dataclasses.replace(
        expected,
        advice=advice(mission, saturated, settles=settles),
        remedies=remedies(mission, fails=is_lost)
        if advises and rehearsal and expected.is_alarm
        else (),
    )


def mission(scenario: Scenario, *, rehearsal: bool) -> tuple[dict[str, Any], list[str]]:
    """The plan's clearance, the momentum after a grasp, the verdict and all warnings for ``ffsm
    validate``, as plain data; and lines on them, without the warnings. Errors as ``verdict``.
    """
    flown = Mission(scenario)
    closest, budget = plan_clearance(flown), momentum_budget(flown)
    remarks, found = plan_remarks(flown), verdict(flown, rehearsal=rehearsal)
    momentum = {} if budget is None else {"momentum_budget": dataclasses.asdict(budget)}
    data = {
        "nearest": [dataclasses.asdict(each) for each in closest],
        **momentum,
        "mission": found.as_data(),
        "warnings": [*remarks, *found.warnings],
    }
    return data, [*found.lines, found.conclusion, *momentum_lines(momentum.get("momentum_budget"))]


def helps(found: Iterable[Advice], how: str = "") -> str:
    """Return remedies in one line; those for saturated actuators are not rehearsed."""
    return f"what may help{how}: {'; '.join(map(str, found))}"


def helpful_remarks(record: RunRecord) -> list[str]:
    """Lines with what helps where actuators of the base saturated in a run, and where it failed."""
    told = list[str]()
    saturated, for_saturation, others = run_advice(record)
    if for_saturation:
        shares = (f"{name} in {percent(share)}" for name, share in saturated.items() if share)
        told.append(f"saturated: {', '.join(shares)} of the samples; {helps(for_saturation)}")
    if others:
        told.append(helps(others, _ALONE))
    return told


def _without_a_run(
    found: dict[str, Any], mission: Mission, linearizer: Linearizer, *, margins: bool
) -> None:
    """Fill the parts of a verdict one after another; what was found before a BlockError stays."""
    found["linear"] = linear = linear_verdict(mission, linearizer)
    remark = "" if linear.is_alarm else adaptation_remark(linearizer)
    found["adaptation"] = linearizer.own_adaptation.uncovered or remark
    found["load"] = predicted_load(linearizer)
    if margins:
        found["margins"] = stability(mission, linearizer=linearizer)
        found["noises"] = found["margins"].rehearsal
    elif is_rehearsed(mission.scenario) and not linear.is_alarm:
        found["noises"] = rehearse(mission, on_drake=False)


@step("rehearsing the mission")
def _rehearsed(found: dict[str, Any], saturated: dict[str, float], mission: Mission) -> RunLog:
    """Run the mission, and note how, and the shares of samples in which actuators saturated."""
    rollout = make_rollout(mission)
    try:
        log = rollout.run()
    finally:
        rollout.release()
    saturated |= saturated_shares(mission.scenario, log)
    found["run"] = RehearsedRun(
        ending=log.ending,
        limits=limits_left(log),
        broken=tuple(broken_limits(mission, make_table(log))),
    )
    return log


@step("rehearsing with other noise sequences")
def _under_limits(found: dict[str, Any], mission: Mission, log: RunLog) -> None:
    """Run more noise sequences of a run that did not fail, with actuators of the base or so near
    to ``actuation.limit`` that other noise may exceed it.
    """
    scenario, linear, run = mission.scenario, found["linear"], found["run"]
    if found["noises"] is not None or linear is None or linear.is_alarm or run.fails:
        return
    force = log.generalized_force[log.time >= scenario.grasp_time]
    if is_rehearsed(scenario):
        found["noises"] = rehearse(mission, seeds=SEEDS)
    elif linear.status == "stable" and is_near_limits(scenario, log.coordinates, force):
        found["noises"] = rehearse(mission, seeds=MANY)
