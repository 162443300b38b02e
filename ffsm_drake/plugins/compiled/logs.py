"""Runs of a kernel, and their logs."""

import dataclasses
import time
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from ffsm_drake.common.plugins import service
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.kernel import Kernel, LaneState
from ffsm_drake.plugins.compiled.models import posed_model
from ffsm_drake.plugins.compiled.plans import plans_of
from ffsm_drake.plugins.compiled.run import Case, Run
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.systems.part import Parts

COMPILED = "compiled"  # name of the engine


def logs_of(
    kernel: Kernel, runs: Sequence[Run], signals: Collection[str] | None = None
) -> list[RunLog | None]:
    """The logs of at most as many runs as a register holds; None: a run diverges.

    ``signals``: those that the logs need; None: all.
    """
    start = time.perf_counter()
    rows, laws = [run.rows for run in runs], laws_of(kernel, runs)
    began = time.perf_counter()
    found = kernel.leg(
        [run.parameters for run in runs],
        [LaneState(run.states) for run in runs],
        rows,
        runs[0].samples - 1,
        signals=signals,
        laws=laws,
        plans=plans_of(runs),
        ends=True,
    )
    ended = time.perf_counter()
    wall_time = {"build": began - start, "advance_to": ended - began, "total": ended - start}
    return [
        None
        if end.left is not None
        else _completed(run, {**_kept(run.case, signals), **end.log}, kernel.parts, wall_time)
        for run, end in zip(runs, found, strict=True)
    ]


def laws_of(kernel: Kernel, runs: Sequence[Run]) -> Laws | None:
    """Return the laws of lanes; None: they are traced."""
    if not kernel.blocks.called:
        return None
    detectors = [each for run in runs for each in run.case.detectors()]
    return Laws(kernel.blocks, [run.controller for run in runs], detectors)


def planned_signals(case: Case) -> dict[str, np.ndarray]:
    """The signals that do not depend on a run."""
    desired = np.split(case.planned["reference"], [-case.fixed["nv"]], axis=1)
    found = dict(zip(("desired_state", "desired_acceleration"), desired, strict=True))
    if "frame" in case.planned:
        found["desired_frame"] = case.planned["frame"]
    return found | case.shown


def _kept(case: Case, signals: Collection[str] | None) -> dict[str, np.ndarray]:
    found = planned_signals(case)
    needed = found if signals is None else found.keys() & {*signals}
    return {name: values.copy() for name, values in found.items() if name in needed}


def _completed(
    run: Run, series: Mapping[str, np.ndarray], parts: Parts, wall_time: dict[str, float]
) -> RunLog:
    duration = (run.samples - 1) * run.scenario.sample_time
    outcome = Outcome(status=COMPLETED, time=duration, message=f"completed {duration:g} s")
    time = run.case.times.copy()
    log = dataclasses.replace(log_of(run, series, outcome, time, parts), wall_time=wall_time)
    if not run.scenario.grasps:
        return log
    grasped: RunLog = service("grasped_at_start", "capture")(log)
    return grasped


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
