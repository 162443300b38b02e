"""Functions of NumPy, entry by entry, on arrays of objects: numbers and symbols."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.plugins.tape import numbers
from ffsm_drake.plugins.tape.numbers import NotTraceable, one, select, two


def _ceil(x: Any) -> Any:
    return -numbers.floor(-x)


def _logical(name: str) -> Callable[[Any, Any], Any]:
    def of(x: Any, y: Any) -> Any:
        x, y = numbers.truth_of(x), numbers.truth_of(y)
        return x & y if name == "and" else x | y

    return of


def _hypot(x: Any, y: Any) -> Any:
    return numbers.square_root(x * x + y * y)


# Functions of NumPy by name, for numbers or symbols. Arithmetic and comparisons need no rule.
_BY_NAME: Mapping[str, Callable[..., Any]] = {
    "absolute": abs, "fabs": abs, "negative": lambda x: -x, "square": lambda x: x * x,
    "reciprocal": lambda x: 1.0 / x, "sqrt": numbers.square_root, "hypot": _hypot,
    "sin": numbers.sine, "cos": numbers.cosine, "sign": numbers.sign,
    "maximum": numbers.larger, "fmax": numbers.larger,
    "minimum": numbers.smaller, "fmin": numbers.smaller,
    "clip": lambda x, low, high: numbers.smaller(numbers.larger(x, low), high),
    "copysign": numbers.signed, "arctan2": two("atan2", math.atan2),
    "floor": numbers.floor, "ceil": _ceil, "rint": numbers.rounded,
    "trunc": lambda x: select(x < 0.0, _ceil(x), numbers.floor(x)),
    "remainder": lambda x, y: x - numbers.floor(x / y) * y,
    "floor_divide": lambda x, y: numbers.floor(x / y),
    "float_power": lambda x, y: x**y,
    "logical_and": _logical("and"), "logical_or": _logical("or"),
    "logical_not": lambda x: numbers.invert(numbers.truth_of(x)),
    "bitwise_and": _logical("and"), "bitwise_or": _logical("or"),
    "bitwise_xor": lambda x, y: numbers.truth_of(x) ^ numbers.truth_of(y),
    "invert": numbers.invert,
    "isnan": lambda x: x != x, "isfinite": lambda x: abs(x) < math.inf,
    "isinf": lambda x: abs(x) == math.inf,
    "deg2rad": lambda x: x * (math.pi / 180.0), "radians": lambda x: x * (math.pi / 180.0),
    "rad2deg": lambda x: x * (180.0 / math.pi), "degrees": lambda x: x * (180.0 / math.pi),
    **{name: one(name, getattr(math, name))
       for name in ("tan", "exp", "log", "tanh", "sinh", "cosh", "expm1", "log1p")},
    **{f"arc{name}": one(f"a{name}", getattr(math, f"a{name}")) for name in ("sin", "cos", "tan")},
}  # fmt: skip
_OPERATORS = {
    "add", "subtract", "multiply", "divide", "true_divide", "power", "positive", "conjugate",
    "less", "less_equal", "greater", "greater_equal", "equal", "not_equal",
    "matmul", "vecdot", "matvec", "vecmat",
}  # fmt: skip
_REDUCED = {
    "add": (lambda x, y: x + y, 0.0), "multiply": (lambda x, y: x * y, 1.0),
    "maximum": (numbers.larger, None), "minimum": (numbers.smaller, None),
    "logical_and": (_logical("and"), True), "logical_or": (_logical("or"), False),
}  # fmt: skip


def objects(value: Any) -> np.ndarray:
    """An array of the objects in an array or a nested list, or of a number or symbol, ()."""
    return np.asarray(value.item() if isinstance(value, np.generic) else value, dtype=object)


def each(function: Callable[..., Any], *values: Any) -> Any:
    """A function of the entries of arrays."""
    with np.errstate(invalid="ignore"):  # of constants that are not finite
        return np.frompyfunc(function, len(values), 1)(*map(objects, values))


def called(function: np.ufunc, *values: Any) -> Any:
    """The results of a function of NumPy."""
    name = function.__name__
    if name in _BY_NAME:
        return each(_BY_NAME[name], *values)
    if name in _OPERATORS:
        return function(*map(objects, values), dtype=object)
    raise NotTraceable(f"np.{name}")


def reduced(
    name: str, values: Any, axis: Any = 0, keepdims: bool = False, initial: Any = None
) -> Any:
    """The results of a function's ``reduce``, such as the sum of entries along axes for ``add``."""
    if name not in _REDUCED:
        raise NotTraceable(f"np.{name}.reduce")
    function, start = _REDUCED[name]
    start = start if initial is None or type(initial) is not float else initial
    values = objects(values)
    axes = range(values.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    for along in sorted((number % values.ndim for number in axes), reverse=True):
        parts = list(np.moveaxis(values, along, 0))
        if start is not None and (not parts or initial is not None):
            parts.insert(0, np.full(np.delete(values.shape, along), start, dtype=object))
        total = parts[0]
        for part in parts[1:]:
            total = each(function, total, part)
        values = np.asarray(total, dtype=object)
        values = np.expand_dims(values, along) if keepdims else values
    return values
