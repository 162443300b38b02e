"""LLVM code of traced operations, on as many copies at a time as a register holds.

An array has a register for each entry. The operations stand in parts of bounded size, which hand
values over in memory, as compiling one long piece takes more than proportionally long. No operation
is fused or reordered: a copy has the same bits whatever the others hold. Only exponentials,
logarithms, powers and the inverse and hyperbolic functions call the C library; without them the
bits are those of every processor.
"""

from collections.abc import Iterator, Mapping, Sequence

from ffsm_drake.plugins.compiled.angles import without_angles
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.tape.numbers import TRUTHS, Loop, Operation, Symbol, Tape, needed

_PART = 400  # operations
_PLAIN = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}
# single instructions: kind -> name of LLVM's, operands
_CALLS = {
    "sqrt": ("sqrt", 1), "copysign": ("copysign", 2), "abs": ("fabs", 1), "floor": ("floor", 1),
    "rint": ("rint", 1),
}  # fmt: skip
_COMPARED = {"lt": "olt", "le": "ole", "eq": "oeq", "ne": "une", "max": "ogt", "min": "olt"}
# functions of the C library, called for each lane: kind -> operands
_LIBRARY = dict.fromkeys(
    ("tan", "exp", "log", "tanh", "sinh", "cosh", "expm1", "log1p", "asin", "acos", "atan"), 1
) | {"atan2": 2, "pow": 2}
_READ = ("input", "entry")  # kinds of values that are in an array
_Places = Mapping[int, Sequence[tuple[str, int]]]  # of results: operation -> arrays and entries


def declarations(registers: Registers) -> Iterator[str]:
    """The lines that a module of functions begins with."""
    for name, count in _CALLS.values():
        operands = ", ".join([registers.reals] * count)
        yield f"declare {registers.reals} @llvm.{name}.v{registers.width}f64({operands})"
    for name, count in _LIBRARY.items():
        yield f"declare double @{name}({', '.join(['double'] * count)})"
    yield "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)"


def of_lanes(
    registers: Registers,
    name: str,
    tape: Tape,
    inputs: Mapping[str, int],
    results: Mapping[str, Sequence[Symbol | float]],
) -> str:
    """An internal function of pointers to arrays with a register for each entry, of inputs and of
    results. An array may be both.

    Args:
      inputs: the length n of the rows of each input array.
      results: symbols and numbers, a row of each array of results.
    """
    tape, results = without_angles(tape, results)
    places: dict[int, list[tuple[str, int]]] = {}
    body = list[str]()
    changed = {each: f"{each}.new" for each in results if each in inputs}
    for name_of, row in results.items():
        array = changed.get(name_of, name_of)
        for entry, value in enumerate(row):
            if isinstance(value, Symbol):
                places.setdefault(value.index, []).append((array, entry))
            else:
                body += _store(registers, registers.real(value), f"{array}.b", entry, "fixed")
    operations, texts = tape.operations, list[str]()
    wanted = needed(operations, places)
    inner = [each for each in wanted if operations[each].kind not in _READ or each in places]
    loops = {each: operations[each].operands for each in inner if operations[each].kind == "loop"}
    for own in dict.fromkeys(str(operands[0]) for operands in loops.values()):
        texts.append(_loop(registers, f"{name}.{own}", tape.loops[own]))
    parts = [inner[first : first + _PART] for first in range(0, len(inner), _PART)]
    slots, size = _slots(operations, parts)
    rooms = {"kept": max(size, 1)}
    rooms |= {f"loop.{index}": len(operands) - 1 for index, operands in loops.items()}
    rooms |= {new: len(results[each]) for each, new in changed.items()}
    arrays = dict.fromkeys((*inputs, *results))
    pointers = ", ".join(f"ptr noalias %{each}.b" for each in arrays)
    inner_pointers = ", ".join((pointers, *(f"ptr noalias %{each}.b" for each in rooms)))
    given = ", ".join(f"ptr %{each}.b" for each in (*arrays, *rooms))
    for number, part in enumerate(parts):
        lines = "\n".join(_Part(registers, name, operations, slots, places, part).lines())
        texts.append(
            f"define internal void @{name}.{number}({inner_pointers}) noinline "
            f"{{\n{lines}\n  ret void\n}}\n"
        )
        body.append(f"  call void @{name}.{number}({given})")
    for each, new in changed.items():
        size = 8 * registers.width * len(results[each])
        copied = f"ptr %{each}.b, ptr %{new}.b, i64 {size}, i1 false"
        body.append(f"  call void @llvm.memcpy.p0.p0.i64({copied})")
    lines = "\n".join((*(_room(registers, *each) for each in rooms.items()), *body))
    texts.append(f"define internal void @{name}({pointers}) {{\n{lines}\n  ret void\n}}\n")
    return "\n".join(texts)


