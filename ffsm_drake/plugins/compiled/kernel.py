"""One function of machine code that runs simulations, as many at once as a register holds.

All numbers of its runs stand in one array of cells, each a register wide. At every control sample
it reads rows of each run (reference, noise) and writes rows of its signals. Its last sample changes
no state, so that a further call can go on with it: a *leg* of a run is a call.
"""

import ctypes
import functools
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ffsm_drake.plugins.compiled.apart import apart
from ffsm_drake.plugins.compiled.blocks import COUNTS, Blocks
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.code import declarations
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.functions import Function, functions
from ffsm_drake.plugins.compiled.plans import Plans
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.systems.parts.placed import Parts

_BYTES = 8  # of a number
# rows that runs may share, and that a supervisor's plan changes
_SHARED = {"reference", "frame", "phases", "request"}
_ROWS = 32  # of the log, which the second-level cache holds


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
        self.parts: Parts = {}  # whose signals follow from the log
        text = _Runs(blocks, lanes, steps=steps)
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
        self._text = _Sample(blocks, lanes, steps=steps, slopes=slopes)
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


class _Text:
    """The LLVM text of a module."""

    _arguments: str  # of its function ``run``
    _begins = False  # with the first sample of a run

    def __init__(
        self, blocks: Blocks, registers: Registers, *, steps: int, slopes: bool = False
    ) -> None:
        self._blocks, self._registers, self._steps = blocks, registers, steps
        self._slopes = slopes
        self.places, self.size = dict[str, int](), 0
        changing = blocks.states | blocks.results | blocks.row | COUNTS
        self._place(blocks.parameters | changing)
        if slopes:
            self._place({f"d_{name}": size for name, size in changing.items()})

    def _place(self, sizes: Mapping[str, int]) -> None:
        for name, size in sizes.items():
            self.places[name] = self.size
            self.size += size

    def code(self, what: str, key: str | None) -> Code:
        """Return the compiled module. A user's law (without a key) is traced apart."""
        make = functools.partial(apart, self._module) if key is None else self._module
        return Code(make, key and f"{what} {key}", quickly=not self._begins)

    def _module(self) -> str:
        made = functions(
            self._blocks,
            self._registers,
            steps=self._steps,
            begins=self._begins,
            slopes=self._slopes,
        )
        lines = "\n".join((*self._entry(), *self._lines(made)))
        return "\n".join((
            *declarations(self._registers),
            *(each.text for each in made.values()),
            f"define void @run({self._arguments}) {{\n{lines}\n}}\n",
        ))  # fmt: skip

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """The lines of ``run``, after the places of the cells."""
        raise NotImplementedError

    def _entry(self) -> Iterator[str]:
        yield "entry:"
        for name, place in self.places.items():
            yield f"  %{name} = getelementptr {self._registers.reals}, ptr %cells, i64 {place}"

    def _moved(self, functions: Mapping[str, Function], before: str, after: str) -> Iterator[str]:
        """The integrator's steps to the next sample, as a block ``move`` between two others."""
        stages = len(SCHEMES[self._blocks.scheme].times)
        yield "move:"
        yield f"  %step.j = phi i64 [0, %{before}], [%following, %arrived]"
        yield self._call(functions, "instants")
        yield from self._touched(functions)
        for i in range(stages):
            names = {"state": "x" if i == 0 else "y", "t": f"t{i}", "rates": f"k{i}"}
            names |= {f"d_{name}": f"d_{cell}" for name, cell in names.items()}
            yield self._call(functions, "derivative", **names)
            yield self._call(functions, f"point{i}")
        yield "  %following = add i64 %step.j, 1"
        yield "  br label %arrived"
        yield "arrived:"
        yield f"  %more = icmp ult i64 %following, {self._steps}"
        yield f"  br i1 %more, label %move, label %{after}"

    def _touched(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """Forces that step several times in a sample, at the begin of a step."""
        if "touching" in functions:
            yield f"  %in_part = urem i64 %step.j, {self._steps // self._blocks.per_sample}"
            yield "  %touches = icmp eq i64 %in_part, 0"
            yield "  br i1 %touches, label %touching, label %untouched"
            yield "touching:"
            yield self._call(functions, "touching")
            yield "  br label %untouched"
            yield "untouched:"

    def _call(self, functions: Mapping[str, Function], name: str, **others: str) -> str:
        given = ", ".join(f"ptr %{others.get(each, each)}" for each in functions[name].arrays)
        return f"  call void @{name}({given})"

    def _copy(self, source: str, target: str, size: int) -> str:
        count = size * self._registers.width * _BYTES
        return (
            f"  call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {count}, i1 false)"
        )


class _Runs(_Text):
    """Runs with their logs, from a sample of each lane on.

    The addresses in ``places`` are those of each lane's arrays from this sample on: rows that it
    reads, and signals that it writes, unless the address is 0.
    """

    _arguments = "ptr noalias %cells, ptr noalias %places, i64 %last, ptr %call, ptr %plan"
    _begins = True

    def __init__(self, blocks: Blocks, registers: Registers, *, steps: int) -> None:
        super().__init__(blocks, registers, steps=steps)
        self.read = [name for name, size in blocks.row.items() if size]
        logged = _ROWS * sum(size for *_, size in blocks.log.values())
        self._place({"log": logged, "spare": sum(blocks.results.values())})

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        blocks, place = self._blocks, 0
        width = self._registers.width
        yield "  br label %begin"
        yield "begin:"
        yield "  %sample.k = phi i64 [0, %entry], [%next, %stepped]"
        for name in self.read:
            size = blocks.row[name]
            yield f"  %{name}.count = add i64 0, {size}"
            yield f"  %{name}.first = mul i64 %sample.k, {size}"
            yield from self._lanes(name, f"%{name}", place)
            place += width
        if blocks.called:
            calls = [self._call(functions, name) for name in ("instants", "sensed")]
            yield from self._asked(calls)
            yield "  %goes_on = call i64 %call(i64 %sample.k, ptr %cells)"
            yield "  %is_stopped = icmp eq i64 %goes_on, 0"
            yield "  br i1 %is_stopped, label %end, label %sampled"
            yield "sampled:"
            yield self._call(functions, "acted")
        else:
            yield from self._asked(self._sampled(functions))
        yield f"  %row = urem i64 %sample.k, {_ROWS}"
        yield from self._logged()
        yield self._call(functions, "judged")
        yield from self._lanes_with("lost")
        yield f"  %all_are_lost = icmp eq i{width} %lost.lanes, -1"
        yield "  %is_last = icmp eq i64 %sample.k, %last"
        yield "  %ends = or i1 %is_last, %all_are_lost"
        yield f"  %is_full = icmp eq i64 %row, {_ROWS - 1}"
        yield "  %is_due = or i1 %ends, %is_full"
        yield "  br i1 %is_due, label %write, label %onward"
        yield "write:"
        yield "  %rows = add i64 %row, 1"
        yield "  %first_row = sub i64 %sample.k, %row"
        for name, (*_, size) in blocks.log.items():
            yield f"  %log.{name}.count = mul i64 %rows, {size}"
            yield f"  %log.{name}.first = mul i64 %first_row, {size}"
            yield from self._lanes(f"log.{name}", f"%log.{name}.cells", place, back=True)
            place += width
        yield "  br i1 %ends, label %end, label %onward"
        yield "onward:"
        yield self._call(functions, "carried")
        yield "  br label %move"
        yield from self._moved(functions, "onward", "stepped")
        yield "stepped:"
        yield "  %next = add i64 %sample.k, 1"
        yield "  br label %begin"
        yield "end:"
        yield "  ret void"

    def _logged(self) -> Iterator[str]:
        """Copies of the signals, which are written to the lanes' arrays some samples at a time."""
        reals, place = self._registers.reals, 0
        for name, (cell, first, size) in self._blocks.log.items():
            target = f"%log.{name}"
            yield f"  {target}.cells = getelementptr {reals}, ptr %log, i64 {place}"
            yield f"  {target}.from = getelementptr {reals}, ptr %{cell}, i64 {first}"
            yield f"  {target}.offset = mul i64 %row, {size}"
            yield f"  {target}.to = getelementptr {reals}, ptr {target}.cells, i64 {target}.offset"
            yield self._copy(f"{target}.from", f"{target}.to", size)
            place += _ROWS * size

    def _sampled(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """A sample of lanes, some of which may be at their first."""
        size = sum(self._blocks.results.values())
        made = f"%{next(iter(self._blocks.results))}"
        yield self._call(functions, "instants")
        yield self._call(functions, "sample")
        yield from self._lanes_with("is_first")
        yield "  br i1 %is_first.any, label %first, label %sampled"
        yield "first:"
        yield self._copy(made, "%spare", size)
        yield self._call(functions, "first")
        yield from self._chosen(made, "%is_first.are", "%spare", size)
        yield "  br label %sampled"
        yield "sampled:"

    def _asked(self, sampling: Iterable[str]) -> Iterator[str]:
        """A sample, and once more after the answer if a supervisor asks for a plan."""
        if self._blocks.watch is None:
            yield from sampling
            return
        yield "  br label %sampling"
        yield "sampling:"
        yield from sampling
        yield from self._lanes_with("asks")
        yield "  br i1 %asks.any, label %ask, label %answered"
        yield "ask:"
        yield "  %answers = call i64 %plan(i64 %sample.k, ptr %cells)"
        yield "  %is_unanswered = icmp eq i64 %answers, 0"
        yield "  br i1 %is_unanswered, label %end, label %sampling"
        yield "answered:"

    def _lanes_with(self, cell: str) -> Iterator[str]:
        """The lanes in which a number is not zero: truths ``.are``, bits ``.lanes``, and whether
        there is ``.any``.
        """
        reals, width = self._registers.reals, self._registers.width
        yield f"  %{cell}.now = load {reals}, ptr %{cell}, align 8"
        yield f"  %{cell}.are = fcmp une {reals} %{cell}.now, zeroinitializer"
        yield f"  %{cell}.lanes = bitcast {self._registers.truths} %{cell}.are to i{width}"
        yield f"  %{cell}.any = icmp ne i{width} %{cell}.lanes, 0"

    def _chosen(self, cells: str, mask: str, others: str, size: int) -> Iterator[str]:
        """So many cells stay in the lanes of a mask, and become others in the rest, after the block
        ``first``.
        """
        reals, truths = self._registers.reals, self._registers.truths
        yield "  br label %choose"
        yield "choose:"
        yield "  %cell = phi i64 [0, %first], [%cell.next, %choose]"
        yield f"  %cell.at = getelementptr {reals}, ptr {cells}, i64 %cell"
        yield f"  %other.at = getelementptr {reals}, ptr {others}, i64 %cell"
        yield f"  %cell.own = load {reals}, ptr %cell.at, align 8"
        yield f"  %other.own = load {reals}, ptr %other.at, align 8"
        both = f"{reals} %cell.own, {reals} %other.own"
        yield f"  %cell.chosen = select {truths} {mask}, {both}"
        yield f"  store {reals} %cell.chosen, ptr %cell.at, align 8"
        yield "  %cell.next = add i64 %cell, 1"
        yield f"  %cell.more = icmp ult i64 %cell.next, {size}"
        yield "  br i1 %cell.more, label %choose, label %chosen"
        yield "chosen:"

    def _lanes(self, name: str, cells: str, place: int, *, back: bool = False) -> Iterator[str]:
        """Copy so many numbers (NAME.count) of each lane's array, from NAME.first on, into cells,
        or ``back`` unless it has the address 0; the addresses begin at a place.
        """
        width = self._registers.width
        for lane in range(width):
            yield f"  %{name}.place{lane} = getelementptr ptr, ptr %places, i64 {place + lane}"
            yield f"  %{name}.all{lane} = load ptr, ptr %{name}.place{lane}, align 8"
            array = f"ptr %{name}.all{lane}, i64 %{name}.first"
            yield f"  %{name}.array{lane} = getelementptr double, {array}"
        yield f"  %{name}.is_there = icmp ne ptr %{name}.all0, null"
        yield f"  br i1 %{name}.is_there, label %{name}.begin, label %{name}.end"
        yield f"{name}.begin:"
        yield f"  br label %{name}.each"
        yield f"{name}.each:"
        yield f"  %{name}.i = phi i64 [0, %{name}.begin], [%{name}.next, %{name}.each]"
        cell = f"getelementptr {self._registers.reals}, ptr {cells}, i64 %{name}.i"
        yield f"  %{name}.cell = {cell}"
        for lane in range(width):
            own, one, other = f"%{name}.own{lane}", f"%{name}.one{lane}", f"%{name}.at{lane}"
            yield f"  {own} = getelementptr double, ptr %{name}.array{lane}, i64 %{name}.i"
            yield f"  {other} = getelementptr double, ptr %{name}.cell, i64 {lane}"
            source, target = (other, own) if back else (own, other)
            yield f"  {one} = load double, ptr {source}, align 8"
            yield f"  store double {one}, ptr {target}, align 8"
        yield f"  %{name}.next = add i64 %{name}.i, 1"
        yield f"  %{name}.more = icmp ult i64 %{name}.next, %{name}.count"
        yield f"  br i1 %{name}.more, label %{name}.each, label %{name}.end"
        yield f"{name}.end:"


class _Sample(_Text):
    """One sample and the motion up to the next."""

    _arguments = "ptr noalias %cells"

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        for name in ("instants", "sample", "carried"):
            yield self._call(functions, name)
        yield "  br label %move"
        yield from self._moved(functions, "entry", "end")
        yield "end:"
        yield "  ret void"
