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
from ffsm_drake.systems.sampled import Arrays, Sampled

COMPILED = "compiled"  # name of the engine


def laws_of(
    kernel: Kernel, runs: Sequence[Run], detectors: Sequence[tuple[Sampled, Arrays]] = ()
) -> Laws | None:
    """Return the laws and detectors of lanes that are called; None: there are none.

    Args: the code; the runs; of each lane its detector with its memory.
    """
    if not kernel.blocks.calls:
        return None
    return Laws(kernel.blocks, [run.controller for run in runs], detectors)


def planned_signals(case: Case) -> dict[str, np.ndarray]:
    """The signals that do not depend on a run."""
    desired = np.split(case.planned["reference"], [-len(case.coordinates.names)], axis=1)
    found = dict(zip(("desired_state", "desired_acceleration"), desired, strict=True))
    if "frame" in case.planned:
        found["desired_frame"] = case.planned["frame"]
    return found | case.shown


def engine_of(run: Run) -> str:
    """The name of the engine, and what is called."""
    detects = "fault detection called" if run.blocks.detector is not None else ""
    called = f"law called: {run.blocks.called}" if run.blocks.called else ""
    what = "; ".join(filter(None, (called, detects)))
    return f"{COMPILED} ({what})" if what else COMPILED


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
