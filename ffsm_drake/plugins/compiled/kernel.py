"""One function of machine code that runs simulations, as many at once as a register holds.

All numbers of its runs stand in one array of cells, each a register wide. At every control sample
it reads rows of each run (reference, noise) and writes rows of its signals.
"""

import ctypes
import functools
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.compiled.apart import apart
from ffsm_drake.plugins.compiled.called import Laws
from ffsm_drake.plugins.compiled.code import declarations
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.loop import CARRIED, SCHEMES, Blocks, Function
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.systems.part import Parts

_BYTES = 8  # of a number
_ROWS = 32  # of the log, which the second-level cache holds


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
        self.parts: Parts = {}  # whose signals follow from the log
        self._text = _Runs(blocks, lanes, steps=steps)
        self._code = self._text.code(f"runs of {self.width}", key)
        self._run = self._code.function("run", 2, ctypes.c_int64, ctypes.c_void_p)

    def run(
        self,
        runs: Mapping[str, np.ndarray],
        rows: Sequence[Mapping[str, np.ndarray]],
        signals: Collection[str] | None = None,
        laws: Laws | None = None,
    ) -> list[dict[str, np.ndarray] | None]:
        """Run a lane for each simulation.

        Args:
          runs: what each begins with, by the names of ``Blocks.parameters`` and ``states``:
            (width, n); and the ``bound`` of the size of its known velocities, rad/s and m/s.
          rows: what each reads at the samples, by the names of ``Blocks.row``: (samples, n), one
            row after the other in memory.
          signals: those that are kept; None: all.
          laws: of the lanes, if they are called.

        Returns: the signals of each by the names of ``Blocks.log`` (samples, size); None: it leaves
        its bound, a number is not finite, or the call of its law fails. Raises what ends a call,
        such as KeyboardInterrupt.
        """
        text, samples = self._text, len(rows[0]["reference"])
        cells = np.zeros((text.size, self.width))
        for name, values in runs.items():
            first = text.places[name]
            cells[first : first + values.shape[1]] = values.T
        sizes = {
            name: size
            for name, (*_, size) in self.blocks.log.items()
            if signals is None or name in signals
        }
        kept = [_arrays(sizes, samples) for _ in rows]
        places = [[own[name].ctypes.data for own in rows] for name in text.read]
        places += [
            [own[name].ctypes.data if name in own else 0 for own in kept]
            for name in self.blocks.log
        ]
        given = np.array(places, dtype=np.uint64)
        call = None if laws is None else laws.function(cells, text.places)
        self._run(cells.ctypes.data, given.ctypes.data, samples - 1, call)
        if laws is not None and laws.stopped is not None:
            raise laws.stopped
        lost = cells[text.places["lost"]].view(np.int64)
        return [None if is_lost else own for own, is_lost in zip(kept, lost.tolist(), strict=True)]


def _arrays(sizes: Mapping[str, int], samples: int) -> dict[str, np.ndarray]:
    """Arrays (samples, size) by name, in one piece of memory."""
    whole, found = np.empty(samples * sum(sizes.values())), dict[str, np.ndarray]()
    for name, size in sizes.items():
        found[name], whole = whole[: samples * size].reshape(samples, size), whole[samples * size :]
    return found


