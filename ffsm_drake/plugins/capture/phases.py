"""Phases of a capture: their common part, and an approach with a gripper that closes at once."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.blocks import GRIPPER
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.handover import Handover, stored_at_start
from ffsm_drake.plugins.capture.supervisor import Mode
from ffsm_drake.runs.ending import MISSED
from ffsm_drake.runs.log import GraspLog, RunLog
from ffsm_drake.runs.phases import Mission, Phase, Progress
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import Scenario


class Captures(Mission):
    """Runs that go through the phases of a capture; see ``Mission``."""

    afresh: tuple[str, ...] = ()  # blocks that start afresh with the target held

    def __init__(self, handovers: Sequence[Handover], progress: Progress | None = None) -> None:
        """Args: handover of each run; progress, see ``Rollout.run``."""
        super().__init__([each.scenario for each in handovers], progress)
        self.handovers = list(handovers)

    def put_at_start(self, loop: ClosedLoop, root_context: Context) -> None:
        """Put the servicers where their approaches start."""
        loop.set_whole_states(root_context, np.stack([each.start(loop) for each in self.handovers]))

    def meet(self, loop: ClosedLoop) -> None:
        """Find how each gripper meets its target, with the loop in which the targets are held."""
        for copy, state in enumerate(self.before.whole_states(self.context)):
            if copy not in self.ended:
                self.handovers[copy].meet(loop, state)

    def grasp(self, loop: ClosedLoop, root_context: Context) -> None:
        """Grasp the targets; the runs continue from the states after the grasp."""
        rows = loop.whole_states(root_context)
        for copy, handover in enumerate(self.handovers):
            if copy not in self.ended:
                rows[copy] = handover.grasp(loop)
        loop.set_whole_states(root_context, rows)
        references = np.stack([each.reference for each in self.handovers])
        loop.resume(root_context, self.before, self.context, references, afresh=self.afresh)
        # to the blocks, which resume with nothing in the gripper
        loop.set_payloads(root_context, [each.payload for each in self.handovers])

    def _note(self, phase: Phase, logs: Sequence[RunLog | None]) -> None:
        super()._note(phase, [None if log is None else _without_contact(log) for log in logs])

    def _path(self, copy: int) -> np.ndarray:
        """The motion of a target before its grasp, at the samples from the start."""
        return self.handovers[copy].path

    def _joined(self, copy: int) -> RunLog:
        log, grasp = super()._joined(copy), self.handovers[copy].log
        if grasp is None:
            truth = self._scenarios[copy].payload.truth
            target = self._path(copy)[: log.time.size]
            grasp = GraspLog(sample=log.time.size, contact=None, payload=truth, target=target)
        else:
            grasp = dataclasses.replace(grasp, stored=stored_at_start(self.logs[copy][-1]))
        return dataclasses.replace(
            log, grasp=dataclasses.replace(grasp, legs=self._legs(grasp.sample))
        )


class ApproachAndStop(Captures):
    """Runs whose grippers close at once, at the end of the approach."""

    def first(
        self,
        approach: Rollout,
        stop: Rollout,
        alone: Sequence[Scenario] | None,
        given: Sequence[Scenario] | None,
    ) -> Phase:
        """The approach. Args: loops without and with the targets, and the scenarios of each."""

        def hold() -> Phase | None:
            self.meet(stop.loop)
            for copy in {*range(len(self.logs))} - self.ended:
                handover = self.handovers[copy]
                message, beyond = given_up(self.logs[copy][-1]), handover.beyond_envelope()
                at = f"t = {handover.scenario.grasp_time:g} s"
                if message or beyond:
                    missed = message or f"the target is missed at {at}: {beyond}"
                    self._fail(copy, MISSED, missed)
            self.ended |= set(self.failed)
            if len(self.ended) == len(self.logs):
                return None
            return Phase(loop=stop, names=(("stop", None),), begin=self.grasp, scenarios=given)

        return Phase(
            loop=approach,
            names=(("approach", self.handovers[0].sample),),
            begin=self.put_at_start,
            scenarios=alone,
            next=hold,
        )


def given_up(approach: RunLog) -> str:
    """Ending of an approach given up by the supervisor; empty for any other."""
    modes = approach.series.get("mode", np.zeros(1)).ravel()
    if modes[-1] == Mode.APPROACH:
        return ""
    since = float(approach.time[np.flatnonzero(modes != Mode.APPROACH)[0]])
    return f"the approach is given up at t = {since:g} s"


def _without_contact(log: RunLog) -> RunLog:
    """A phase's log with the external force on servicer and target together."""
    series = dict(log.series)
    contact = series.pop(f"force_{GRIPPER.partition('.')[2]}", None)
    if contact is not None:
        series["disturbance_force"] = series["disturbance_force"] - contact
    return dataclasses.replace(log, series=series)
