"""Runs of a scenario in machine code, some samples at a time, each with a seed and time of its own.

Between the samples, their law's memory can be read and written: an agent's actions, and what the
agent sees. A lane has the same bits whatever the others do.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.compiled.blocks import laid
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.kernel import Kernel, LaneState
from ffsm_drake.plugins.compiled.logs import engine_of, laws_of, log_of, planned_signals
from ffsm_drake.plugins.compiled.parts import sizes_of
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.runs.ending import COMPLETED, DIVERGED, Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.monitor import Monitor

_OF_ENDING = ("state", "hidden_state")


class Lanes:
    """``number`` runs. The law's signals of the last samples are in ``signals`` by name (number,
    samples + 1, size), for those that the law names as ``logged`` and for its force.
    """

    def __init__(self, kernel: Kernel, run: Run, number: int, samples: int) -> None:
        """Args: the compiled loop, one of the runs, their number, the most samples of a call."""
        self._kernel, self._run, self.number = kernel, run, number
        self.periods, self.engine = run.scenario.num_control_periods, engine_of(run)
        width, log = kernel.width, kernel.blocks.log
        shape = -(-number // width), width  # a register is full
        all_lanes = shape[0] * width
        self._cells = np.zeros((shape[0], kernel.size, width))
        wanted = ("generalized_force", *getattr(run.law, "logged", ()))
        sizes = {name: size for name, (*_, size) in log.items()}
        kept = {name: np.empty((all_lanes, samples + 1, sizes[name])) for name in wanted}
        self.signals = {name: values[:number] for name, values in kept.items()}
        self._series = {
            name: np.empty((all_lanes, run.case.samples, sizes[name]))
            for name in _OF_ENDING
            if name in log
        }
        self._written = [kept.get(name, self._series.get(name)) for name in log]
        row = kernel.blocks.row
        strides = [row[name] for name in kernel.read]
        strides += [sizes[name] if name in self._series else 0 for name in log]
        real = np.arange(all_lanes).reshape(shape) < number
        self._strides = (8 * np.array(strides)[None, :, None] * real[:, None, :]).astype(np.uint64)
        self._places = np.zeros(self._strides.shape, np.uint64)
        self._at_start = np.zeros((all_lanes, kernel.size))  # cells
        self._places_at_start = np.zeros((all_lanes, len(strides)), np.uint64)
        self._cases: list[Case] = [run.case] * all_lanes
        self._rows: list[Mapping[str, np.ndarray]] = [{}] * all_lanes  # what the addresses point to
        self._addresses = [
            (cells.ctypes.data, places.ctypes.data)
            for cells, places in zip(self._cells, self._places, strict=True)
        ]
        self._calls = self._laws(run, real.sum(axis=1).tolist())
        self._planned = run.rows.get("planned")
        for lane in range(number, all_lanes):
            self.begin(lane, 0)
        self.restart(np.arange(number, all_lanes))

    def _laws(self, run: Run, numbers: Sequence[int]) -> list[tuple[Laws | None, object]]:
        laws = [laws_of(self._kernel, [run] * each) for each in numbers]
        pairs = zip(laws, self._cells, strict=True)
        return [(each, each and each.function(cells, self._kernel.places)) for each, cells in pairs]

    def begin(self, lane: int, seed: int) -> None:
        """Give a lane a new run, which begins at ``restart``."""
        case = self._run.case.with_seed(seed)
        if (case.fixed, case.constants) != (self._run.case.fixed, self._run.case.constants):
            raise FfsmError(f"random_seed: {seed} gives the run other parts; use the engine drake")
        begin = LaneState(self._run.states | case.states)
        self._at_start[lane] = self._kernel.cells_of(self._run.parameters | case.parameters, begin)
        rows = case.rows if self._planned is None else case.rows | {"planned": self._planned}
        self._cases[lane], self._rows[lane] = case, rows
        arrays: list[np.ndarray | None] = [rows[name] for name in self._kernel.read]
        arrays += [None if each is None else each[lane] for each in self._written]
        self._places_at_start[lane] = [0 if each is None else each.ctypes.data for each in arrays]

    def restart(self, lanes: np.ndarray) -> None:
        """Put lanes (indices) at the start of their runs."""
        register, own = np.divmod(lanes, self._kernel.width)
        self._cells[register, :, own] = self._at_start[lanes]
        self._places[register, :, own] = self._places_at_start[lanes]

    def cell(self, name: str) -> np.ndarray:
        """A number of each lane (number), by its name among the kernel's places."""
        return self._cells[:, self._kernel.places[name]].reshape(-1)[: self.number]

    def remember(self, name: str, values: np.ndarray) -> None:
        """Set a part of the law's memory (number, n)."""
        _, place, _ = laid("memory", sizes_of(self._kernel.blocks.memory))[name]
        first = self._kernel.places["memory"] + place
        registers, _, width = self._cells.shape
        whole = np.zeros((registers * width, values.shape[1]))
        whole[: self.number] = values
        parts = whole.reshape(registers, width, -1).transpose(0, 2, 1)
        self._cells[:, first : first + values.shape[1]] = parts

    def advance(self, samples: int, lanes: np.ndarray) -> None:
        """Go on by so many samples, then see without acting.

        Args: at most the number of the constructor; and the lanes (number; bools) that need it:
          those beside them may go on, too. The others must be restarted.
        """
        places, width = self._kernel.places, self._kernel.width
        for name in ("acted_on", "lost"):
            self._cells[:, places[name]] = 0.0
        needed = np.logical_or.reduceat(lanes, np.arange(0, self.number, width))
        for register in np.flatnonzero(needed).tolist():
            laws, call = self._calls[register]
            self._kernel.call(*self._addresses[register], samples, call, None)
            if laws is not None and laws.stopped is not None:
                stopped, laws.stopped = laws.stopped, None
                raise stopped
        if samples:
            self._places += np.uint64(samples) * self._strides

    @property
    def lost(self) -> np.ndarray:
        """Whether each lane's run diverges in the last call (number), at the time ``seen_at``."""
        return self.cell("lost") != 0.0

    def log(self, lane: int, *, diverged: bool) -> RunLog:
        """The log of a lane's run that is over or has ``diverged``: its outcome, and the signals
        that its ending depends on.
        """
        case, run = self._cases[lane], self._run
        time = case.times[: self.periods + 1]
        series = {name: each[lane, : time.size].copy() for name, each in self._series.items()}
        series |= {name: each[: time.size] for name, each in planned_signals(case).items()}
        end = float(time[-1])
        outcome = Outcome(status=COMPLETED, time=end, message=f"completed {end:g} s")
        if diverged:
            outcome = self._divergence(lane)
        return log_of(run, series, outcome, time, case)

    def _divergence(self, lane: int) -> Outcome:
        time = float(self.cell("seen_at")[lane])
        register, own = divmod(lane, self._kernel.width)
        first = self._kernel.places["x"] + np.array(self._kernel.blocks.known)
        judge: Any = self._run
        monitor = Monitor(judge, None)
        if monitor.judge(time, self._cells[register, first, own]):
            row = max(int(self.cell("acted_on")[lane]) - 1, 0)
            monitor.judge_force(time, self.signals["generalized_force"][lane, row])
        return Outcome(
            status=DIVERGED, time=time, coordinate=monitor.coordinate, message=monitor.message
        )
