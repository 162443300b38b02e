"""Phases of a mission as data, and the runner that goes through them with one log.

A phase describes how its loop differs from the mission (target in the gripper or not, plan, motion,
blocks such as the law), its end, and the next phase. The runner builds the loop, or uses a loop
that exists.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping

import numpy as np
from pydrake.systems.framework import Context, Diagram

from ffsm_drake.common.errors import BlockError
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.ending import Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import reference_from
from ffsm_drake.systems.registry import Factory
from ffsm_drake.systems.setup import BlockSetup

Begin = Callable[[ClosedLoop, Context], None]
Progress = Callable[[float, float], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Phase:
    """A phase of a mission, which runs in one closed loop.

    A factory in ``blocks.phases`` returns a phase with a ``motion`` that starts with the phase, and
    optionally with ``blocks``.

    Example:
      >>> from ffsm_drake import Phase
      >>> Phase(names=(("stop", None),), holds=True).holds
      True
    """

    # names of its samples in the record, one after another, with the sample at which each ends,
    # excluded; None: the end of the run
    names: tuple[tuple[str, int | None], ...] = ()
    holds: bool = False  # whether the target is in the gripper
    scenario: Scenario | None = None  # with its plan; None: the scenario of the mission
    motion: PlannedMotion | None = None  # desired, over the run's time; None: from the plan
    # block -> factory that replaces a block of the mission
    blocks: Mapping[str, Factory] = dataclasses.field(default_factory=dict)
    joint_force: np.ndarray | None = None  # see ``add_closed_loop``
    afresh: tuple[str, ...] = ()  # blocks that start anew in this phase
    begin: Begin = lambda loop, context: None  # other changes of its loop at its start
    next: Callable[[], "Phase | None"] = lambda: None  # called unless the run has ended


class Mission:
    """One run in a sequence of phases.

    ``before`` is the loop of the last phase and ``context`` its context at the end, ``sample`` the
    first one of the next phase; ``ended``: the run ended before its last phase did.
    """

    before: ClosedLoop
    context: Context
    loop: ClosedLoop  # loop of the present phase

    def __init__(
        self,
        scenario: Scenario,
        progress: Progress | None = None,
        *,
        blocks: Mapping[str, Factory] | None = None,
        kept: Mapping[bool, Rollout | None] | None = None,
    ) -> None:
        """Args:
        scenario: scenario of the run, as its log shall have it.
        progress: see ``Rollout.run``.
        blocks: factories that replace the scenario's blocks.
        kept: by ``holds``, loops of phases that differ in nothing else.
        """
        self._scenario, self._progress = scenario, progress
        self._blocks, self._kept = blocks or {}, kept or {}
        self._start, self.sample = time.perf_counter(), 0
        self._names: list[tuple[str, int]] = []  # phases with an end, and the sample after it
        self.logs: list[RunLog] = []  # of the phases
        self.failed: Outcome | None = None  # outcome of a run that failed between two phases
        self.ended = False
        self._own: list[Rollout] = []  # loops of this mission alone

    def run(self, phase: Phase | None) -> RunLog:
        """Run a phase and the phases after it. Raises the errors of ``Rollout.run``."""
        try:
            while phase is not None:
                self._note(phase, self._through(phase))
                phase = None if self.ended else phase.next()
        except BlockError as error:
            if error.log is not None and phase is not None:
                self._note(phase, error.log)
                error.log = self._joined()
            raise
        finally:
            for loop in self._own:
                loop.release()
        return self._joined()

    def _loop_of(self, phase: Phase, scenario: Scenario) -> Rollout:
        """Return the loop of a phase; a new one is released at the end of the run."""
        own: dict[str, Factory] = {}
        if phase.motion is not None:
            own["reference"] = functools.partial(_along, phase.motion)
        own |= phase.blocks
        if (kept := self._kept.get(phase.holds)) and not own and phase.scenario is None:
            return kept
        blocks = {**self._blocks, **own}
        self._own.append(Rollout(scenario, blocks=blocks, joint_force=phase.joint_force))
        return self._own[-1]

    def begin(self, phase: Phase, loop: ClosedLoop, root_context: Context) -> None:
        """Put a phase's loop where the phase begins: where the last one ended."""
        if self.sample > 0:
            loop.set_whole_states(root_context, self.before.whole_states(self.context))
            loop.resume(root_context, self.before, self.context, afresh=phase.afresh)
        phase.begin(loop, root_context)

    def _through(self, phase: Phase) -> RunLog:
        scenario = dataclasses.replace(phase.scenario or self._scenario, holds=phase.holds)
        loop = self._loop_of(phase, scenario)
        self.loop = loop.loop
        begin = functools.partial(self.begin, phase)
        leg = Leg(first=self.sample, last=phase.names[-1][1], begin=begin, end=self._keep)
        return loop.run(scenario, progress=self._progress, leg=leg)

    def _keep(self, loop: ClosedLoop, root_context: Context) -> None:
        self.before, self.context = loop, root_context

    def _note(self, phase: Phase, log: RunLog) -> None:
        """Keep the log of a phase, and whether the run has ended in it."""
        for name, last in phase.names:
            if last is not None:
                self._names.append((name, last))
                self.sample = last
        self.logs.append(log)
        self.ended |= not log.outcome.completed

    def _fail(self, status: str, message: str) -> None:
        self.failed = Outcome(status=status, time=0.0, message=message)

    def _joined(self) -> RunLog:
        """Return the log of all phases; NaN in the phases without a series."""
        logs = self.logs
        last, time_of = logs[-1], np.concatenate([log.time for log in logs])
        empty = {
            name: np.full_like(values[:1], np.nan)
            for log in logs[::-1]
            for name, values in log.series.items()
        }
        spent = {key: sum(log.wall_time[key] for log in logs) for key in last.wall_time}
        return dataclasses.replace(
            last,
            scenario=self._scenario,
            outcome=dataclasses.replace(self.failed or last.outcome, time=float(time_of[-1])),
            time=time_of,
            series={
                name: np.concatenate(
                    [log.series.get(name, gap.repeat(log.time.size, axis=0)) for log in logs]
                )
                for name, gap in empty.items()
            },
            parts={name: part for log in logs for name, part in log.parts.items()},
            wall_time={**spent, "total": time.perf_counter() - self._start},
        )

    def _legs(self, samples: int) -> tuple[tuple[str, int], ...]:
        """Return name and number of samples of the parts before a number of samples."""
        legs, first = list[tuple[str, int]](), 0
        for name, last in self._names:
            if (count := min(last, samples) - first) > 0:
                legs.append((name, count))
                first += count
        return tuple(legs)


def _along(motion: PlannedMotion, setup: BlockSetup) -> Diagram:
    """Return the reference of a motion."""
    return reference_from([motion], [], setup.coordinates, sample_time=setup.sample_time)
