"""LLVM code of traced operations, on as many copies at a time as a register holds.

An array of a function has the shape (blocks, rows, 8): 8 copies lie side by side. The operations
stand in parts of bounded size, which hand values over in memory, as compiling one long piece takes
more than proportionally long. No operation is fused or reordered, and there is no library call: a
lane has the same bits whatever the others hold, on every processor.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ffsm_drake.plugins.generated.angles import sine_and_cosine
from ffsm_drake.plugins.generated.registers import LANES, Registers
from ffsm_drake.plugins.generated.symbols import Operation, Symbol, Tape, needed

OUT = "out"
_PART = 400  # operations
_ROW = f"[{LANES} x double]"
_PLAIN = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}


def function(
    registers: Registers, name: str, tape: Tape, arrays: Mapping[str, int], results: Sequence[Any]
) -> str:
    """A function of pointers to the arrays, to the array ``out``, and the number of blocks.

    Args:
      arrays: the rows of each input array.
      results: symbols and numbers, the rows of ``out``.
    """
    rows_of: dict[int, list[int]] = {}
    for row, result in enumerate(results):
        if isinstance(result, Symbol):
            rows_of.setdefault(result.index, []).append(row)
    operations = tape.operations
    inner = [
        index
        for index in needed(operations, rows_of)
        if operations[index].kind != "input" or index in rows_of
    ]
    parts = [inner[first : first + _PART] for first in range(0, len(inner), _PART)]
    slots, size = _slots(operations, parts)
    rows = {**arrays, OUT: len(results)}
    pointers = ", ".join(f"ptr noalias %{each}" for each in (*rows, "kept"))
    texts = []
    for number, part in enumerate(parts):
        lines = "\n".join(_Part(registers, operations, slots, rows_of, part).lines())
        texts.append(
            f"define internal void @{name}.{number}({pointers}) noinline "
            f"{{\n{lines}\n  ret void\n}}\n"
        )
    given = ", ".join(f"ptr %{each}.b" for each in rows)
    calls = [f"  call void @{name}.{n}({given}, ptr %kept)" for n in range(len(parts))]
    for row, value in enumerate(results):
        if not isinstance(value, Symbol):
            calls += _store(registers, registers.real(value), f"{OUT}.b", row, f"%fixed.{row}")
    return "\n".join((*texts, _loop(registers, name, rows, size, calls)))


def _loop(
    registers: Registers, name: str, rows: Mapping[str, int], size: int, body: Sequence[str]
) -> str:
    """Over the registers of each block, with pointers %ARRAY.b to theirs in each array."""
    pointers = ", ".join(f"ptr noalias %{each}" for each in rows)
    moved = [
        line
        for each, count in rows.items()
        for line in (
            f"  %{each}.o = mul i64 %block, {count}",
            f"  %{each}.f = getelementptr {_ROW}, ptr %{each}, i64 %{each}.o",
            f"  %{each}.b = getelementptr {registers.reals}, ptr %{each}.f, i64 %part",
        )
    ]
    lines, parts = "\n".join((*moved, *body)), LANES // registers.width
    return f"""define void @{name}({pointers}, i64 %blocks) {{
entry:
  %kept = alloca [{max(size, 1)} x {_ROW}], align 64
  %count = mul i64 %blocks, {parts}
  br label %loop
loop:
  %turn = phi i64 [0, %entry], [%next, %loop]
  %block = udiv i64 %turn, {parts}
  %part = urem i64 %turn, {parts}
{lines}
  %next = add i64 %turn, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""


def _used(operation: Operation) -> list[int]:
    """The operations that one takes values of."""
    if operation.kind == "input":
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
            if index in last and operations[index].kind != "input":
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
        operations: Sequence[Operation],
        slots: Mapping[int, int],
        rows_of: Mapping[int, Sequence[int]],
        part: Sequence[int],
    ) -> None:
        self._operations, self._slots, self._rows_of = operations, slots, rows_of
        self._registers, self._part = registers, part
        self._here = set[int]()  # values in registers
        self._turns = set[int]()  # angles with sine and cosine

    def lines(self) -> Iterator[str]:
        for index in self._part:
            if index not in self._here:
                yield from self._value(index)
            if index in self._slots:
                yield from self._stored(index, "kept", self._slots[index], f"%k{index}")
            for row in self._rows_of.get(index, ()):
                yield from self._stored(index, OUT, row, f"%o{row}")

    def _value(self, index: int) -> Iterator[str]:
        """Compute a value, with those that it takes from memory first."""
        operation, name = self._operations[index], f"%t{index}"
        for each in _used(operation):
            if each not in self._here:
                yield from self._fetched(each)
        (kind, operands), reals = operation, self._registers.reals
        if kind == "input":
            yield from self._fetched(index)
        elif kind == "negate":
            yield f"  {name} = fneg {reals} %t{operands[0]}"
        elif kind in ("sine", "cosine"):
            angle = int(operands[0])
            if angle not in self._turns:
                self._turns.add(angle)
                yield from sine_and_cosine(self._registers, f"%t{angle}", f"%a{angle}")
            yield f"  {name} = bitcast {self._registers.wholes} %a{angle}.{kind} to {reals}"
        else:
            first, second = map(self._operand, operands)
            yield f"  {name} = {_PLAIN[kind]} {reals} {first}, {second}"
        self._here.add(index)

    def _fetched(self, index: int) -> Iterator[str]:
        """Load a value from its array, or from another part's memory."""
        self._here.add(index)
        operation = self._operations[index]
        array, row = "kept", self._slots.get(index, 0)
        if operation.kind == "input":
            array, row = str(operation.operands[0]), int(operation.operands[1])
        yield f"  %p{index} = getelementptr {_ROW}, ptr %{array}, i64 {row}"
        yield f"  %t{index} = load {self._registers.reals}, ptr %p{index}, align 8"

    def _stored(self, index: int, array: str, row: int, pointer: str) -> Iterator[str]:
        return _store(self._registers, f"%t{index}", array, row, pointer)

    def _operand(self, operand: Any) -> str:
        return f"%t{operand}" if isinstance(operand, int) else self._registers.real(operand)


def _store(registers: Registers, value: str, array: str, row: int, pointer: str) -> Iterator[str]:
    yield f"  {pointer} = getelementptr {_ROW}, ptr %{array}, i64 {row}"
    yield f"  store {registers.reals} {value}, ptr {pointer}, align 8"
