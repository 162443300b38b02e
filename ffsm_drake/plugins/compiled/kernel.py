"""One function of machine code that runs simulations, as many at once as a register holds.

All numbers of its runs stand in one array of cells, each a register wide. At every control sample
it reads rows of each run (reference, noise) and writes a row of the log.
"""

import ctypes
import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ffsm_drake.plugins.compiled.apart import apart
from ffsm_drake.plugins.compiled.code import declarations
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.loop import CARRIED, SCHEMES, Blocks, Function
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.systems.part import Parts

_BYTES = 8  # of a number
_BLOCK = 64  # samples whose numbers the cache holds


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
        self._run = self._code.function("run", 3, ctypes.c_int64)

    def run(
        self, runs: Mapping[str, np.ndarray], rows: Sequence[Mapping[str, np.ndarray]]
    ) -> "Signals":
        """Run a lane for each simulation.

        Args:
          runs: what each begins with, by the names of ``Blocks.parameters`` and ``states``:
            (width, n).
          rows: what each reads at the samples, by the names of ``Blocks.row``: (samples, n), one
            row after the other in memory.

        Returns: the signals of ``Blocks.log``.
        """
        cells = np.zeros((self._text.size, self.width))
        for name, values in runs.items():
            first = self._text.places[name]
            cells[first : first + values.shape[1]] = values.T
        samples = len(rows[0]["reference"])
        log = np.empty((samples, sum(n for *_, n in self.blocks.log.values()), self.width))
        read = np.array(
            [[own[name].ctypes.data for own in rows] for name in self._text.read], dtype=np.uint64
        )
        self._run(cells.ctypes.data, read.ctypes.data, log.ctypes.data, samples - 1)
        places, first = dict[str, slice](), 0
        for name, (*_, size) in self.blocks.log.items():
            places[name] = slice(first, first + size)
            first += size
        return Signals(log, places)


class Signals:
    """The signals of all lanes."""

    def __init__(self, log: np.ndarray, places: Mapping[str, slice]) -> None:
        """Args: numbers (samples, n, width), and the place of each signal among the n."""
        self.places, self._log = places, log
        self._found = dict[str, np.ndarray]()

    def __getitem__(self, name: str) -> np.ndarray:
        """A signal (width, samples, its size)."""
        if name not in self._found:
            part = self._log[:, self.places[name]]
            found = np.empty((part.shape[2], *part.shape[:2]))
            for first in range(0, len(part), _BLOCK):
                block = slice(first, first + _BLOCK)
                found[:, block] = part[block].transpose(2, 0, 1)
            self._found[name] = found
        return self._found[name]

    def are_finite(self) -> np.ndarray:
        """Of each lane (width), whether all of its numbers are."""
        flat = self._log.reshape(-1, self._log.shape[2])
        with np.errstate(over="ignore", invalid="ignore"):
            found: np.ndarray = np.isfinite(np.ones(len(flat)) @ flat)
        for lane in np.flatnonzero(~found):  # a sum may exceed the largest number
            found[lane] = np.isfinite(flat[:, lane]).all()
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
        return Code(make, key and f"{what} {key}")

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
    """Whole runs with their logs."""

    _arguments = "ptr noalias %cells, ptr noalias %rows, ptr noalias %log, i64 %last"
    _begins = True

    def __init__(self, blocks: Blocks, registers: Registers, *, steps: int) -> None:
        super().__init__(blocks, registers, steps=steps)
        self.read = [name for name, size in blocks.row.items() if size]
        for name, size in blocks.row.items():
            self.places[name] = self.size
            self.size += size

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        reals, blocks = self._registers.reals, self._blocks
        logged = sum(size for *_, size in blocks.log.values())
        yield "  br label %begin"
        yield "begin:"
        yield "  %k = phi i64 [0, %entry], [%next, %stepped]"
        for number, name in enumerate(self.read):
            yield from self._read(name, number * self._registers.width)
        yield "  %sample = uitofp i64 %k to double"
        yield "  %time = fmul double %sample, %the_sample_time"
        yield from self._spread("%time", "%t0")
        yield "  %is_first = icmp eq i64 %k, 0"
        yield "  br i1 %is_first, label %first, label %later"
        yield "first:"
        yield self._call(functions, "first")
        yield "  br label %sampled"
        yield "later:"
        yield self._call(functions, "sample")
        yield "  br label %sampled"
        yield "sampled:"
        yield f"  %entry_of_log = mul i64 %k, {logged}"
        yield f"  %logged = getelementptr {reals}, ptr %log, i64 %entry_of_log"
        first = 0
        for cell, start, size in blocks.log.values():
            source, target = self._new(), self._new()
            yield f"  {source} = getelementptr {reals}, ptr %{cell}, i64 {start}"
            yield f"  {target} = getelementptr {reals}, ptr %logged, i64 {first}"
            yield self._copy(source, target, size)
            first += size
        yield from self._kept()
        yield "  %ends = icmp eq i64 %k, %last"
        yield "  br i1 %ends, label %end, label %move"
        yield from self._moved(functions, "sampled", "stepped")
        yield "stepped:"
        yield "  %next = add i64 %k, 1"
        yield "  br label %begin"
        yield "end:"
        yield "  ret void"

    def _read(self, name: str, place: int) -> Iterator[str]:
        """Copy a row of each lane, whose address is at a place among ``rows``, into the cells."""
        size, reals = self._blocks.row[name], self._registers.reals
        at, value, before = f"%{name}.i", "poison", self._new()
        yield f"  {before} = mul i64 %k, {size}"
        for lane in range(self._registers.width):
            address = self._new()
            yield f"  {address} = getelementptr ptr, ptr %rows, i64 {place + lane}"
            yield f"  %{name}.r{lane} = load ptr, ptr {address}, align 8"
        yield f"  br label %{name}.from"
        yield f"{name}.from:"
        yield f"  br label %{name}.move"
        yield f"{name}.move:"
        yield f"  {at} = phi i64 [0, %{name}.from], [{at}.next, %{name}.move]"
        yield f"  {at}.row = add i64 {before}, {at}"
        for lane in range(self._registers.width):
            one, entry, more = self._new(), self._new(), self._new()
            yield f"  {entry} = getelementptr double, ptr %{name}.r{lane}, i64 {at}.row"
            yield f"  {one} = load double, ptr {entry}, align 8"
            yield f"  {more} = insertelement {reals} {value}, double {one}, i64 {lane}"
            value = more
        yield f"  {at}.cell = getelementptr {reals}, ptr %{name}, i64 {at}"
        yield f"  store {reals} {value}, ptr {at}.cell, align 8"
        yield f"  {at}.next = add i64 {at}, 1"
        yield f"  {at}.more = icmp ult i64 {at}.next, {size}"
        yield f"  br i1 {at}.more, label %{name}.move, label %{name}.end"
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
