"""The LLVM text of the function ``run`` of a loop: runs with their logs, or one sample.

It calls the traced functions (``functions``) on the cells.
"""

import functools
from collections.abc import Iterable, Iterator, Mapping

from ffsm_drake.plugins.compiled.apart import apart
from ffsm_drake.plugins.compiled.blocks import COUNTS, Blocks
from ffsm_drake.plugins.compiled.code import declarations
from ffsm_drake.plugins.compiled.compiling import Code
from ffsm_drake.plugins.compiled.functions import Function, functions
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.compiled.schemes import SCHEMES

_BYTES = 8  # of a number
_ROWS = 32  # of the log, which the second-level cache holds


class ModuleText:
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


class RunsText(ModuleText):
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
        if blocks.calls:
            calls = [self._call(functions, name) for name in ("instants", "sensed")]
            yield from self._asked(calls)
            yield "  %goes_on = call i64 %call(i64 %sample.k, ptr %cells)"
            yield "  %is_stopped = icmp eq i64 %goes_on, 0"
            yield "  br i1 %is_stopped, label %end, label %called"
            yield "called:"
            if blocks.called:
                yield self._call(functions, "acted")
            else:
                yield from self._sampled(functions)
        else:
            sample = self._call(functions, "instants"), *self._sampled(functions)
            yield from self._asked(sample)
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


class SampleText(ModuleText):
    """One sample and the motion up to the next."""

    _arguments = "ptr noalias %cells"

    def _lines(self, functions: Mapping[str, Function]) -> Iterator[str]:
        for name in ("instants", "sample", "carried"):
            yield self._call(functions, name)
        yield "  br label %move"
        yield from self._moved(functions, "entry", "end")
        yield "end:"
        yield "  ret void"
