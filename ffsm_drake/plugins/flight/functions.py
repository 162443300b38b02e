"""Traced functions as C99: one operation, one constant.

No operation is fused or reordered. In double precision, sines and cosines are the sums and products
of the compiled runs, so that results are equal bit for bit. Only exponentials, logarithms, powers
and the inverse and hyperbolic functions call the C library.
"""

import collections
import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.compiled.angles import without_angles
from ffsm_drake.plugins.tape.numbers import TRUTHS, Loop, Operation, Symbol, Tape, needed

_BINARY = {
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/",
    "lt": "<", "le": "<=", "eq": "==", "ne": "!=", "and": "&&", "or": "||",
}  # fmt: skip
_LIBRARY = {"abs": "fabs", "sine": "sin", "cosine": "cos"}  # kind -> the C library's name, if other
_OWN = {"max": "larger", "min": "smaller"}
_ANGLES = ("sine", "cosine")  # in double precision a function of helpers.c makes both
_READ = ("input", "entry")  # kinds of values that are in an array
Place = Callable[[str, int], str]  # of an array's entry: its C expression


@dataclasses.dataclass(frozen=True)
class Precision:
    """How numbers are written."""

    single: bool

    @property
    def name(self) -> str:
        """The type of numbers."""
        return "float" if self.single else "double"

    def number(self, value: float) -> str:
        """A number."""
        if math.isnan(value):
            return "NAN"
        if not self.single:
            return repr(float(value)) if math.isfinite(value) else f"{'-' * int(value < 0)}INFINITY"
        with np.errstate(over="ignore", under="ignore"):
            rounded = np.float32(value)
        if rounded == 0.0 and value != 0.0:  # as a divisor it would be none
            rounded = np.copysign(np.finfo(np.float32).tiny, np.float32(value))
        if not np.isfinite(rounded):
            return f"{'-' * int(rounded < 0)}INFINITY"
        text = str(rounded)
        return f"{text}F" if re.search(r"[.e]", text) else f"{text}.0F"

    def called(self, kind: str) -> str:
        """The name of a function of the C library."""
        return _LIBRARY.get(kind, kind) + "f" * self.single


