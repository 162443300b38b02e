"""One function of machine code that runs simulations, as many at once as a register holds.

All numbers of its runs stand in one array (size, width): the cells (``Blocks``) one after another,
with a number of each run in a register. At every control sample it reads rows of each run
(reference, noise) and writes rows of its signals. Its last sample changes no state, so that a
further call can go on with it: a *leg* of a run is a call.
"""

import ctypes
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ffsm_drake.plugins.compiled.blocks import Blocks
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.compiling import registers
from ffsm_drake.plugins.compiled.module_text import RunsText, SampleText
from ffsm_drake.plugins.compiled.plans import Plans
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.runs.engine import NotCovered

# rows that runs may share, and that a supervisor's plan changes
_SHARED = {"reference", "frame", "phases", "request"}


class LaneState(NamedTuple):
    """Where the leg of a run begins or ends: just before a control sample."""

    cells: Mapping[str, np.ndarray]  # (n) by the names of ``Blocks.states``
    sample: int = 0  # of the run
    first_at: int = 0  # the sample that is a first one for the law


class LaneEnd(NamedTuple):
    """The end of a leg."""

    state: LaneState  # before the last sample, or the one at which the lane leaves
    log: Mapping[str, np.ndarray]  # signals (samples, size) by the names of ``Blocks.log``
    measured: np.ndarray  # (nq + nv) as the law would read it before the update of that sample
    # the last sample in the log of a run that leaves its bound, has a number that is not finite, or
    # a law whose call fails
    left: int | None


