"""Runs side by side with grippers that close in time: approach, closing and stop.

They stay side by side if the gripper holds the target at the first attempt. Other runs are made
separately.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.plugins.capture.closing import ClosingRun, lately
from ffsm_drake.plugins.capture.handover import Handover
from ffsm_drake.plugins.capture.phases import Captures, given_up
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, Progress


class FirstTries(Captures):
    """First tries of several runs, which begin to close at the same sample."""

    def __init__(
        self, handovers: Sequence[Handover], progress: Progress | None = None, **how: Any
    ) -> None:
        """Args: see ``Captures``."""
        super().__init__(handovers, progress, **how)
        self._runs = [ClosingRun([each]) for each in handovers]
        for copy, run in enumerate(self._runs):
            run.copy = copy

    def first(self) -> Phase:
        """The first phase."""
        return self.approach(self.handovers[0].sample - self._runs[0].samples, self._close)

    def _note(self, phase: Phase, logs: Sequence[RunLog | None]) -> None:
        first, going = self.sample, self._going()
        super()._note(phase, logs)
        for copy, run in going:
            if logs[copy] is not None:
                run.moved(self.loop, first, self.logs[copy][-1])

    def _close(self) -> Phase | None:
        """Close the grippers, but of those that miss."""
        first = self.sample
        for copy, run in self._told():
            run.find_target()
            if given_up(self.logs[copy][-1]):
                self._put_aside(copy)
        self.meet()
        for copy, run in self._going():
            if run.handover.beyond_envelope():
                self._put_aside(copy)
        if len(self.ended) == len(self.logs):
            return None
        one, forces = self._runs[0], None
        if one.is_limp:
            none = np.zeros(len(self.before.coordinates.joints))
            forces = np.stack([lately(each[-1]) if each else none for each in self.logs])

        def begin(loop: ClosedLoop, root_context: Context) -> None:
            for _, run in self._going():
                run.begin_to_close(loop, root_context)

        return Phase(
            names=(("closing", first + one.samples),),
            blocks=one.closing_blocks(),
            joint_force=forces,
            afresh=("reference",),
            begin=begin,
            next=lambda: self._stop(first),
        )

    def _stop(self, first: int) -> Phase | None:
        """Stop the targets that are held by the grippers that began to close at a sample."""
        for copy, run in self._told():
            if run.lost(first):
                self._put_aside(copy)
            else:
                self.handovers[copy] = run.held()
        if len(self.ended) == len(self.logs):
            return None
        self.meet()
        plans = [each.scenario for each in self.handovers]
        return Phase(names=(("stop", None),), scenario=plans, holds=True, afresh=("controller",))

    def _path(self, copy: int) -> np.ndarray:
        return self._runs[copy].path

    def _told(self) -> list[tuple[int, ClosingRun]]:
        """The copies that have not ended, with their runs, which know where they are."""
        for _, run in self._going():
            run.sample, run.before, run.context = self.sample, self.before, self.context
        return self._going()

    def _going(self) -> list[tuple[int, ClosingRun]]:
        """The copies that have not ended, with their runs."""
        return [each for each in enumerate(self._runs) if each[0] not in self.ended]

    def _put_aside(self, copy: int) -> None:
        self._lost.add(copy)
        self.ended.add(copy)
