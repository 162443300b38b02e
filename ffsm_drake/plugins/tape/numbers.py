"""Arithmetic on symbols: it leaves a list of operations, constants folded and common terms shared.

Functions written for floats take symbols too. A comparison of symbols is a ``Truth``. What needs a
number's value, such as ``if x > 0.0`` or ``float(x)``, raises NotTraceable.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar, NamedTuple

import numpy as np


class NotTraceable(TypeError):
    """The code needs the value of a number that is known only when it runs."""

    last: ClassVar["NotTraceable | None"] = None

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        NotTraceable.last = self


@contextmanager
def none_caught() -> Iterator[None]:
    """Raise a NotTraceable that the code within has caught: its answer is that of a failure."""
    NotTraceable.last = None
    try:
        yield
        if NotTraceable.last is not None:
            raise NotTraceable.last
    finally:
        NotTraceable.last = None


class Operation(NamedTuple):
    """An operation on numbers: operands are indices of operations before it, or constants.

    ``input`` has an array's name and a row. ``loop`` has the name of a ``Loop``, its state and what
    it reads; ``entry`` a loop, and a place in its state at the end.
    """

    kind: str  # input, a truth of TRUTHS, select, loop, entry, or a function of numbers
    operands: tuple["int | float | str", ...]


TRUTHS = ("lt", "le", "eq", "ne", "and", "or", "not")  # kinds whose result is a truth


class Tape:
    """The operations so far; equal ones are the same."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.loops: dict[str, Loop] = {}
        self._known: dict[tuple[Any, ...], Any] = {}

    def inputs(self, array: str, rows: int) -> "list[Symbol]":
        """The rows of an input array."""
        return [self.record("input", array, row) for row in range(rows)]

    def record(self, kind: str, *operands: "Traceable | float | str") -> Any:
        """The result of an operation, which is new or known."""
        plain = tuple(map(self.place_of, operands))
        key = (kind, plain, *map(type, plain))  # the constant 1.0 is not the operation 1
        if key not in self._known:
            made = Truth if kind in TRUTHS else Symbol
            self._known[key] = made(self, len(self.operations))
            self.operations.append(Operation(kind, plain))
        return self._known[key]

    def repeat(self, round_: "Loop", state: Sequence[Any], fixed: Sequence[Any]) -> list[Any]:
        """The state (n) after rounds of a loop, in each of which it reads the same numbers too."""
        same = (name for name, other in self.loops.items() if other.is_like(round_))
        name = next(same, f"loop{len(self.loops)}")
        self.loops.setdefault(name, round_)
        loop = self.record("loop", name, *map(number, (*state, *fixed)))
        return [self.record("entry", loop, float(place)) for place in range(len(state))]

    def place_of(self, operand: "Traceable | float | str") -> int | float | str:
        """The index of an operand's operation; of a number itself."""
        if not isinstance(operand, Traceable):
            return operand
        if operand.tape is not self:
            raise NotTraceable("a number of another sample, kept outside of the law's memory")
        return operand.index


@dataclasses.dataclass(frozen=True)
class Loop:
    """A round of a loop: from inputs ``state`` and ``fixed`` of its own tape to the state after it.
    It is repeated while the state's first number is not zero.
    """

    tape: Tape
    after: Sequence[Any]
    num_fixed: int
    most: int  # rounds

    def is_like(self, other: "Loop") -> bool:
        """Whether it does the same."""
        places = (list(map(each.tape.place_of, each.after)) for each in (self, other))
        return (
            (self.most, self.num_fixed) == (other.most, other.num_fixed)
            and self.tape.operations == other.tape.operations
            and operator.eq(*places)
        )


class Traceable:
    """A number or a truth that is known when the code runs."""

    __slots__ = ("index", "tape")

    def __init__(self, tape: Tape, index: int) -> None:
        self.tape, self.index = tape, index

    def _value(self, *_: Any) -> Any:
        raise NotTraceable("the value of a number is needed; compute with NumPy, without float()")

    __float__ = __int__ = __index__ = __complex__ = __round__ = __trunc__ = _value

    def __bool__(self) -> bool:
        raise NotTraceable("a branch on a value; use np.where instead")

    __hash__ = object.__hash__


