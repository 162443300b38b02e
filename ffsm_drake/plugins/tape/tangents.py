"""Derivatives on a tape: along a direction of its inputs, operation by operation.

Roots and powers below one have no derivative at zero. It is zero here, as the mean from both sides
of |x|^p.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from ffsm_drake.plugins.tape import numbers
from ffsm_drake.plugins.tape.numbers import (
    TRUTHS,
    NotTraceable,
    Symbol,
    Tape,
    Traceable,
    Truth,
    needed,
    one,
    select,
)

_exp, _log, _tanh = (one(name, getattr(math, name)) for name in ("exp", "log", "tanh"))
_sinh, _cosh = (one(name, getattr(math, name)) for name in ("sinh", "cosh"))


def _by_sign(x: Any) -> Any:
    return select(x < 0.0, -1.0, 1.0)


# Kind of an operation -> its partial derivatives, from its result and its operands.
_PARTIAL: Mapping[str, Callable[..., Sequence[Any]]] = {
    "add": lambda y, a, b: (1.0, 1.0),
    "subtract": lambda y, a, b: (1.0, -1.0),
    "multiply": lambda y, a, b: (b, a),
    "divide": lambda y, a, b: (1.0 / b, -y / b),
    "negate": lambda y, a: (-1.0,),
    "abs": lambda y, a: (numbers.sign(a),),
    "sqrt": lambda y, a: (select(a == 0.0, 0.0, 0.5 / y),),
    "sine": lambda y, a: (numbers.cosine(a),),
    "cosine": lambda y, a: (-numbers.sine(a),),
    "copysign": lambda y, a, b: (_by_sign(a) * _by_sign(b), 0.0),
    "floor": lambda y, a: (0.0,),
    "rint": lambda y, a: (0.0,),
    "tan": lambda y, a: (1.0 + y * y,),
    "exp": lambda y, a: (y,),
    "expm1": lambda y, a: (1.0 + y,),
    "log": lambda y, a: (1.0 / a,),
    "log1p": lambda y, a: (1.0 / (1.0 + a),),
    "tanh": lambda y, a: (1.0 - y * y,),
    "sinh": lambda y, a: (_cosh(a),),
    "cosh": lambda y, a: (_sinh(a),),
    "asin": lambda y, a: (1.0 / numbers.square_root(1.0 - a * a),),
    "acos": lambda y, a: (-1.0 / numbers.square_root(1.0 - a * a),),
    "atan": lambda y, a: (1.0 / (1.0 + a * a),),
    "atan2": lambda y, a, b: (b / (a * a + b * b), -a / (a * a + b * b)),
    "pow": lambda y, a, b: (_of_base(a, b), _of_exponent(y, a, b)),
}


# Kind of a choice between two operands -> whether it is the first of them; the other may have no
# derivative there.
_CHOSEN: Mapping[str, Callable[..., Any]] = {
    "max": lambda a, b: a > b,
    "min": lambda a, b: a < b,
    "select": lambda condition, a, b: condition,
}


def _of_base(a: Any, b: Any) -> Any:
    slope = b * a ** (b - 1.0)
    return select(a == 0.0, select(b == 1.0, 1.0, 0.0), slope) if isinstance(a, Symbol) else 0.0


def _of_exponent(y: Any, a: Any, b: Any) -> Any:
    return y * _log(a) if isinstance(b, Symbol) else 0.0


def tangents(tape: Tape, results: Sequence[Any], seeds: Mapping[int, Any]) -> list[Any]:
    """The derivative of each result along a direction.

    Args:
      tape: the tape of the results, which grows.
      results: symbols and numbers.
      seeds: operation of an input -> the direction's entry. Other inputs are constant.
    """
    found: dict[int, Any] = dict(seeds)
    operations = tape.operations
    wanted = needed(operations, [each.index for each in results if isinstance(each, Symbol)])
    for index in wanted:
        kind, operands = operations[index]
        if kind == "input" or kind in TRUTHS:
            continue
        if not any(isinstance(each, int) and each in found for each in operands):
            continue
        values = [_value(tape, each) for each in operands]
        if kind in _CHOSEN:
            slopes = [
                found.get(each, 0.0) if isinstance(each, int) else 0.0 for each in operands[-2:]
            ]
            total = select(_CHOSEN[kind](*values), *slopes)
        elif kind in ("loop", "entry"):
            raise NotTraceable("the derivative of a loop")
        else:
            partial, total = _PARTIAL[kind](Symbol(tape, index), *values), 0.0
            for operand, slope in zip(operands, partial, strict=True):
                if isinstance(operand, int) and operand in found:
                    total = total + slope * found[operand]
        if isinstance(total, Traceable) or total != 0.0:
            found[index] = total
    return [found.get(each.index, 0.0) if isinstance(each, Symbol) else 0.0 for each in results]


def _value(tape: Tape, operand: Any) -> Any:
    """The operand of an operation: a symbol, a truth or a number."""
    if not isinstance(operand, int):
        return operand
    kind = Truth if tape.operations[operand].kind in TRUTHS else Symbol
    return kind(tape, operand)
