"""Runs of a kernel, and their logs."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ffsm_drake.common.plugins import service
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.kernel import Kernel, LaneEnd, LaneState
from ffsm_drake.plugins.compiled.models import posed_model
from ffsm_drake.plugins.compiled.run import Case, Run
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.log import RunLog
from ffsm_drake.systems.part import Parts

COMPILED = "compiled"  # name of the engine
_LEFT = "its fault detection isolates a unit, or it diverges"


class RunLane:
    """A run of one phase, as a lane of a kernel; see ``MissionLane``."""

    whole = None  # the scenario of a run in phases
    ends = True

    def __init__(
        self, run: Run, signals: Collection[str] | None = None, *, nudge: float = 1.0
    ) -> None:
        """Args: the run; the signals that its log needs, None: all; factor of its first state."""
        self.run, self.signals, self._waits = run, signals, True
        self.changes = {run.key}
        # what a run that is lost has for its log
        self.lost = None if run.case.detector is None else NotCovered(_LEFT)
        self.result: RunLog | NotCovered | None = self.lost
        self.samples = run.samples - 1
        self.begin = LaneState(run.states | {"x": run.states["x"] * nudge})

    def nudged(self, nudge: float) -> "RunLane":
        """The same with another first state."""
        return RunLane(self.run, nudge=nudge)

    def plan(self) -> bool:
        """Whether it begins now."""
        waits, self._waits = self._waits, False
        return waits

    def call_law(self, why: str) -> None:
        """Call the law, which is not traced for this reason."""
        self.run = self.run.with_called_law(why)

    def note(self, kernel: Kernel, end: LaneEnd, spent: Mapping[str, float]) -> None:
        """End the run. Args: the time spent to prepare and to run, s."""
        run, found = self.run, planned_signals(self.run.case)
        needed = found if self.signals is None else found.keys() & {*self.signals}
        series = {name: values.copy() for name, values in found.items() if name in needed}
        duration = self.samples * run.scenario.sample_time
        outcome = Outcome(status=COMPLETED, time=duration, message=f"completed {duration:g} s")
        times = run.case.times.copy()
        log = log_of(run, series | {**end.log}, outcome, times, kernel.parts)
        log = dataclasses.replace(log, wall_time={**spent, "total": sum(spent.values())})
        if run.scenario.grasps:
            log = service("grasped_at_start", "capture")(log)
        self.result = log


def laws_of(kernel: Kernel, runs: Sequence[Run]) -> Laws | None:
    """Return the laws of lanes; None: they are traced."""
    if not kernel.blocks.called:
        return None
    detectors = [each for run in runs for each in run.case.detectors()]
    return Laws(kernel.blocks, [run.controller for run in runs], detectors)


def planned_signals(case: Case) -> dict[str, np.ndarray]:
    """The signals that do not depend on a run."""
    desired = np.split(case.planned["reference"], [-len(case.coordinates.names)], axis=1)
    found = dict(zip(("desired_state", "desired_acceleration"), desired, strict=True))
    if "frame" in case.planned:
        found["desired_frame"] = case.planned["frame"]
    return found | case.shown


def engine_of(run: Run) -> str:
    """The name of the engine, and why the law is called."""
    return f"{COMPILED} (law called: {called})" if (called := run.blocks.called) else COMPILED


def log_of(
    run: Run, series: Mapping[str, np.ndarray], outcome: Outcome, time: np.ndarray, parts: Parts
) -> RunLog:
    """The log of a run, or of one with another seed."""
    return RunLog(
        scenario=run.scenario,
        outcome=outcome,
        coordinates=run.coordinates,
        split=run.case.true.split,
        tracks_frame=bool(getattr(run.law, "tracks_frame", False)),
        sliding_unit=str(run.law.sliding_unit),
        engine=engine_of(run),
        parts=parts,
        time=time,
        series=series,
        wall_time={},
        make_model=posed_model,
    )
