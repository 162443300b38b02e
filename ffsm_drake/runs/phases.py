"""Phases of a mission as data, and the runner that goes through them with one log.

A phase gives the loop (reference, held bodies, law), the state at its start, the sample at its end
and the next phase. Runs side by side go through the same phases.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import BlockError
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.ending import Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import Leg, Rollout
from ffsm_drake.scenario import Scenario

Begin = Callable[[ClosedLoop, Context], None]
Progress = Callable[[float, float], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Phase:
    """A part of a mission that one loop runs through."""

    loop: Rollout
    # names of its samples in the record, in turn, with the sample before which each ends; None: the
    # end of the run
    names: tuple[tuple[str, int | None], ...]
    begin: Begin  # sets the initialized loop to where the phase begins
    scenarios: Sequence[Scenario] | None = None  # scenarios of the loop; None: those of its build
    next: Callable[[], "Phase | None"] = lambda: None  # called where not all runs have ended


class Mission:
    """Runs that go through phases, side by side or one alone.

    ``before`` is the loop of the last phase and ``context`` its context at the end, ``sample`` the
    first one of the next phase, ``ended`` holds the finished runs.
    """

    before: ClosedLoop
    context: Context

    def __init__(self, scenarios: Sequence[Scenario], progress: Progress | None = None) -> None:
        """Args: scenario of each run, as its log shall have it; progress, see ``Rollout.run``."""
        self._scenarios, self._progress = list(scenarios), progress
        self._start, self.sample = time.perf_counter(), 0
        self._names: list[tuple[str, int]] = []  # phases with an end, and the sample after it
        self.logs: list[list[RunLog]] = [[] for _ in scenarios]
        self.failed: dict[int, Outcome] = {}  # outcomes of runs that failed between two phases
        self.ended: set[int] = set()
        self._lost: set[int] = set()  # runs without a log
        self._own: list[Rollout] = []  # loops of this mission alone

    def run(self, phase: Phase | None) -> list[RunLog | None]:
        """Run through a phase and its successors: a log for each run, None for one to run alone.

        Errors as ``Rollout.run`` and ``Rollout.run_all`` raise them.
        """
        try:
            while phase is not None:
                self._note(phase, self._through(phase))
                phase = phase.next() if len(self.ended) < len(self.logs) else None
        except BlockError as error:
            if error.log is not None and phase is not None:
                self._note(phase, [error.log])
                error.log = self._joined(0)
            raise
        finally:
            for loop in self._own:
                loop.release()
        copies = range(len(self.logs))
        return [None if copy in self._lost else self._joined(copy) for copy in copies]

    def _loop(self, scenario: Scenario, **how: Any) -> Rollout:
        """A loop, released at the end of the run; arguments: see ``Rollout``."""
        self._own.append(Rollout(scenario, **how))
        return self._own[-1]

    def go_on(self, loop: ClosedLoop, root_context: Context, *afresh: str) -> None:
        """Put a loop, but for the blocks ``afresh``, where the last phase ended."""
        loop.set_whole_states(root_context, self.before.whole_states(self.context))
        loop.resume(root_context, self.before, self.context, afresh=afresh)

    def _through(self, phase: Phase) -> Sequence[RunLog | None]:
        last = phase.names[-1][1]
        leg = Leg(first=self.sample, last=last, begin=phase.begin, end=self._keep)
        given = phase.scenarios
        if len(self.logs) > 1:
            return phase.loop.run_all(given, leg=leg, without=self.ended)
        return [phase.loop.run(given[0] if given else None, progress=self._progress, leg=leg)]

    def _keep(self, loop: ClosedLoop, root_context: Context) -> None:
        self.before, self.context = loop, root_context

    def _note(self, phase: Phase, logs: Sequence[RunLog | None]) -> None:
        """Keep the logs of a phase, and which runs have ended in it."""
        for name, last in phase.names:
            if last is not None:
                self._names.append((name, last))
                self.sample = last
        for copy, log in enumerate(logs):
            if copy in self.ended:
                continue
            if log is None:
                self._lost.add(copy)
            else:
                self.logs[copy].append(log)
            if log is None or not log.outcome.completed:
                self.ended.add(copy)

    def _fail(self, copy: int, status: str, message: str) -> None:
        self.failed[copy] = Outcome(status=status, time=0.0, message=message)

    def _joined(self, copy: int) -> RunLog:
        """The log of all phases of a run; NaN in the phases without a series."""
        logs = self.logs[copy]
        last, time_of = logs[-1], np.concatenate([log.time for log in logs])
        empty = {
            name: np.full_like(values[:1], np.nan)
            for log in logs[::-1]
            for name, values in log.series.items()
        }
        spent = {key: sum(log.wall_time[key] for log in logs) for key in last.wall_time}
        return dataclasses.replace(
            last,
            scenario=self._scenarios[copy],
            outcome=dataclasses.replace(
                self.failed.get(copy, last.outcome), time=float(time_of[-1])
            ),
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
        """Name and number of samples of the parts before a number of samples."""
        legs, first = list[tuple[str, int]](), 0
        for name, last in self._names:
            if (count := min(last, samples) - first) > 0:
                legs.append((name, count))
                first += count
        return tuple(legs)