class Step:
    """One control sample, the first excepted."""

    def __init__(self, blocks: Blocks, *, steps: int, key: str | None, slopes: bool) -> None:
        """Arguments and errors as of ``Kernel``; with ``slopes`` the sample has its derivatives
        along a direction in each lane, else it has one lane.
        """
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
        functions = self._blocks.functions(
            self._registers, begins=self._begins, slopes=self._slopes
        )
        lines = "\n".join((*self._entry(), *self._lines(functions)))
        return "\n".join((
            *declarations(self._registers),
            "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)",
            *(each.text for each in functions.values()),
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
        """The integrator's steps up to the next sample, as a block ``move`` between two others."""
        blocks, scheme = self._blocks, SCHEMES[self._blocks.scheme]
        yield "move:"
        yield f"  %j = phi i64 [0, %{before}], [%following, %move]"
        yield "  %within = uitofp i64 %j to double"
        yield "  %shift = fmul double %within, %the_step"
        yield "  %start = fadd double %time, %shift"
        for i, time in enumerate(scheme.times):
            later, at = self._new(), self._new()
            yield f"  {later} = fmul double %the_step, {_number(time)}"
            yield f"  {at} = fadd double %start, {later}"
            yield from self._spread(at, f"%t{i}")
        for i, _ in enumerate(scheme.times):
            names = {"state": "x" if i == 0 else "y", "t": f"t{i}", "rates": f"k{i}"}
            names |= {f"d_{name}": f"d_{cell}" for name, cell in names.items()}
            yield self._call(functions, "derivative", **names)
            yield self._call(functions, f"point{i}")
        for prefix in ("", "d_") if self._slopes else ("",):
            yield self._copy(f"%{prefix}y", f"%{prefix}x", blocks.states["x"])
        yield "  %following = add i64 %j, 1"
        yield f"  %more = icmp ult i64 %following, {self._steps}"
        yield f"  br i1 %more, label %move, label %{after}"

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
        reals, one, all_lanes = self._registers.reals, self._new(), self._new()
        mask = f"<{self._registers.width} x i32> zeroinitializer"
        yield f"  {one} = insertelement {reals} poison, double {value}, i64 0"
        yield f"  {all_lanes} = shufflevector {reals} {one}, {reals} poison, {mask}"
        yield f"  store {reals} {all_lanes}, ptr {target}, align 8"


class _Runs(_Text):
    """Whole runs with their logs.

    The addresses in ``places`` are those of each lane's arrays: rows that it reads, and signals
    that it writes, unless the address is 0.
    """

    _arguments = "ptr noalias %cells, ptr noalias %places, i64 %last, ptr %call"
    _begins = True

    def __init__(self, blocks: Blocks, registers: Registers, *, steps: int) -> None:
        super().__init__(blocks, registers, steps=steps)
        self.read = [name for name, size in blocks.row.items() if size]
        logged = _ROWS * sum(size for *_, size in blocks.log.values())
        # ``lost`` has bits as soon as a lane is
        for name, size in (blocks.row | {"bound": 1, "lost": 1, "log": logged}).items():
            self.places[name] = self.size
            self.size += size

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        blocks, width, place = self._blocks, self._registers.width, 0
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
        yield "  %time = fmul double %sample, %the_sample_time"
        yield from self._spread("%time", "%t0")
        if blocks.called:
            yield self._call(functions, "sensed")
            yield "  %goes_on = call i64 %call(i64 %k, ptr %cells)"
            yield "  %is_stopped = icmp eq i64 %goes_on, 0"
            yield "  br i1 %is_stopped, label %end, label %sampled"
            yield "sampled:"
            yield self._call(functions, "acted")
        else:
            yield "  %is_first = icmp eq i64 %k, 0"
            yield "  br i1 %is_first, label %first, label %later"
            for label, name in (("first", "first"), ("later", "sample")):
                yield f"{label}:"
                yield self._call(functions, name)
                yield "  br label %sampled"
            yield "sampled:"
        yield f"  %row = urem i64 %k, {_ROWS}"
        yield from self._logged()
        yield from self._lost()
        yield from self._kept()
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
        yield "  br label %move"
        yield from self._moved(functions, "onward", "stepped")
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

    def _lost(self) -> Iterator[str]:
        """The lanes with a velocity beyond the bound, or a number that is not finite: it minus
        itself is not zero.
        """
        reals, wholes, width = self._registers.reals, self._registers.wholes, self._registers.width
        yield f"  %bounds = load {reals}, ptr %bound, align 8"
        yield f"  %lost.before = load {wholes}, ptr %lost, align 8"
        lost = "%lost.before"
        for cell, first, size in self._blocks.log.values():
            for entry in range(first, first + size):
                at, value, rest, bits, more = (self._new() for _ in range(5))
                yield f"  {at} = getelementptr {reals}, ptr %{cell}, i64 {entry}"
                yield f"  {value} = load {reals}, ptr {at}, align 8"
                yield f"  {rest} = fsub {reals} {value}, {value}"
                yield f"  {bits} = bitcast {reals} {rest} to {wholes}"
                yield f"  {more} = or {wholes} {lost}, {bits}"
                lost = more
                if cell == "known" and entry >= self._blocks.nq:
                    speed, beyond, mask, more = (self._new() for _ in range(4))
                    yield f"  {speed} = call {reals} @llvm.fabs.v{width}f64({reals} {value})"
                    yield f"  {beyond} = fcmp ogt {reals} {speed}, %bounds"
                    yield f"  {mask} = sext {self._registers.truths} {beyond} to {wholes}"
                    yield f"  {more} = or {wholes} {lost}, {mask}"
                    lost = more
        yield f"  store {wholes} {lost}, ptr %lost, align 8"
        yield f"  %are_lost = icmp ne {wholes} {lost}, zeroinitializer"
        yield f"  %lanes = bitcast {self._registers.truths} %are_lost to i{width}"
        yield f"  %no_lane = icmp eq i{width} %lanes, -1"

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
        yield from self._spread("%time", "%t0")
        yield self._call(functions, "sample")
        yield from self._kept()
        yield "  br label %move"
        yield from self._moved(functions, "entry", "end")
        yield "end:"
        yield "  ret void"


def _number(value: float) -> str:
    """A number in LLVM's text."""
    return Registers(1).real(value)[1:-1].removeprefix("double ")
