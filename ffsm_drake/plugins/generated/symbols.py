"""Arithmetic on symbols: it leaves a list of operations, constants folded and common terms shared.

Functions written for floats take symbols too.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple


class Operation(NamedTuple):
    """An operation on numbers: operands are indices of operations before it, or constants.

    ``input`` has an array's name and a row.
    """

    kind: str  # input, add, subtract, multiply, divide, negate, sine, cosine, sqrt, copysign
    operands: tuple["int | float | str", ...]


class Tape:
    """The operations so far; equal ones are the same."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self._known: dict[tuple[Any, ...], Symbol] = {}

    def inputs(self, array: str, rows: int) -> "list[Symbol]":
        """The rows of an input array."""
        return [self.record("input", array, row) for row in range(rows)]

    def record(self, kind: str, *operands: "Symbol | float | str") -> "Symbol":
        """The result of an operation, which is new or known."""
        plain = tuple(each.index if isinstance(each, Symbol) else each for each in operands)
        key = (kind, plain, *map(type, plain))  # the constant 1.0 is not the operation 1
        if key not in self._known:
            self._known[key] = Symbol(self, len(self.operations))
            self.operations.append(Operation(kind, plain))
        return self._known[key]


class Symbol:
    """A number that is known when the code runs."""

    __slots__ = ("index", "tape")

    def __init__(self, tape: Tape, index: int) -> None:
        self.tape, self.index = tape, index

    def _negated(self) -> "Symbol | None":
        """The operand of a negation; None for other operations."""
        kind, operands = self.tape.operations[self.index]
        return Symbol(self.tape, int(operands[0])) if kind == "negate" else None

    def __neg__(self) -> "Symbol":
        return self._negated() or self.tape.record("negate", self)

    def __add__(self, other: "Symbol | float") -> "Symbol":
        if not isinstance(other, Symbol):
            return self if other == 0.0 else self.tape.record("add", self, float(other))
        if (taken := other._negated()) is not None:
            return _difference(self, taken)
        if (taken := self._negated()) is not None:
            return _difference(other, taken)
        return self.tape.record("add", *sorted((self, other), key=_place))

    __radd__ = __add__

    def __sub__(self, other: "Symbol | float") -> "Symbol | float":
        if not isinstance(other, Symbol):
            return self + -other
        if self.index == other.index:
            return 0.0
        taken = other._negated()
        return _difference(self, other) if taken is None else self + taken

    def __rsub__(self, other: float) -> "Symbol":
        return -self if other == 0.0 else self.tape.record("subtract", float(other), self)

    def __mul__(self, other: "Symbol | float") -> "Symbol | float":
        if (taken := self._negated()) is not None:
            return -(taken * other)
        if isinstance(other, Symbol):
            if (taken := other._negated()) is not None:
                return -(self * taken)
            return self.tape.record("multiply", *sorted((self, other), key=_place))
        if other == 0.0:
            return 0.0
        if abs(other) == 1.0:
            return self if other > 0.0 else -self
        return self.tape.record("multiply", self, float(other))

    __rmul__ = __mul__

    def __rtruediv__(self, other: float) -> "Symbol":
        return self.tape.record("divide", float(other), self)


def _place(symbol: Symbol) -> int:
    return symbol.index


def _difference(one: Symbol, other: Symbol) -> Symbol:
    return one.tape.record("subtract", one, other)


def sine(x: "Symbol | float") -> "Symbol | float":
    """The sine of an angle, rad."""
    return x.tape.record("sine", x) if isinstance(x, Symbol) else math.sin(x)


def cosine(x: "Symbol | float") -> "Symbol | float":
    """The cosine of an angle, rad."""
    return x.tape.record("cosine", x) if isinstance(x, Symbol) else math.cos(x)


def square_root(x: "Symbol | float") -> "Symbol | float":
    """The square root."""
    return x.tape.record("sqrt", x) if isinstance(x, Symbol) else math.sqrt(x)


def signed(x: "Symbol | float", sign: "Symbol | float") -> Symbol:
    """A number with the sign of another; at least one of them is a symbol."""
    tape = next(each.tape for each in (x, sign) if isinstance(each, Symbol))
    return tape.record("copysign", x, sign)


def needed(operations: Sequence[Operation], results: Iterable[int]) -> list[int]:
    """The indices of the operations that some results need, in order."""
    wanted = set(results)
    for index in range(len(operations) - 1, -1, -1):
        if index in wanted:
            kind, operands = operations[index]
            if kind != "input":
                wanted.update(each for each in operands if isinstance(each, int))
    return sorted(wanted)