def _room(registers: Registers, name: str, size: int) -> str:
    return f"  %{name}.b = alloca [{size} x {registers.reals}], align 64"


def _loop(registers: Registers, name: str, loop: Loop) -> str:
    """An internal function of a pointer to the state before a loop, which becomes that after it,
    and then to what is fixed.
    """
    size, reals = len(loop.after), registers.reals
    arrays, made = {"state": size, "fixed": loop.num_fixed}, {"after": loop.after}
    return f"""{of_lanes(registers, f"{name}.round", loop.tape, arrays, made)}
define internal void @{name}(ptr noalias %state.b) noinline {{
{_room(registers, "after", size)}
  %fixed.b = getelementptr {reals}, ptr %state.b, i64 {size}
  br label %head
head:
  %k = phi i64 [0, %0], [%next, %taken]
  %first = load {reals}, ptr %state.b, align 8
  %goes = fcmp une {reals} %first, {registers.real(0.0)}
  %lanes = bitcast {registers.truths} %goes to i{registers.width}
  %any = icmp ne i{registers.width} %lanes, 0
  %within = icmp ult i64 %k, {loop.most}
  %on = and i1 %any, %within
  br i1 %on, label %round, label %end
round:
  call void @{name}.round(ptr %state.b, ptr %fixed.b, ptr %after.b)
  br label %take
take:
  %i = phi i64 [0, %round], [%following, %take]
  %before.p = getelementptr {reals}, ptr %state.b, i64 %i
  %after.p = getelementptr {reals}, ptr %after.b, i64 %i
  %before = load {reals}, ptr %before.p, align 8
  %after = load {reals}, ptr %after.p, align 8
  %now = select {registers.truths} %goes, {reals} %after, {reals} %before
  store {reals} %now, ptr %before.p, align 8
  %following = add i64 %i, 1
  %more = icmp ult i64 %following, {size}
  br i1 %more, label %take, label %taken
taken:
  %next = add i64 %k, 1
  br label %head
end:
  ret void
}}
"""


def _used(operation: Operation) -> list[int]:
    """The operations that one takes values of."""
    if operation.kind in _READ:
        return []
    return [each for each in operation.operands if isinstance(each, int)]


def _slots(
    operations: Sequence[Operation], parts: Sequence[Sequence[int]]
) -> tuple[dict[int, int], int]:
    """The place in memory of each value for a later part, and the number of places. A place is free
    again after its last reader.
    """
    made = {index: number for number, part in enumerate(parts) for index in part}
    last: dict[int, int] = {}
    for number, part in enumerate(parts):
        for index in part:
            for each in _used(operations[index]):
                if made.get(each, number) < number:  # inputs are loaded from their arrays
                    last[each] = number
    slots, free, size = dict[int, int](), list[int](), 0
    for number, part in enumerate(parts):
        for index in part:
            if index in last and operations[index].kind not in _READ:
                if not free:
                    free, size = [size], size + 1
                slots[index] = free.pop()
        free += [slots[each] for each, end in last.items() if end == number and each in slots]
    return slots, size


