"""LLVM code of traced operations, eight copies at a time.

An array of a function has the shape (blocks, rows, 8): 8 copies lie side by side. The operations
stand in parts of bounded size, which hand values over in memory, as compiling one long piece takes
more than proportionally long. No operation is fused or reordered, and there is no library call: a
lane has the same bits whatever the others hold, on every processor.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ffsm_drake.plugins.generated.angles import LANES, constant, sine_and_cosine
from ffsm_drake.plugins.generated.symbols import Operation, Symbol, Tape, needed

OUT = "out"
_PART = 400  # operations
_V, _I = f"<{LANES} x double>", f"<{LANES} x i64>"
_PLAIN = {"add": "fadd", "subtract": "fsub", "multiply": "fmul", "divide": "fdiv"}


def function(name: str, tape: Tape, arrays: Mapping[str, int], results: Sequence[Any]) -> str:
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
        lines = "\n".join(_Part(operations, slots, rows_of, part).lines())
        texts.append(
            f"define internal void @{name}.{number}({pointers}) noinline "
            f"{{\n{lines}\n  ret void\n}}\n"
        )
    given = ", ".join(f"ptr %{each}.b" for each in rows)
    calls = [f"  call void @{name}.{n}({given}, ptr %kept)" for n in range(len(parts))]
    for row, value in enumerate(results):
        if not isinstance(value, Symbol):
            calls += _store(constant(value), f"{OUT}.b", row, f"%fixed.{row}")
    return "\n".join((*texts, _loop(name, rows, size, calls)))


def _loop(name: str, rows: Mapping[str, int], size: int, body: Sequence[str]) -> str:
    """Over blocks, with pointers %ARRAY.b into each array."""
    pointers = ", ".join(f"ptr noalias %{each}" for each in rows)
    moved = [
        line
        for each, count in rows.items()
        for line in (
            f"  %{each}.o = mul i64 %block, {count}",
            f"  %{each}.b = getelementptr {_V}, ptr %{each}, i64 %{each}.o",
        )
    ]
    lines = "\n".join((*moved, *body))
    return f"""define void @{name}({pointers}, i64 %blocks) {{
entry:
  %kept = alloca [{max(size, 1)} x {_V}], align 64
  br label %loop
loop:
  %block = phi i64 [0, %entry], [%next, %loop]
{lines}
  %next = add i64 %block, 1
  %more = icmp slt i64 %next, %blocks
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
    """The place in memory of each value that a later part takes, and how many there are. A place is
    free again after the last part that reads it.
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
        operations: Sequence[Operation],
        slots: Mapping[int, int],
        rows_of: Mapping[int, Sequence[int]],
        part: Sequence[int],
    ) -> None:
        self._operations, self._slots, self._rows_of = operations, slots, rows_of
        self._part = part
        self._here = set[int]()  # values in registers
        self._turns = set[int]()  # angles with sine and cosine

    def lines(self) -> Iterator[str]:
        for index in self._part:
            if index not in self._here:
                yield from self._value(index)
            if index in self._slots:
                yield from _store(f"%t{index}", "kept", self._slots[index], f"%k{index}", align=64)
            for row in self._rows_of.get(index, ()):
                yield from _store(f"%t{index}", OUT, row, f"%o{row}")

    def _value(self, index: int) -> Iterator[str]:
        """Compute a value, with those that it takes from memory first."""
        operation, name = self._operations[index], f"%t{index}"
        for each in _used(operation):
            if each not in self._here:
                yield from self._fetched(each)
        kind, operands = operation
        if kind == "input":
            yield from self._fetched(index)
        elif kind == "negate":
            yield f"  {name} = fneg {_V} %t{operands[0]}"
        elif kind in ("sine", "cosine"):
            angle = int(operands[0])
            if angle not in self._turns:
                self._turns.add(angle)
                yield from sine_and_cosine(f"%t{angle}", f"%a{angle}")
            yield f"  {name} = bitcast {_I} %a{angle}.{kind} to {_V}"
        else:
            first, second = map(_operand, operands)
            yield f"  {name} = {_PLAIN[kind]} {_V} {first}, {second}"
        self._here.add(index)

    def _fetched(self, index: int) -> Iterator[str]:
        """Load a value from its array, or from another part's memory."""
        self._here.add(index)
        operation = self._operations[index]
        if operation.kind == "input":
            array, row = operation.operands
            yield from _load(f"%t{index}", str(array), int(row), f"%p{index}")
        else:
            yield from _load(f"%t{index}", "kept", self._slots[index], f"%p{index}", align=64)


def _load(name: str, array: str, row: int, pointer: str, *, align: int = 8) -> Iterator[str]:
    yield f"  {pointer} = getelementptr {_V}, ptr %{array}, i64 {row}"
    yield f"  {name} = load {_V}, ptr {pointer}, align {align}"


def _store(value: str, array: str, row: int, pointer: str, *, align: int = 8) -> Iterator[str]:
    yield f"  {pointer} = getelementptr {_V}, ptr %{array}, i64 {row}"
    yield f"  store {_V} {value}, ptr {pointer}, align {align}"


def _operand(operand: Any) -> str:
    return f"%t{operand}" if isinstance(operand, int) else constant(operand)
