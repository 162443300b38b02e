"""Phases of a capture: the phases of the scenario, the approach, and the stop."""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.before import phases_before
from ffsm_drake.plugins.capture.handover import Handover, stored_at_start
from ffsm_drake.plugins.capture.supervisor import Mode
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.phases import Mission, Phase, Progress
from ffsm_drake.systems.registry import Factory

CONTACTS = "forces.contacts"


class Captures(Mission):
    """Runs through the phases of a capture with grippers that close at once."""

    last: int | None = None  # sample at which the stop ends; None: the end of the run

    def __init__(
        self, handovers: Sequence[Handover], progress: Progress | None = None, **how: Any
    ) -> None:
        """Args: handover of each run; further ones, see ``Mission``."""
        super().__init__([each.scenario for each in handovers], progress, **how)
        self.handovers = list(handovers)

    def first(self) -> Phase:
        """The first phase."""
        return self.approach(self.handovers[0].sample, self._hold)

    def approach(
        self,
        last: int,
        then: Callable[[], Phase | None],
        blocks: Mapping[str, Factory] | None = None,
    ) -> Phase:
        """The scenario's own phases and the approach, up to a sample, with some blocks: neighbours
        with the same blocks share a loop.
        """
        scenario, shared, end = self.handovers[0].scenario, blocks or {}, 0.0
        phases, before = list[Phase](), dict[str, Factory]()
        for name, phase in {**phases_before(scenario), "approach": Phase()}.items():
            own = dict(phase.blocks)
            end += scenario.blocks.phases[name].duration if name in scenario.blocks.phases else 0.0
            part = name, last if name == "approach" else round(end / scenario.sample_time)
            if phases and own == before:
                phases[-1] = dataclasses.replace(phases[-1], names=(*phases[-1].names, part))
            else:
                afresh = tuple({**own, **before})
                phases.append(Phase(names=(part,), blocks={**shared, **own}, afresh=afresh))
            before = own
        for phase in reversed(phases):
            phase = dataclasses.replace(phase, next=then)
            then = functools.partial(_itself, phase)
        return phase

    def begin(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Put the servicers at their starts; where the last phase ended; or with their targets."""
        if self.sample == 0:
            starts = np.stack([each.start(loop) for each in self.handovers])
            loop.set_whole_states(root_context, starts)
        elif phase.holds:
            self._grasp(phase, loop, root_context)
        else:
            super().begin(phase, loop, root_context)

    def meet(self) -> None:
        """Find how each gripper meets its target."""
        for copy, state in enumerate(self.before.whole_states(self.context)):
            if copy not in self.ended:
                self.handovers[copy].meet(self.before, state)

    def _grasp(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Grasp the targets; the runs continue from the states after the grasp."""
        rows = loop.whole_states(root_context)
        for copy, handover in enumerate(self.handovers):
            if copy not in self.ended:
                rows[copy] = handover.grasp(loop)
        loop.set_whole_states(root_context, rows)
        references = np.stack([each.reference for each in self.handovers])
        loop.resume(root_context, self.before, self.context, references, afresh=phase.afresh)
        # to the blocks, which resume with nothing in the gripper
        loop.set_payloads(root_context, [each.payload for each in self.handovers])
        if CONTACTS in loop.blocks:
            hands: Any = loop.blocks[CONTACTS]
            hands.hold(rows[0])

    def _hold(self) -> Phase | None:
        """The stop of the runs whose grippers hold the target."""
        self.meet()
        for copy in {*range(len(self.logs))} - self.ended:
            handover = self.handovers[copy]
            message, beyond = given_up(self.logs[copy][-1]), handover.beyond_envelope()
            beyond = beyond or self._others_beyond(copy)
            at = f"t = {handover.scenario.grasp_time:g} s"
            if message or beyond:
                self._fail(copy, MISSED, message or f"the target is missed at {at}: {beyond}")
        self.ended |= set(self.failed)
        if len(self.ended) == len(self.logs):
            return None
        return Phase(names=(("stop", self.last),), holds=True)

    def _others_beyond(self, copy: int) -> str:
        """As ``Handover.beyond_envelope``, of further hands."""
        stop, capture = self._kept.get(True), self._scenarios[copy].capture
        if stop is None or capture is None or CONTACTS not in stop.loop.blocks:
            return ""
        hands: Any = stop.loop.blocks[CONTACTS]
        beyond: str = hands.beyond(self.before.whole_states(self.context)[copy], capture.envelope)
        return beyond

    def _note(self, phase: Phase, logs: Sequence[RunLog | None]) -> None:
        super()._note(phase, [None if log is None else _without_contact(log) for log in logs])

    def _path(self, copy: int) -> np.ndarray:
        """The motion of a target before its grasp, at the samples from the start."""
        return self.handovers[copy].path

    def _joined(self, copy: int) -> RunLog:
        log, made = super()._joined(copy), self.handovers[copy].log
        if made is None:
            truth = self._scenarios[copy].payload.truth
            target = self._path(copy)[: log.time.size]
            grasp = GraspLog(sample=log.time.size, payload=truth, target=target)
        else:
            grasp = dataclasses.replace(made, stored=stored_at_start(self.logs[copy][-1]))
        return dataclasses.replace(
            log, grasp=dataclasses.replace(grasp, legs=self._legs(grasp.sample))
        )


def _itself(phase: Phase) -> Phase:
    return phase


def given_up(approach: RunLog) -> str:
    """Return how the supervisor abandoned an approach; empty: it did not."""
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return ""
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    return f"the supervisor abandoned the approach at t = {since:g} s"


def _without_contact(log: RunLog) -> RunLog:
    """A phase's log with the external force on servicer and target together."""
    series = dict(log.series)
    contact = series.pop(f"force_{GRIPPER.partition('.')[2]}", None)
    if contact is not None:
        series["disturbance_force"] = series["disturbance_force"] - contact
    return dataclasses.replace(log, series=series)
