"""Runs of a kernel, and their logs."""

import time
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ffsm_drake.common.plugins import service
from ffsm_drake.plugins.compiled.kernel import Kernel, Signals
from ffsm_drake.plugins.compiled.run import Case, Run
from ffsm_drake.runs.ending import COMPLETED, Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.systems.part import Parts

COMPILED = "compiled"  # name of the engine


def logs_of(kernel: Kernel, runs: Sequence[Run]) -> list[RunLog | None]:
    """The logs of at most as many runs as a register holds; None: a run diverges."""
    start = time.perf_counter()
    lanes = [*runs, *[runs[-1]] * (kernel.width - len(runs))]
    given = {name: np.array([run.parameters[name] for run in lanes]) for name in runs[0].parameters}
    given |= {name: np.array([run.states[name] for run in lanes]) for name in runs[0].states}
    rows = [run.rows for run in lanes]
    began = time.perf_counter()
    signals = kernel.run(given, rows)
    ended = time.perf_counter()
    wall_time = {"build": began - start, "advance_to": ended - began, "total": ended - start}
    finite, state = signals.are_finite(), signals["state"]
    return [
        _log(run, _Series(signals, lane, run.case), parts=kernel.parts, wall_time=wall_time)
        if finite[lane] and _is_within(run, state[lane])
        else None
        for lane, run in enumerate(runs)
    ]


def _is_within(run: Run, state: np.ndarray) -> bool:
    """Whether a run with states (samples, nq + nv) keeps its bound of velocity."""
    return bool(np.abs(state[:, run.blocks.nq :]).max() <= run.scenario.divergence_speed)


class _Series(Mapping[str, np.ndarray]):
    """The signals of a run, copied when they are read first."""

    def __init__(self, signals: Signals, lane: int, case: Case) -> None:
        self._signals, self._lane, self._case = signals, lane, case
        self._names = [*signals.places, "desired_state", "desired_acceleration"]
        if case.fixed["framed"]:
            self._names.append("desired_frame")
        self._found = dict[str, np.ndarray]()

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._found:
            self._found[name] = self._copied(name)
        return self._found[name]

    def _copied(self, name: str) -> np.ndarray:
        if name in self._signals.places:
            return self._signals[name][self._lane].copy()
        if name not in self._names:
            raise KeyError(name)
        case, nv = self._case, self._case.fixed["nv"]
        if name == "desired_frame":
            return case.planned["frame"].copy()
        return np.split(case.planned["reference"], [-nv], axis=1)[
            name == "desired_acceleration"
        ].copy()

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _log(
    run: Run,
    series: Mapping[str, np.ndarray],
    *,
    parts: Parts,
    wall_time: dict[str, float],
) -> RunLog:
    scenario, duration = run.scenario, (run.samples - 1) * run.scenario.sample_time
    log = RunLog(
        scenario=scenario,
        outcome=Outcome(status=COMPLETED, time=duration, message=f"completed {duration:g} s"),
        coordinates=run.coordinates,
        split=run.case.true.split,
        tracks_frame=bool(getattr(run.law, "tracks_frame", False)),
        sliding_unit=str(run.law.sliding_unit),
        engine=COMPILED,
        parts=parts,
        time=run.case.times.copy(),
        series=series,
        wall_time=wall_time,
    )
    if not scenario.grasps:
        return log
    grasped: RunLog = service("grasped_at_start", "capture")(log)
    return grasped