class Symbol(Traceable):
    """A number that is known when the code runs."""

    __slots__ = ()

    def _negated(self) -> "Symbol | None":
        """The operand of a negation; None for other operations."""
        kind, operands = self.tape.operations[self.index]
        return Symbol(self.tape, int(operands[0])) if kind == "negate" else None

    def __neg__(self) -> "Symbol":
        taken = self._negated()
        return self.tape.record("negate", self) if taken is None else taken

    def __pos__(self) -> "Symbol":
        return self

    def __abs__(self) -> "Symbol":
        return self.tape.record("abs", self)

    def __add__(self, other: Any) -> Any:
        if not isinstance(other := number(other), Symbol):
            if other is NotImplemented:
                return other
            return self if other == 0.0 else self.tape.record("add", self, other)
        if (taken := other._negated()) is not None:
            return _difference(self, taken)
        if (taken := self._negated()) is not None:
            return _difference(other, taken)
        return self.tape.record("add", *sorted((self, other), key=_place))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if not isinstance(other := number(other), Symbol):
            return other if other is NotImplemented else self + -other
        taken = other._negated()
        return _difference(self, other) if taken is None else self + taken

    def __rsub__(self, other: Any) -> Any:
        if (other := number(other)) is NotImplemented:
            return other
        return -self if other == 0.0 else self.tape.record("subtract", other, self)

    def __mul__(self, other: Any) -> Any:
        if (other := number(other)) is NotImplemented:
            return other
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
        return self.tape.record("multiply", self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if (other := number(other)) is NotImplemented:
            return other
        return self if is_one(other) else self.tape.record("divide", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        if (other := number(other)) is NotImplemented:
            return other
        return self.tape.record("divide", other, self)

    def __pow__(self, power: Any) -> Any:
        if isinstance(power, (int, float)):
            if power in (1, 2, 3, 4):
                return functools.reduce(operator.mul, [self] * int(power))
            if power == 0.5:
                return square_root(self)
        return two("pow", math.pow)(self, power)

    def __rpow__(self, base: Any) -> Any:
        return two("pow", math.pow)(base, self)

    def __lt__(self, other: Any) -> Any:
        return _compared("lt", self, other)

    def __gt__(self, other: Any) -> Any:
        return _compared("lt", other, self)

    def __le__(self, other: Any) -> Any:
        return _compared("le", self, other)

    def __ge__(self, other: Any) -> Any:
        return _compared("le", other, self)

    def __eq__(self, other: Any) -> Any:
        return _compared("eq", self, other)

    def __ne__(self, other: Any) -> Any:
        return _compared("ne", self, other)

    __hash__ = object.__hash__

    def conjugate(self) -> "Symbol":
        """NumPy asks for it."""
        return self


class Truth(Traceable):
    """A truth value that is known when the code runs; in arithmetic it is 1.0 or 0.0."""

    __slots__ = ()

    def _as_number(self) -> Any:
        return select(self, 1.0, 0.0)

    def __and__(self, other: Any) -> Any:
        if isinstance(other, Truth):
            return self.tape.record("and", self, other)
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self if other else False

    def __or__(self, other: Any) -> Any:
        if isinstance(other, Truth):
            return self.tape.record("or", self, other)
        if isinstance(other, np.ndarray):
            return NotImplemented
        return True if other else self

    def __invert__(self) -> "Truth":
        return self.tape.record("not", self)

    def __xor__(self, other: Any) -> Any:
        return (self & invert(other)) | (~self & other)

    __rand__, __ror__, __rxor__ = __and__, __or__, __xor__

    def __eq__(self, other: Any) -> Any:
        return self._as_number() == other

    def __ne__(self, other: Any) -> Any:
        return self._as_number() != other

    __hash__ = object.__hash__

    def __add__(self, other: Any) -> Any:
        return self._as_number() + other

    def __sub__(self, other: Any) -> Any:
        return self._as_number() - other

    def __rsub__(self, other: Any) -> Any:
        return other - self._as_number()

    def __mul__(self, other: Any) -> Any:
        return select(self, other, 0.0)

    __radd__, __rmul__ = __add__, __mul__


def number(value: Any) -> Any:
    """A symbol, or a float; NotImplemented for what is no single number."""
    if isinstance(value, Symbol):
        return value
    if isinstance(value, Truth):
        return value._as_number()
    if isinstance(value, np.ndarray):
        return number(value.item()) if value.ndim == 0 else NotImplemented
    return float(value)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim > 0 and value.dtype != object


def is_one(value: Any) -> bool:
    """Whether it is the constant 1."""
    return not isinstance(value, Traceable) and value == 1.0


def _compared(kind: str, one: Any, other: Any) -> Any:
    one, other = number(one), number(other)
    if one is NotImplemented or other is NotImplemented:
        return NotImplemented
    return next(each for each in (one, other) if isinstance(each, Symbol)).tape.record(
        kind, one, other
    )


def _place(symbol: Symbol) -> int:
    return symbol.index


def _difference(one: Symbol, other: Symbol) -> Any:
    if one.index == other.index and one.tape is other.tape:
        return 0.0
    return one.tape.record("subtract", one, other)


def one(kind: str, function: Callable[[float], float]) -> Callable[[Any], Any]:
    """A function of a number or symbol; one that ``math`` has also of an array of numbers."""

    def of(x: Any) -> Any:
        if _is_array(x):
            return getattr(np, function.__name__)(x)
        x = number(x)
        return x.tape.record(kind, x) if isinstance(x, Symbol) else function(x)

    return of


def two(kind: str, function: Callable[[float, float], float]) -> Callable[[Any, Any], Any]:
    """A function of two numbers or symbols, likewise."""

    def of(x: Any, y: Any) -> Any:
        if _is_array(x) or _is_array(y):
            return getattr(np, function.__name__)(x, y)
        x, y = number(x), number(y)
        for each in (x, y):
            if isinstance(each, Symbol):
                return each.tape.record(kind, x, y)
        return function(x, y)

    return of


sine = one("sine", math.sin)
cosine = one("cosine", math.cos)
square_root = one("sqrt", math.sqrt)
signed = two("copysign", math.copysign)  # a number with the sign of another
larger = two("max", lambda x, y: float(np.maximum(x, y)))
smaller = two("min", lambda x, y: float(np.minimum(x, y)))
floor = one("floor", lambda x: float(np.floor(x)))
rounded = one("rint", lambda x: float(np.rint(x)))


def invert(truth: Any) -> Any:
    """Not a truth."""
    return ~truth if isinstance(truth, Truth) else not truth


def truth_of(value: Any) -> Any:
    """The truth of a number: whether it is not zero."""
    if isinstance(value, Truth):
        return value
    return value != 0.0 if isinstance(value, Symbol) else bool(value)


def select(condition: Any, then: Any, otherwise: Any) -> Any:
    """One of two numbers, arrays of them, or truths."""
    if _is_array(condition):
        return np.where(condition, then, otherwise)
    condition = truth_of(condition)
    if not isinstance(condition, Truth):
        return then if condition else otherwise
    if isinstance(then, (Truth, bool)) and isinstance(otherwise, (Truth, bool)):
        return (condition & then) | (~condition & otherwise)
    then, otherwise = number(then), number(otherwise)
    if then is otherwise or (type(then) is type(otherwise) is float and then == otherwise):
        return then
    return condition.tape.record("select", condition, then, otherwise)


def sign(x: Any) -> Any:
    """-1, 0 or 1."""
    x = number(x)
    if not isinstance(x, Symbol):
        return float(np.sign(x))
    return select(x > 0.0, 1.0, select(x < 0.0, -1.0, x))  # also of NaN


def needed(operations: Sequence[Operation], results: Iterable[int]) -> list[int]:
    """The indices of the operations that some results need, in order."""
    wanted = set(results)
    for index in range(len(operations) - 1, -1, -1):
        if index in wanted:
            kind, operands = operations[index]
            if kind != "input":
                wanted.update(each for each in operands if isinstance(each, int))
    return sorted(wanted)
