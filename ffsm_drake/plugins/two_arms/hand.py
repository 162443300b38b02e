"""Hands that grasp after the first one (``contacts.NAME.closes``).

The loop before a closing has no force of the contact, and the law works in the tree. The closing is
a plastic impact on the moving stack,

    A H^-1 A' lambda = -A v,    v+ = v + H^-1 A' lambda,

of all rigid hands on the target from then on; the new one holds where it is. The law goes on with
its memory, in the velocities of the chain.
"""

import dataclasses
import functools
from typing import Any

import numpy as np

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.contact import CLOSING, LOSS
from ffsm_drake.plugins.two_arms.flow import GAP, WRENCHES
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import HeldLoops, Phase, Phases, Situation, Stop
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.capture import Envelope
from ffsm_drake.scenario.contacts import ALL_HANDS, Grip, closing_contacts, closing_times

_BLOCK, _FORCE, _OTHER = "forces.contacts", "force_contacts", "force_disturbance"


def phases_of_later_hands(mission: Mission, before: Phases, held: HeldLoops | None) -> Phases:
    """Return the phases of a mission, and one from each closing of a late hand to the next."""
    scenario = mission.scenario
    assert held is not None
    times = closing_times(scenario)[1:]
    ends = [round((scenario.grasp_time + time) / scenario.sample_time) for time in times]
    kinds = {
        name: dataclasses.replace(kind, until=ends[0], then=f"hand {times[0]:g}")
        if isinstance(kind, Stop)
        else kind
        for name, kind in before.kinds.items()
    }
    for time, (until, following) in zip(
        times, [*zip(ends[1:], times[1:], strict=True), (None, None)], strict=True
    ):
        then = "" if following is None else f"hand {following:g}"
        kinds[f"hand {time:g}"] = Hand(
            until=until, then=then, time=time, scenario=scenario, held=held(time)
        )
    complete = functools.partial(_complete, scenario)
    return dataclasses.replace(before, kinds=kinds, complete=complete)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hand(Stop):
    """A hand closes on the target, unless it is too far from its place."""

    time: float  # after the grasp, s
    scenario: Scenario
    held: ClosedLoop  # of the phase

    def plan(self, now: Situation) -> tuple[Phase | None, Situation]:
        """See PhaseKind."""
        scenario, block = self.scenario, self.held.blocks[_BLOCK]
        envelope = Envelope() if scenario.capture is None else scenario.capture.envelope
        beyond = block.beyond(now.stage.state, envelope)
        if not beyond:
            names = (("stop", self.until),)
            return Phase(names=names, grip=Grip(closed=self.time), afresh=(_BLOCK,)), now
        (name, *_) = (name for name, each in scenario.contacts.items() if each.closes == self.time)
        at = f"t = {now.sample * scenario.sample_time:g} s"
        missed = f"the hand of contacts.{name} misses its place at {at}: {beyond}"
        return None, now.failing(MISSED, missed)

    def enter(self, now: Situation, phase: Phase, stage: Stage) -> Situation:
        """Close the hands of the phase."""
        if now.made is not None:
            stage.carry(now.made.payload)
        series = now.logs[-1].series
        work = series[LOSS][-1].item() if LOSS in series else 0.0
        hands: Any = stage.blocks[_BLOCK]
        state = hands.close(stage.context(_BLOCK), now.stage.state, work=work)
        stage.place(state)
        stage.resume(now.stage, stage.desired, afresh=phase.afresh)
        return now


def _complete(scenario: Scenario, logs: tuple[RunLog, ...]) -> tuple[RunLog, ...]:
    """The logs of the phases with the series of open hands, which are zero."""
    closing = closing_contacts(scenario, ALL_HANDS)
    names, last = list(closing), logs[-1]
    # of the hands that grasp at once, in phases before the first late one
    known = {name for log in logs if CLOSING not in log.series for name in log.series}

    def of_all(values: np.ndarray | None, count: int) -> np.ndarray:
        """Values (count, 6 for each contact) of all contacts, from those of the first to close."""
        found = np.zeros((count, len(closing), 6))
        if values is not None:
            first = sorted(names, key=lambda name: closing[name].closes)[: values.shape[1] // 6]
            found[:, sorted(map(names.index, first))] = values.reshape(count, -1, 6)
        return found.reshape(count, -1)

    def completed(log: RunLog) -> RunLog:
        series, count = dict(log.series), log.time.size
        for name in (WRENCHES, GAP):
            values = series.get(name)
            if values is None and name in known:  # before the grasp
                width = next(each.series[name].shape[1] for each in logs if name in each.series)
                values = np.full((count, width), np.nan)
            series[name] = of_all(values, count)
        for name in (CLOSING, LOSS, _FORCE, _OTHER):
            if name in last.series and name not in {*series, *known}:
                zeros = np.zeros((count, last.series[name].shape[1]))
                series[name] = series["disturbance_force"] if name == _OTHER else zeros
        return dataclasses.replace(log, series=series)

    return tuple(completed(log) for log in logs)
