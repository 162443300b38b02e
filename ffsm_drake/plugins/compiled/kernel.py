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
from ffsm_drake.plugins.compiled.blocks import CARRIED, TOUCHED, Blocks
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.code import declarations
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.functions import Function, functions
from ffsm_drake.plugins.compiled.plans import Plans
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.systems.part import Parts
from ffsm_drake.tape.numbers import NotTraceable

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
        cells[self.places["begun"]] = begin.sample
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
        kept = [_arrays(sizes, samples + 1) for _ in lanes]
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
        if own("lost", 1).view(np.int64)[0]:
            states["x"][0] = own("x_before", 1)[0]
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


def _arrays(sizes: Mapping[str, int], samples: int) -> dict[str, np.ndarray]:
    """Arrays (samples, size) by name, in one piece of memory."""
    whole, found = np.empty(samples * sum(sizes.values())), dict[str, np.ndarray]()
    for name, size in sizes.items():
        found[name], whole = whole[: samples * size].reshape(samples, size), whole[samples * size :]
    return found


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
        self._run = self._code.function("run", 2, ctypes.c_double)

    def cells(self) -> np.ndarray:
        """Room for all numbers of a sample (n, width): of a parameter, state, result or entry of
        the row at ``places``, and their derivatives at ``d_NAME``.
        """
        return np.zeros((self._text.size, self.width))

    def run(self, cells: np.ndarray, row: np.ndarray, time: float) -> None:
        """Change the states in the cells to those just before the next sample.

        Args:
          cells: see ``cells``.
          row: of the sample (n, width), see ``Blocks.row``.
          time: s.
        """
        self._run(cells.ctypes.data, row.ctypes.data, time)


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
        changing = blocks.states | blocks.results
        if slopes:
            changing |= {f"d_{name}": size for name, size in (changing | blocks.row).items()}
        for name, size in (blocks.parameters | changing).items():
            self.places[name] = self.size
            self.size += size
        self._count = 0

    def code(self, what: str, key: str | None) -> Code:
        """Return the compiled module. A user's law (without a key) is traced apart."""
        make = functools.partial(apart, self._module) if key is None else self._module
        return Code(make, key and f"{what} {key}", quickly=not self._begins)

    def _module(self) -> str:
        made = functions(self._blocks, self._registers, begins=self._begins, slopes=self._slopes)
        lines = "\n".join((*self._entry(), *self._lines(made)))
        return "\n".join((
            *declarations(self._registers),
            "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)",
            *(each.text for each in made.values()),
            f"define void @run({self._arguments}) {{\n{lines}\n}}\n",
        ))  # fmt: skip

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """The lines of ``run``, after the places of the cells."""
        raise NotImplementedError

    def _new(self) -> str:
        self._count += 1
        return f"%n{self._count}"

    def _entry(self) -> Iterator[str]:
        yield "entry:"
        for name, place in self.places.items():
            yield f"  %{name} = getelementptr {self._registers.reals}, ptr %cells, i64 {place}"
        for name in ("sample_time", "step"):
            yield f"  %the_{name} = load double, ptr %{name}, align 8"

    def _row(self, first: str) -> Iterator[str]:
        """The places of a row's entries."""
        place = 0
        for name, size in self._blocks.row.items():
            yield f"  %{name} = getelementptr {self._registers.reals}, ptr {first}, i64 {place}"
            place += size

    def _kept(self) -> Iterator[str]:
        """Copies of what a sample makes to the states."""
        states = self._blocks.states
        for prefix in ("", "d_") if self._slopes else ("",):
            for name, after in CARRIED.items():
                yield self._copy(f"%{prefix}{after}", f"%{prefix}{name}", states[name])

    def _moved(self, functions: Mapping[str, Function], before: str, after: str) -> Iterator[str]:
        """The integrator's steps from ``%times`` to the next sample, as a block ``move`` between
        two others.
        """
        scheme = SCHEMES[self._blocks.scheme]
        yield "move:"
        yield f"  %j = phi i64 [0, %{before}], [%following, %arrived]"
        yield "  %within = uitofp i64 %j to double"
        yield "  %shift = fmul double %within, %the_step"
        yield from self._after("%times", "%shift", "%start")
        for i, time in enumerate(scheme.times):
            later, at = self._new(), self._new()
            yield f"  {later} = fmul double %the_step, {_number(time)}"
            yield from self._after("%start", later, at)
            yield f"  store {self._registers.reals} {at}, ptr %t{i}, align 8"
        yield from self._touched(functions)
        for i, _ in enumerate(scheme.times):
            names = {"state": "x" if i == 0 else "y", "t": f"t{i}", "rates": f"k{i}"}
            names |= {f"d_{name}": f"d_{cell}" for name, cell in names.items()}
            yield self._call(functions, "derivative", **names)
            yield self._call(functions, f"point{i}")
        yield "  %following = add i64 %j, 1"
        yield from self._arrived()
        yield "  br label %arrived"
        yield "arrived:"
        yield f"  %more = icmp ult i64 %following, {self._steps}"
        yield f"  br i1 %more, label %move, label %{after}"

    def _touched(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """Forces that step several times in a sample, at the begin of a step."""
        yield from ()

    def _arrived(self) -> Iterator[str]:
        """The end of a step."""
        for prefix in ("", "d_") if self._slopes else ("",):
            yield self._copy(f"%{prefix}y", f"%{prefix}x", self._blocks.states["x"])

    def _call(self, functions: Mapping[str, Function], name: str, **others: str) -> str:
        given = ", ".join(f"ptr %{others.get(each, each)}" for each in functions[name].arrays)
        return f"  call void @{name}({given})"

    def _copy(self, source: str, target: str, size: int) -> str:
        count = size * self._registers.width * _BYTES
        return (
            f"  call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {count}, i1 false)"
        )

    def _spread(self, value: str, target: str) -> Iterator[str]:
        """A number in every lane."""
        reals, one = self._registers.reals, self._new()
        mask = f"<{self._registers.width} x i32> zeroinitializer"
        yield f"  {one} = insertelement {reals} poison, double {value}, i64 0"
        yield f"  {target} = shufflevector {reals} {one}, {reals} poison, {mask}"

    def _after(self, times: str, span: str, target: str) -> Iterator[str]:
        """Each lane's time after a span."""
        spans = self._new()
        yield from self._spread(span, spans)
        yield f"  {target} = fadd {self._registers.reals} {times}, {spans}"


class _Runs(_Text):
    """Runs with their logs, from a sample of each lane on.

    The addresses in ``places`` are those of each lane's arrays from this sample on: rows that it
    reads, and signals that it writes, unless the address is 0. A lane is ``lost`` if it leaves its
    bound, or a number is not finite; its states and time ``seen_at`` then stay, with the first
    number of ``x`` at ``x_before``.
    """

    _arguments = "ptr noalias %cells, ptr noalias %places, i64 %last, ptr %call, ptr %plan"
    _begins = True

    def __init__(self, blocks: Blocks, registers: Registers, *, steps: int) -> None:
        super().__init__(blocks, registers, steps=steps)
        self.read = [name for name, size in blocks.row.items() if size]
        logged = _ROWS * sum(size for *_, size in blocks.log.values())
        # ``lost`` has bits as soon as a lane is; ``begun`` and ``acted_on`` count samples, before
        # the first one and with an action of the law; ``first_at`` is the law's first one
        names = ("lost", "begun", "first_at", "acted_on", "seen_at", "x_before")
        own = dict.fromkeys(names, 1)
        own |= {"log": logged, "spare": sum(blocks.results.values())}
        for name, size in (blocks.row | own).items():
            self.places[name] = self.size
            self.size += size

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        blocks, width, place = self._blocks, self._registers.width, 0
        reals = self._registers.reals
        yield f"  %before = load {reals}, ptr %begun, align 8"
        yield from self._spread("%the_sample_time", "%sample_times")
        yield "  br label %begin"
        yield "begin:"
        yield "  %k = phi i64 [0, %entry], [%next, %stepped]"
        for name in self.read:
            size = blocks.row[name]
            yield f"  %{name}.count = add i64 0, {size}"
            yield f"  %{name}.first = mul i64 %k, {size}"
            yield from self._lanes(name, f"%{name}", place)
            place += width
        yield "  %sample = uitofp i64 %k to double"
        yield from self._after("%before", "%sample", "%passed")
        yield f"  %times = fmul {reals} %passed, %sample_times"
        yield f"  store {reals} %times, ptr %t0, align 8"
        if blocks.called:
            yield from self._asked([self._call(functions, "sensed")])
            yield "  %goes_on = call i64 %call(i64 %k, ptr %cells)"
            yield "  %is_stopped = icmp eq i64 %goes_on, 0"
            yield "  br i1 %is_stopped, label %end, label %sampled"
            yield "sampled:"
            yield self._call(functions, "acted")
        else:
            yield from self._asked(self._sampled(functions))
        yield f"  %row = urem i64 %k, {_ROWS}"
        yield from self._logged()
        yield from self._lost()
        yield "  %is_last = icmp eq i64 %k, %last"
        yield "  %ends = or i1 %is_last, %no_lane"
        yield f"  %is_full = icmp eq i64 %row, {_ROWS - 1}"
        yield "  %is_due = or i1 %ends, %is_full"
        yield "  br i1 %is_due, label %write, label %onward"
        yield "write:"
        yield "  %rows = add i64 %row, 1"
        yield "  %first_row = sub i64 %k, %row"
        for name, (*_, size) in blocks.log.items():
            yield f"  %log.{name}.count = mul i64 %rows, {size}"
            yield f"  %log.{name}.first = mul i64 %first_row, {size}"
            yield from self._lanes(f"log.{name}", f"%log.{name}.cells", place, back=True)
            place += width
        yield "  br i1 %ends, label %end, label %onward"
        yield "onward:"
        yield from self._stopped()
        yield f"  %any_is_lost = icmp ne i{width} %lanes, 0"
        yield from self._carried("kept", CARRIED, "%are_lost", "%any_is_lost")
        yield "  br label %move"
        yield from self._moved(functions, "kept.end", "stepped")
        yield "stepped:"
        yield "  %next = add i64 %k, 1"
        yield "  br label %begin"
        yield "end:"
        yield "  ret void"

    def _logged(self) -> Iterator[str]:
        """Copies of the signals, which are written to the lanes' arrays some samples at a time."""
        reals, place = self._registers.reals, 0
        for name, (cell, first, size) in self._blocks.log.items():
            source, offset, target = self._new(), self._new(), self._new()
            yield f"  %log.{name}.cells = getelementptr {reals}, ptr %log, i64 {place}"
            yield f"  {source} = getelementptr {reals}, ptr %{cell}, i64 {first}"
            yield f"  {offset} = mul i64 %row, {size}"
            yield f"  {target} = getelementptr {reals}, ptr %log.{name}.cells, i64 {offset}"
            yield self._copy(source, target, size)
            place += _ROWS * size

    def _sampled(self, functions: Mapping[str, Function]) -> Iterator[str]:
        """A sample of lanes, some of which may be at their first."""
        reals, truths, width = self._registers.reals, self._registers.truths, self._registers.width
        size = sum(self._blocks.results.values())
        made = f"%{next(iter(self._blocks.results))}"
        yield f"  %first_at.samples = load {reals}, ptr %first_at, align 8"
        begins = "%are_first"
        if self._blocks.watch is not None:
            begins = "%are_begun"
            yield f"  %restart = load {reals}, ptr %watched, align 8"
            yield f"  %are_afresh = fcmp une {reals} %restart, zeroinitializer"
        yield f"  {begins} = fcmp oeq {reals} %passed, %first_at.samples"
        if self._blocks.watch is not None:
            yield f"  %are_first = or {truths} %are_begun, %are_afresh"
        yield f"  %first.lanes = bitcast {truths} %are_first to i{width}"
        yield f"  %none_is = icmp eq i{width} %first.lanes, 0"
        yield "  br i1 %none_is, label %later, label %first"
        yield "first:"
        yield self._call(functions, "first")
        yield f"  %all_are = icmp eq i{width} %first.lanes, -1"
        yield "  br i1 %all_are, label %sampled, label %both"
        yield "both:"
        yield self._copy(made, "%spare", size)
        yield self._call(functions, "sample")
        yield from self._chosen("both", made, "%are_first", "%spare", made, size)
        yield "  br label %sampled"
        yield "later:"
        yield self._call(functions, "sample")
        yield "  br label %sampled"
        yield "sampled:"

    def _asked(self, sampling: Iterable[str]) -> Iterator[str]:
        """A sample, and once more after the answer if a supervisor asks for a plan."""
        if self._blocks.watch is None:
            yield from sampling
            return
        wholes, width = self._registers.wholes, self._registers.width
        yield "  br label %sampling"
        yield "sampling:"
        yield from sampling
        yield f"  %asks.now = load {wholes}, ptr %asks, align 8"
        yield f"  %are_asking = icmp ne {wholes} %asks.now, zeroinitializer"
        yield f"  %asking.lanes = bitcast {self._registers.truths} %are_asking to i{width}"
        yield f"  %none_asks = icmp eq i{width} %asking.lanes, 0"
        yield "  br i1 %none_asks, label %answered, label %ask"
        yield "ask:"
        yield "  %answers = call i64 %plan(i64 %k, ptr %cells)"
        yield "  %is_unanswered = icmp eq i64 %answers, 0"
        yield "  br i1 %is_unanswered, label %end, label %sampling"
        yield "answered:"

    def _chosen(
        self, before: str, target: str, mask: str, then: str, otherwise: str, size: int
    ) -> Iterator[str]:
        """So many cells from one place for the lanes of a mask, for the others from another."""
        reals, truths, name = self._registers.reals, self._registers.truths, f"%{before}"
        yield f"  br label {name}.each"
        yield f"{before}.each:"
        yield f"  {name}.i = phi i64 [0, {name}], [{name}.next, {name}.each]"
        for i, place in enumerate((then, otherwise, target)):
            yield f"  {name}.at{i} = getelementptr {reals}, ptr {place}, i64 {name}.i"
        for i in range(2):
            yield f"  {name}.own{i} = load {reals}, ptr {name}.at{i}, align 8"
        both = f"{reals} {name}.own0, {reals} {name}.own1"
        yield f"  {name}.one = select {truths} {mask}, {both}"
        yield f"  store {reals} {name}.one, ptr {name}.at2, align 8"
        yield f"  {name}.next = add i64 {name}.i, 1"
        yield f"  {name}.more = icmp ult i64 {name}.next, {size}"
        yield f"  br i1 {name}.more, label {name}.each, label {name}.end"
        yield f"{before}.end:"

    def _lost(self) -> Iterator[str]:
        """The lanes with a velocity beyond the bound, or a number that is not finite: it minus
        itself is not zero.
        """
        reals, wholes, width = self._registers.reals, self._registers.wholes, self._registers.width
        yield from self._bounded("%times")
        yield f"  %goes = icmp eq {wholes} %lost.before, zeroinitializer"
        yield f"  %one_more = uitofp {self._registers.truths} %goes to {reals}"
        yield f"  %acted_on.before = load {reals}, ptr %acted_on, align 8"
        yield f"  %acted_on.now = fadd {reals} %acted_on.before, %one_more"
        yield f"  store {reals} %acted_on.now, ptr %acted_on, align 8"
        lost = "%beyond"
        for cell, first, size in self._blocks.log.values():
            for entry in range(first, first + size):
                value, rest, bits, more = (self._new() for _ in range(4))
                yield from self._loaded(cell, entry, value)
                yield f"  {rest} = fsub {reals} {value}, {value}"
                yield f"  {bits} = bitcast {reals} {rest} to {wholes}"
                yield f"  {more} = or {wholes} {lost}, {bits}"
                lost = more
        yield f"  store {wholes} {lost}, ptr %lost, align 8"
        yield f"  %are_lost = icmp ne {wholes} {lost}, zeroinitializer"
        yield f"  %lanes = bitcast {self._registers.truths} %are_lost to i{width}"
        yield f"  %no_lane = icmp eq i{width} %lanes, -1"

    def _stopped(self) -> Iterator[str]:
        """The ``x`` of lost lanes is no number from then on, so that they ask for no loops."""
        reals, wholes, truths = (
            self._registers.reals, self._registers.wholes, self._registers.truths,
        )  # fmt: skip
        yield f"  %lost.now = load {wholes}, ptr %lost, align 8"
        yield f"  %x.now = load {reals}, ptr %x, align 8"
        yield f"  %x.then = load {reals}, ptr %x_before, align 8"
        yield f"  %x.is_none = fcmp uno {reals} %x.now, %x.now"
        yield f"  %x.last = select {truths} %x.is_none, {reals} %x.then, {reals} %x.now"
        yield f"  store {reals} %x.last, ptr %x_before, align 8"
        yield f"  %x.bits = bitcast {reals} %x.now to {wholes}"
        yield f"  %x.after = or {wholes} %x.bits, %lost.now"
        yield f"  store {wholes} %x.after, ptr %x, align 8"

    def _carried(
        self, label: str, states: Mapping[str, str], mask: str, some: str
    ) -> Iterator[str]:
        """Copies to states, except to those of the lanes of a mask; ``some``: whether it has any.
        At its end, the block is ``LABEL.end``.
        """
        sizes = {name: size for name in states if (size := self._blocks.states[name])}
        yield f"  br i1 {some}, label %{label}.some, label %{label}.all"
        yield f"{label}.some:"
        for name, size in sizes.items():
            at, own, other = f"{label}.{name}", f"%{name}", f"%{states[name]}"
            yield f"  br label %{at}"
            yield f"{at}:"
            yield from self._chosen(at, own, mask, own, other, size)
        yield f"  br label %{label}.end"
        yield f"{label}.all:"
        for name, size in sizes.items():
            yield self._copy(f"%{states[name]}", f"%{name}", size)
        yield f"  br label %{label}.end"
        yield f"{label}.end:"

    def _touched(self, functions: Mapping[str, Function]) -> Iterator[str]:
        if "touching" not in functions:
            return
        width, wholes = self._registers.width, self._registers.wholes
        yield f"  %in_part = urem i64 %j, {self._steps // self._blocks.per_sample}"
        yield "  %touches = icmp eq i64 %in_part, 0"
        yield "  br i1 %touches, label %touching, label %untouched"
        yield "touching:"
        yield self._call(functions, "touching")
        yield f"  %touch.lost = load {wholes}, ptr %lost, align 8"
        yield f"  %touch.out = icmp ne {wholes} %touch.lost, zeroinitializer"
        yield f"  %touch.lanes = bitcast {self._registers.truths} %touch.out to i{width}"
        yield f"  %touch.some = icmp ne i{width} %touch.lanes, 0"
        yield from self._carried("touched", TOUCHED, "%touch.out", "%touch.some")
        yield "  br label %untouched"
        yield "untouched:"

    def _bounded(self, times: str, prefix: str = "") -> Iterator[str]:
        """The lost lanes at ``x``, as ``%beyond``, and the times at which the others are seen."""
        reals, wholes, width = self._registers.reals, self._registers.wholes, self._registers.width
        name, lost = f"%{prefix}", f"%{prefix}lost.before"
        yield f"  {name}bounds = load {reals}, ptr %bound, align 8"
        yield f"  {lost} = load {wholes}, ptr %lost, align 8"
        yield f"  {name}are_out = icmp ne {wholes} {lost}, zeroinitializer"
        yield f"  {name}at = load {reals}, ptr %seen_at, align 8"
        chosen = f"{reals} {name}at, {reals} {times}"
        yield f"  {name}at.now = select {self._registers.truths} {name}are_out, {chosen}"
        yield f"  store {reals} {name}at.now, ptr %seen_at, align 8"
        velocities = self._blocks.known[self._blocks.nq :]
        for i, entry in enumerate(velocities):
            value, speed, beyond, mask = (self._new() for _ in range(4))
            more = f"{name}beyond" if i == len(velocities) - 1 else self._new()
            yield from self._loaded("x", entry, value)
            yield f"  {speed} = call {reals} @llvm.fabs.v{width}f64({reals} {value})"
            yield f"  {beyond} = fcmp ugt {reals} {speed}, {name}bounds"
            yield f"  {mask} = sext {self._registers.truths} {beyond} to {wholes}"
            yield f"  {more} = or {wholes} {lost}, {mask}"
            lost = more

    def _loaded(self, cell: str, entry: int, target: str) -> Iterator[str]:
        reals, at = self._registers.reals, self._new()
        yield f"  {at} = getelementptr {reals}, ptr %{cell}, i64 {entry}"
        yield f"  {target} = load {reals}, ptr {at}, align 8"

    def _arrived(self) -> Iterator[str]:
        wholes = self._registers.wholes
        yield f"  %frozen = load {wholes}, ptr %lost, align 8"
        yield f"  %are_frozen = icmp ne {wholes} %frozen, zeroinitializer"
        yield "  br label %arrive"
        yield "arrive:"
        yield from self._chosen("arrive", "%x", "%are_frozen", "%x", "%y", self._blocks.states["x"])
        if self._steps > 1:  # Drake looks after every step; the next sample after the last one
            yield "  %passed_by = uitofp i64 %following to double"
            yield "  %until = fmul double %passed_by, %the_step"
            yield from self._after("%times", "%until", "%step.ends")
            yield from self._bounded("%step.ends", "step.")
            yield f"  %is_within = icmp ult i64 %following, {self._steps}"
            lost = f"{wholes} %step.beyond, {wholes} %frozen"
            yield f"  %step.lost = select i1 %is_within, {lost}"
            yield f"  store {wholes} %step.lost, ptr %lost, align 8"

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

    _arguments = "ptr noalias %cells, ptr noalias %row, double %time"

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        yield from self._row("%row")
        yield from self._spread("%time", "%times")
        yield f"  store {self._registers.reals} %times, ptr %t0, align 8"
        yield self._call(functions, "sample")
        yield from self._kept()
        yield "  br label %move"
        yield from self._moved(functions, "entry", "end")
        yield "end:"
        yield "  ret void"


def _number(value: float) -> str:
    """A number in LLVM's text."""
    return Registers(1).real(value)[1:-1].removeprefix("double ")