class Function:
    """A traced function."""

    def __init__(
        self, name: str, tape: Tape, results: Mapping[str, Sequence[Any]], precision: Precision
    ) -> None:
        """Args:
        name: of the C function.
        tape: its operations.
        results: symbols and numbers, a row for each array that it writes.
        precision: of its numbers.
        """
        self._name, self._precision = name, precision
        self._tape, self._results = tape, results
        operations, self._wanted = tape.operations, _wanted(tape, results)
        self.reads = {operations[each].operands for each in self._wanted if _is(operations, each)}

    @property
    def operations(self) -> dict[str, int]:
        """Numbers of operations by kind, with those of angles; those of loops are not in it."""
        tape, results = self._tape, self._results
        if not self._precision.single:
            tape, results = without_angles(tape, results)
        kinds = (tape.operations[index].kind for index in _wanted(tape, results))
        return dict(collections.Counter(kind for kind in kinds if kind not in _READ))

    def text(self, arguments: str, source: Place, target: Place, *, local: bool = True) -> str:
        """The C function, after those of its loops.

        Args: its parameters; where it reads, and where it writes; whether only its file sees it.
        """
        operations, real = self._tape.operations, self._precision.name
        loops = {
            operations[each].operands[0] for each in self._wanted if _is_loop(operations, each)
        }
        before = [
            self._loop(str(each), self._tape.loops[str(each)]) for each in sorted(loops, key=str)
        ]
        body, angles = list[str](), dict[Any, int]()
        for index in self._wanted:
            if operations[index].kind in _ANGLES and not self._precision.single:
                body += self._angle(index, operations[index], angles)
            else:
                body += self._lines(index, operations[index], source)
        ends = list[str]()
        for array, row in self._results.items():
            for entry, value in enumerate(row):
                given = self._value(value.index if _is_symbol(value) else float(value))
                ends.append(f"  {target(array, entry)} = {given};")
        unused = [f"  (void){each};" for each in _names(arguments)]
        lines = "\n".join((*unused, *body, *ends))
        head = f"{'static ' * local}void {self._name}({arguments})"
        return "\n".join((*before, f"{head}\n{{\n{lines}\n}}\n")).replace("REAL", real)

    def _lines(self, index: int, operation: Operation, source: Place) -> Iterator[str]:
        kind, operands = operation
        if kind == "input":
            array, entry = operands
            yield f"  const REAL t{index} = {source(str(array), int(entry))};"
            return
        if kind == "entry":
            yield f"  const REAL t{index} = s{operands[0]}[{int(operands[1])}];"
            return
        given = [self._value(each) for each in operands if not isinstance(each, str)]
        if kind == "loop":
            size = len(self._tape.loops[str(operands[0])].after)
            fixed = given[size:] or [self._precision.number(0.0)]
            yield f"  REAL s{index}[{size}] = {{{', '.join(given[:size])}}};"
            yield f"  const REAL f{index}[{len(fixed)}] = {{{', '.join(fixed)}}};"
            yield f"  {self._name}_{operands[0]}(s{index}, f{index});"
            return
        made = self._made(kind, given)
        yield f"  const {'bool' if kind in TRUTHS else 'REAL'} t{index} = {made};"

    def _angle(self, index: int, operation: Operation, known: dict[Any, int]) -> Iterator[str]:
        """A sine or cosine; both are made where the first is needed (``known``: of an angle)."""
        (angle,) = operation.operands
        if angle not in known:
            known[angle] = index
            yield f"  REAL a{index}[2];"
            yield f"  sine_and_cosine({self._value(angle)}, a{index});"
        yield f"  const REAL t{index} = a{known[angle]}[{_ANGLES.index(operation.kind)}];"

    def _made(self, kind: str, given: list[str]) -> str:
        """What an operation makes."""
        if kind in _BINARY:
            return f"{given[0]} {_BINARY[kind]} {given[1]}"
        if kind in ("negate", "not"):
            return f"{'-' if kind == 'negate' else '!'}{given[0]}"
        if kind == "select":
            return f"{given[0]} ? {given[1]} : {given[2]}"
        name = _OWN.get(kind) or self._precision.called(kind)
        return f"{name}({', '.join(given)})"

    def _value(self, value: Any) -> str:
        """A value of an operation, or a constant."""
        if isinstance(value, int):
            return f"t{value}"
        text = self._precision.number(value)
        return f"({text})" if text.startswith("-") else text

    def _loop(self, name: str, loop: Loop) -> str:
        """A function of the state before a loop, which becomes that after it, and what is fixed."""
        own, size = f"{self._name}_{name}", len(loop.after)
        once = Function(f"{own}_round", loop.tape, {"after": loop.after}, self._precision)
        given = "const REAL *state, const REAL *fixed, REAL *after"
        zero = self._precision.number(0.0)
        return f"""{once.text(given, _element, _element)}
static void {own}(REAL *state, const REAL *fixed)
{{
  REAL after[{size}];
  for (uint32_t k = 0U; (k < {loop.most}U) && (state[0] != {zero}); ++k) {{
    {own}_round(state, fixed, after);
    for (uint32_t i = 0U; i < {size}U; ++i) {{
      state[i] = after[i];
    }}
  }}
}}
"""


def _element(array: str, entry: int) -> str:
    return f"{array}[{entry}]"


def _wanted(tape: Tape, results: Mapping[str, Sequence[Any]]) -> Sequence[int]:
    """The operations that results need."""
    ends = [one.index for row in results.values() for one in row if _is_symbol(one)]
    return needed(tape.operations, ends)


def _is_symbol(value: Any) -> bool:
    return isinstance(value, Symbol)


def _is(operations: Sequence[Operation], index: int) -> bool:
    return operations[index].kind == "input"


def _is_loop(operations: Sequence[Operation], index: int) -> bool:
    return operations[index].kind == "loop"


def _names(arguments: str) -> list[str]:
    """The names of parameters."""
    return [re.findall(r"\w+", each.partition("[")[0])[-1] for each in arguments.split(",")]
