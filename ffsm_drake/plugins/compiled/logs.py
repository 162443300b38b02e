"""Logs of runs of a kernel."""

from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.kernel import Kernel
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.runs.ending import Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.systems.parts.placed import Parts, place_part

COMPILED = "compiled"  # name of the engine


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
    run: Run, series: Mapping[str, np.ndarray], outcome: Outcome, time: np.ndarray, case: Case
) -> RunLog:
    """The log of a run, or of one with another seed, which has the ``case``."""
    return RunLog(
        mission=run.mission,
        outcome=outcome,
        tracks_frame=run.law.tracks_frame,
        sliding_unit=str(run.law.sliding_unit),
        engine=engine_of(run),
        parts=_parts_of(run, case),
        time=time,
        series=series,
        wall_time={},
        own_model=run.posed_model,
    )


def _parts_of(run: Run, case: Case) -> Parts:
    """The parts of the scenario, and that of the law if it has one."""
    part = run.controller.part
    if part is None:
        return case.made.placed
    setup = case.made.setup("controller")
    name = "controller"
    law = place_part(part, setup, run.controller, name=name, block=name)
    return {**case.made.placed, name: law}