class _Part:
    """A part of a function's operations."""

    def __init__(
        self,
        registers: Registers,
        name: str,
        operations: Sequence[Operation],
        slots: Mapping[int, int],
        places: _Places,
        part: Sequence[int],
    ) -> None:
        self._operations, self._slots, self._places, self._name = operations, slots, places, name
        self._registers, self._part = registers, part
        self._here = set[int]()  # values in registers

    def lines(self) -> Iterator[str]:
        for index in self._part:
            if index not in self._here:
                yield from self._value(index)
            if index in self._slots:
                value = f"%t{index}"
                if self._operations[index].kind in TRUTHS:
                    one, zero = map(self._registers.real, (1.0, 0.0))
                    reals, truths = self._registers.reals, self._registers.truths
                    yield f"  {value}.d = select {truths} {value}, {reals} {one}, {reals} {zero}"
                    value += ".d"
                yield from _store(self._registers, value, "kept.b", self._slots[index], "k")
            for array, entry in self._places.get(index, ()):
                yield from _store(self._registers, f"%t{index}", f"{array}.b", entry, "o")

    def _value(self, index: int) -> Iterator[str]:
        """Compute a value, with those that it takes from memory first."""
        operation, name = self._operations[index], f"%t{index}"
        for each in _used(operation):
            if each not in self._here:
                yield from self._fetched(each)
        (kind, operands), reals = operation, self._registers.reals
        if kind in _READ:
            yield from self._fetched(index)
        elif kind == "loop":
            for place, operand in enumerate(operands[1:]):
                given = self._operand(operand)
                yield from _store(self._registers, given, f"loop.{index}.b", place, "s")
            yield f"  call void @{self._name}.{operands[0]}(ptr %loop.{index}.b)"
        elif kind in _COMPARED or kind in TRUTHS or kind == "select":
            yield from self._chosen(name, kind, list(map(self._operand, operands)))
        elif kind in _LIBRARY:
            yield from self._from_library(name, kind, list(map(self._operand, operands)))
        elif kind == "negate":
            yield f"  {name} = fneg {reals} %t{operands[0]}"
        elif kind in _CALLS:
            given = ", ".join(f"{reals} {self._operand(each)}" for each in operands)
            called = f"@llvm.{_CALLS[kind][0]}.v{self._registers.width}f64"
            yield f"  {name} = call {reals} {called}({given})"
        else:
            first, second = map(self._operand, operands)
            yield f"  {name} = {_PLAIN[kind]} {reals} {first}, {second}"
        self._here.add(index)

    def _chosen(self, name: str, kind: str, operands: list[str]) -> Iterator[str]:
        """Comparisons, what follows from truths, and what they select."""
        reals, truths, first = self._registers.reals, self._registers.truths, operands[0]
        if kind == "select":
            then, otherwise = operands[1:]
            yield f"  {name} = select {truths} {first}, {reals} {then}, {reals} {otherwise}"
        elif kind == "not":
            ones = f"<{', '.join(['i1 true'] * self._registers.width)}>"
            yield f"  {name} = xor {truths} {first}, {ones}"
        elif kind in ("and", "or"):
            yield f"  {name} = {kind} {truths} {first}, {operands[1]}"
        elif kind in TRUTHS:
            yield f"  {name} = fcmp {_COMPARED[kind]} {reals} {first}, {operands[1]}"
        else:  # the largest or least of two; NaN if one of them is
            second = operands[1]
            yield f"  {name}.c = fcmp {_COMPARED[kind]} {reals} {second}, {first}"
            yield f"  {name}.n = fcmp uno {reals} {second}, {second}"
            yield f"  {name}.s = or {truths} {name}.c, {name}.n"
            yield f"  {name} = select {truths} {name}.s, {reals} {second}, {reals} {first}"

    def _from_library(self, name: str, kind: str, operands: list[str]) -> Iterator[str]:
        reals, value = self._registers.reals, "zeroinitializer"
        for lane in range(self._registers.width):
            given = []
            for i, each in enumerate(operands):
                given.append(f"double {name}.x{lane}.{i}")
                yield f"  {name}.x{lane}.{i} = extractelement {reals} {each}, i64 {lane}"
            yield f"  {name}.y{lane} = call double @{kind}({', '.join(given)})"
            made = name if lane == self._registers.width - 1 else f"{name}.v{lane}"
            yield f"  {made} = insertelement {reals} {value}, double {name}.y{lane}, i64 {lane}"
            value = made

    def _fetched(self, index: int) -> Iterator[str]:
        """Load a value from its array, or from another part's memory."""
        self._here.add(index)
        operation = self._operations[index]
        array, entry = "kept", self._slots.get(index, 0)
        if operation.kind in _READ:
            array, entry = str(operation.operands[0]), int(operation.operands[1])
            array = array if operation.kind == "input" else f"loop.{array}"
        reals = self._registers.reals
        yield f"  %p{index} = getelementptr {reals}, ptr %{array}.b, i64 {entry}"
        if operation.kind in TRUTHS:
            yield f"  %l{index} = load {reals}, ptr %p{index}, align 8"
            yield f"  %t{index} = fcmp une {reals} %l{index}, {self._registers.real(0.0)}"
        else:
            yield f"  %t{index} = load {reals}, ptr %p{index}, align 8"

    def _operand(self, operand: float | str) -> str:
        return f"%t{operand}" if isinstance(operand, int) else self._registers.real(float(operand))


def _store(registers: Registers, value: str, array: str, entry: int, name: str) -> Iterator[str]:
    pointer = f"%{name}.{array}.{entry}"
    yield f"  {pointer} = getelementptr {registers.reals}, ptr %{array}, i64 {entry}"
    yield f"  store {registers.reals} {value}, ptr {pointer}, align 8"