class Kernel:
    """The compiled simulations of a loop."""

    def __init__(self, blocks: Blocks, *, steps: int, key: str | None, alone: bool) -> None:
        """Args:
          blocks: the loop.
          steps: of the integrator in a control sample.
          key: of the code on disk; None: it may depend on a user's files.
          alone: for one run, without a register's other lanes; it has the same bits.

        Raises what tracing raises.
        """
        lanes = Registers(1) if alone else registers()
        self.blocks, self.width = blocks, lanes.width
        self._sizes = blocks.parameters | blocks.states
        text = RunsText(blocks, lanes, steps=steps)
        self.places, self.size, self.read = text.places, text.size, text.read
        self._code = text.code(f"runs of {self.width}", key)
        self.call = self._code.function("run", 2, ctypes.c_int64, *[ctypes.c_void_p] * 2)

    def cells_of(self, parameters: Mapping[str, np.ndarray], begin: LaneState) -> np.ndarray:
        """Return the numbers (size) of a lane that begins. Arguments: see ``leg``.

        Raises NotCovered: an array has another size than in this loop.
        """
        cells, given = np.zeros(self.size), {**parameters, **begin.cells}
        if self.blocks.per_sample == 1:  # the force of a leg before would act
            given.pop("touch", None)
        for name, values in given.items():
            if values.size != self._sizes[name]:
                raise NotCovered(f"{self._sizes[name]} numbers of {name} after {values.size}")
            first = self.places[name]
            cells[first : first + values.size] = values
        cells[self.places["number"]] = begin.sample
        cells[self.places["first_at"]] = begin.first_at
        return cells

    def leg(
        self,
        parameters: Sequence[Mapping[str, np.ndarray]],
        begin: Sequence[LaneState],
        rows: Sequence[Mapping[str, np.ndarray]],
        samples: int,
        *,
        signals: Collection[str] | None = None,
        laws: Laws | None = None,
        plans: Plans | None = None,
        ends: bool = False,
    ) -> list[LaneEnd]:
        """Go on by so many samples, with a lane for each run: at most ``width``.

        The sample after them belongs to the next leg. It is seen, not logged: with the noise of
        the sample before it, as Drake shows it before its update.

        Args:
          parameters: what each has, by the names of ``Blocks.parameters``.
          begin: where each begins.
          rows: what each reads, by the names of ``Blocks.row``: (n, size) for the samples of its
            run from the first one on.
          samples: at least one, unless it ``ends``.
          signals: those that are kept; None: all.
          laws: of the lanes, if they are called.
          plans: of their supervisors, if they have one.
          ends: the runs end with the last sample, which is logged. Raises NotCovered: a force that
            steps several times in a sample has signals.

        Raises what ends a call, such as KeyboardInterrupt.
        """
        if ends and self.blocks.late:
            raise NotCovered(f"{min(self.blocks.late)} at the end of a run")
        lanes = [*range(len(begin)), *[len(begin) - 1] * (self.width - len(begin))]
        cells = np.array([self.cells_of(parameters[lane], begin[lane]) for lane in lanes]).T.copy()
        sizes = {
            name: size
            for name, (*_, size) in self.blocks.log.items()
            if signals is None or name in signals
        }
        read = [self._read_from(rows[lane], begin[lane].sample, samples, ends) for lane in lanes]
        kept = [
            {name: np.empty((samples + 1, size)) for name, size in sizes.items()} for _ in lanes
        ]
        places = [[own[name].ctypes.data for own in read] for name in self.read]
        places += [
            [own[name].ctypes.data if name in own else 0 for own in kept]
            for name in self.blocks.log
        ]
        given = np.array(places, dtype=np.uint64)
        calls = [
            laws and laws.function(cells, self.places),
            plans and plans.function(cells, self.places, read, [each.sample for each in begin]),
        ]
        self.call(cells.ctypes.data, given.ctypes.data, samples, *calls)
        for each in (laws, plans):
            if each is not None and each.stopped is not None:
                raise each.stopped
        return [
            self._end(cells[:, lane], state, kept[lane], samples, ends=ends)
            for lane, state in enumerate(begin)
        ]

    def _read_from(
        self, rows: Mapping[str, np.ndarray], first: int, samples: int, ends: bool
    ) -> dict[str, np.ndarray]:
        """The rows of a leg."""
        read = {name: rows[name][first : first + samples + 1] for name in self.read}
        if self.blocks.watch is not None:  # which may change what is planned
            read |= {name: read[name].copy() for name in _SHARED & read.keys()}
        if "noise" in read and samples and not ends:
            read["noise"] = read["noise"].copy()
            read["noise"][-1] = read["noise"][-2]
        return read

    def _end(
        self,
        cells: np.ndarray,
        begin: LaneState,
        log: Mapping[str, np.ndarray],
        samples: int,
        *,
        ends: bool,
    ) -> LaneEnd:
        def own(name: str, size: int) -> np.ndarray:
            return cells[self.places[name] :][:size].copy()

        states = {name: own(name, size) for name, size in self.blocks.states.items()}
        last, count, left = begin.sample + samples, samples + ends, None
        if own("lost", 1)[0]:
            count = int(own("acted_on", 1)[0])
            last = left = begin.sample + count - 1
        rows = {name: values[:count] for name, values in log.items()}
        for name in self.blocks.late & log.keys():  # as they are before the next sample
            rows[name] = log[name][1 : count + 1]
        return LaneEnd(
            LaneState(states, last, begin.first_at),
            rows,
            own("measurement", self.blocks.results["measurement"]),
            left,
        )


class Step:
    """One control sample, the first excepted."""

    def __init__(self, blocks: Blocks, *, steps: int, key: str | None, slopes: bool) -> None:
        """Arguments and errors as of ``Kernel``, without forces that step several times; with
        ``slopes`` the sample has its derivatives along a direction in each lane, else it has one
        lane.
        """
        if blocks.per_sample > 1:
            raise NotTraceable("forces that step several times in a sample")
        lanes = registers() if slopes else Registers(1)
        self.width = lanes.width
        self._text = SampleText(blocks, lanes, steps=steps, slopes=slopes)
        self.places = self._text.places
        self._code = self._text.code("slopes" if slopes else "sample", key)
        self._run = self._code.function("run", 1)

    def cells(self) -> np.ndarray:
        """Room for all numbers of a sample (n, width): of a parameter, state, result or entry of
        the row at ``places``, its ``number``, and derivatives at ``d_NAME``.
        """
        return np.zeros((self._text.size, self.width))

    def run(self, cells: np.ndarray) -> None:
        """Change the states in the cells to those just before the next sample."""
        self._run(cells.ctypes.data)
