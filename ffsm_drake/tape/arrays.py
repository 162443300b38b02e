"""Arrays of symbols: unchanged NumPy code runs on them.

``Traced`` is an array of objects. NumPy hands its functions over (``__array_ufunc__`` and
``__array_function__``), and the rules below apply them to the symbols, one by one. What has no rule
raises NotTraceable.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.choice import is_known
from ffsm_drake.tape import numbers
from ffsm_drake.tape.numbers import Loop, NotTraceable, Tape, Traceable, one, select, two


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


_SWEEPS = 8  # of ``svd``, enough for 7 columns
_TINY = 1e-300


class Traced(np.ndarray):
    """An array of numbers and symbols."""

    __array_priority__ = 1000.0  # its type is that of results with other arrays

    def __array_ufunc__(
        self, ufunc: Any, method: str, *given: Any, out: Any = None, where: Any = True, **more: Any
    ) -> Any:
        values, name = [_plain(each) for each in given], ufunc.__name__
        for unused in ("dtype", "casting", "order", "subok"):
            more.pop(unused, None)
        if method == "reduce":
            if where is not True:
                raise NotTraceable(f"np.{name}.reduce with where=")
            made = _reduced(name, values[0], **more)
        elif method != "__call__" or more:
            raise NotTraceable(f"np.{name}.{method}" + "".join(f" with {each}=" for each in more))
        elif name in _BY_NAME:
            made = _each(_BY_NAME[name], *values)
        elif name in _OPERATORS:
            made = ufunc(*map(_objects, values), dtype=object)
        else:
            raise NotTraceable(f"np.{name}")
        target = None if out is None else out[0]
        if where is not True:
            made = _each(select, where, made, 0.0 if target is None else target)
        if target is None:
            return wrapped(made)
        if target.dtype != object:
            raise NotTraceable("out= an array of numbers")
        target.view(np.ndarray)[...] = made
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        if function in _RULES:
            return wrapped(_RULES[function](*args, **kwargs))
        if function.__module__ == "numpy.linalg":
            raise NotTraceable(f"np.linalg.{function.__name__}")
        return wrapped(super().__array_function__(function, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, (Traced, Traceable)):
            key = _known(key, "an index that is known only when it runs")
        return super().__getitem__(key)

    def __setitem__(self, key: Any, value: Any) -> None:
        if isinstance(key, Traced) and _has_symbols(key):
            if np.ndim(value) and np.shape(value) != self.shape:
                raise NotTraceable("an assignment of fewer values under a mask")
            now = self.view(np.ndarray)
            now[...] = _each(select, key, value, now)
            return
        super().__setitem__(_known(key, "an index") if isinstance(key, Traced) else key, value)

    def __pow__(self, power: Any, _modulo: Any = None) -> Any:
        return np.power(self, power)  # an array's own method compares the power

    def __bool__(self) -> bool:
        if self.size == 1:
            return bool(self.item())
        raise ValueError("the truth of an array is ambiguous")

    def astype(self, dtype: Any, *_: Any, **__: Any) -> Any:
        """Floats are what it holds; nothing else is known."""
        if np.dtype(dtype) in (float, object):
            return wrapped(_each(numbers.number, self))
        return _known(self, f"astype({np.dtype(dtype).name})").astype(dtype)


_RULES: dict[Any, Callable[..., Any]] = {}


def traced(values: Any) -> Any:
    """An array of symbols and numbers, from nested lists or an array."""
    return np.asarray(values, dtype=object).view(Traced)


def inputs(tape: Tape, array: str, shape: Sequence[int]) -> Any:
    """An array of symbols: an input of a traced function."""
    return traced(tape.inputs(array, math.prod(shape))).reshape(shape)


def repeated(
    step: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]],
    state: Mapping[str, Any],
    fixed: Mapping[str, Any],
    *,
    most: int,
) -> Mapping[str, Any]:
    """Return the state after steps of a loop, while its first array, of one number, is not zero.

    Args:
      step: returns the state after one from that before it and what is fixed; of arrays by name.
      state: before the first step.
      fixed: what every step reads.
      most: steps.
    """
    given = [*state.values(), *fixed.values()]
    if all(map(is_known, given)):
        for _ in range(most):
            if not next(iter(state.values())):
                break
            state = step(state, fixed)
        return state
    symbols = [each for array in given for each in _objects(array).ravel()]
    tape = next(each.tape for each in symbols if isinstance(each, Traceable))
    own = Tape()
    before, read = (
        _parted(inputs(own, which, (sum(map(np.size, of.values())),)), of)
        for which, of in (("state", state), ("fixed", fixed))
    )
    made = step(before, read)
    after = [numbers.number(each) for name in state for each in _objects(made[name]).ravel()]
    size = len(after)
    found = tape.repeat(Loop(own, after, len(symbols) - size, most), symbols[:size], symbols[size:])
    return _parted(traced(found), state)


def _parted(values: Any, shapes: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers one after the other as arrays in the shapes of others."""
    found, first = {}, 0
    for name, like in shapes.items():
        found[name] = values[first : first + np.size(like)].reshape(np.shape(like))
        first += np.size(like)
    return found


def wrapped(made: Any) -> Any:
    """A result of NumPy: an array of objects as ``Traced``, one without dimensions as its value."""
    if isinstance(made, np.ndarray):
        if made.dtype != object:
            return made
        return made.item() if made.ndim == 0 else made.view(Traced)
    return type(made)(map(wrapped, made)) if type(made) in (tuple, list) else made


def _plain(value: Any) -> Any:
    return value.view(np.ndarray) if isinstance(value, Traced) else value


def _objects(value: Any) -> np.ndarray:
    value = value.item() if isinstance(value, np.generic) else _plain(value)
    return np.asarray(value, dtype=object)


def _each(function: Callable[..., Any], *values: Any) -> Any:
    """A function of the entries of arrays."""
    with np.errstate(invalid="ignore"):  # of constants that are not finite
        return np.frompyfunc(function, len(values), 1)(*map(_objects, values))


def _has_symbols(values: Any) -> bool:
    return any(isinstance(each, Traceable) for each in _objects(values).ravel())


def _known(values: Any, what: str) -> np.ndarray:
    """The values of an array without symbols."""
    if _has_symbols(values):
        raise NotTraceable(what)
    return np.array(_objects(values).tolist())


def _reduced(
    name: str, values: Any, axis: Any = 0, keepdims: bool = False, initial: Any = None
) -> Any:
    if name not in _REDUCED:
        raise NotTraceable(f"np.{name}.reduce")
    function, start = _REDUCED[name]
    start = start if initial is None or type(initial) is not float else initial
    values = _objects(values)
    axes = range(values.ndim) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    for each in sorted((number % values.ndim for number in axes), reverse=True):
        parts = list(np.moveaxis(values, each, 0))
        if start is not None and (not parts or initial is not None):
            parts.insert(0, np.full(np.delete(values.shape, each), start, dtype=object))
        total = parts[0]
        for part in parts[1:]:
            total = _each(function, total, part)
        values = np.asarray(total, dtype=object)
        values = np.expand_dims(values, each) if keepdims else values
    return values


def rule(*functions: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register what NumPy's functions do with symbols."""

    def register(own: Callable[..., Any]) -> Callable[..., Any]:
        _RULES.update(dict.fromkeys(functions, own))
        return own

    return register


@rule(np.where)
def _where(condition: Any, *cases: Any) -> Any:
    if not cases:
        raise NotTraceable("np.where without values")
    return _each(select, condition, *cases)


@rule(np.clip)
def _clip(x: Any, a_min: Any = None, a_max: Any = None, **more: Any) -> Any:
    low, high = more.get("min", a_min), more.get("max", a_max)
    x = traced(_plain(x)) if low is None else np.maximum(traced(_plain(x)), low)
    return x if high is None else np.minimum(x, high)


@rule(np.argmin)
def _argmin(a: Any, axis: Any = None, **more: Any) -> Any:
    """The place of the first least number; without an end, NaN is none."""
    if more or np.ndim(a) != 1 or axis not in (None, 0, -1):
        raise NotTraceable("np.argmin other than that of a vector")
    least, place = a[0], 0.0
    for at, each in enumerate(a[1:], start=1):
        is_less = each < least
        least, place = select(is_less, each, least), select(is_less, float(at), place)
    return place


@rule(np.zeros_like)
def _zeros_like(x: Any, *, shape: Any = None, **_: Any) -> Any:
    return traced(np.zeros(np.shape(x) if shape is None else shape))


@rule(np.ones_like)
def _ones_like(x: Any, **_: Any) -> Any:
    return traced(np.ones(np.shape(x)))


@rule(np.full_like)
def _full_like(x: Any, fill_value: Any, **_: Any) -> Any:
    return np.broadcast_to(_objects(fill_value), np.shape(x)).copy()


@rule(np.round, np.around)
def _round(x: Any, decimals: int = 0, **_: Any) -> Any:
    scale = 10.0**decimals
    return np.rint(traced(_plain(x)) * scale) * (1.0 / scale)


@rule(np.sinc)
def _sinc(x: Any) -> Any:
    y = math.pi * traced(_plain(x))
    near = np.where(y == 0.0, 1.0, y)
    return np.where(y == 0.0, 1.0, np.sin(near) / near)


@rule(np.cross)
def _cross(a: Any, b: Any, *, axis: int = -1, **more: Any) -> Any:
    a, b = (np.moveaxis(traced(_plain(each)), axis, 0) for each in (a, b))
    if more or len(a) != 3 or len(b) != 3:
        raise NotTraceable("np.cross of other than vectors of three")
    (ax, ay, az), (bx, by, bz) = a, b
    parts = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
    return np.stack([_objects(each) for each in parts], axis=axis)


@rule(np.linalg.norm)
def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if ord not in (None, 2) or (ord == 2 and np.ndim(x) > 1 and axis is None):
        raise NotTraceable(f"np.linalg.norm of order {ord}")
    square = traced(_plain(x)) * traced(_plain(x))
    return np.sqrt(traced(_plain(square.sum(axis=axis, keepdims=keepdims))))


@rule(np.linalg.solve)
def _solve(a: Any, b: Any) -> Any:
    """By elimination without exchange of rows: for matrices that are positive definite."""
    a, b = _objects(a), _objects(b)
    if a.ndim > 2:
        rights = np.broadcast_to(b, (*a.shape[:-2], *b.shape[-2:])) if b.ndim > 1 else b
        return np.stack([_objects(_solve(*each)) for each in zip(a, rights, strict=True)])
    a, vector = a.copy(), b.ndim == 1
    b = (b[:, None] if vector else b).copy()
    pivots = []
    for j in range(len(a)):
        pivots.append(1.0 / a[j, j])
        for i in range(j + 1, len(a)):
            factor = a[i, j] * pivots[j]
            if isinstance(factor, Traceable) or factor != 0.0:
                a[i, j + 1 :] = a[i, j + 1 :] - factor * a[j, j + 1 :]
                b[i] = b[i] - factor * b[j]
    for i in reversed(range(len(a))):
        for j in range(i + 1, len(a)):
            b[i] = b[i] - a[i, j] * b[j]
        b[i] = b[i] * pivots[i]
    return b[:, 0] if vector else b


@rule(np.linalg.svd)
def _svd(a: Any, full_matrices: bool = True, compute_uv: bool = True, **_: Any) -> Any:
    """By rotations of pairs of columns, in a fixed number of sweeps. Directions without size are
    zero.
    """
    a = _objects(a)
    if full_matrices or not compute_uv or a.ndim != 2:
        raise NotTraceable("np.linalg.svd other than that of one matrix with full_matrices=False")
    if a.shape[0] < a.shape[1]:
        left, sizes, right = _svd(a.T, full_matrices=False)
        return right.T, sizes, left.T
    columns = [list(column) for column in a.T]
    turned = [list(row) for row in np.eye(len(columns))]
    pairs = [(i, j) for i in range(len(columns)) for j in range(i + 1, len(columns))]
    for i, j in pairs * _SWEEPS:
        across = _dot(columns[i], columns[j])
        apart = _dot(columns[j], columns[j]) - _dot(columns[i], columns[i])
        root = numbers.square_root(apart * apart + 4.0 * across * across)
        tangent = 2.0 * across * numbers.signed(1.0, apart) / (abs(apart) + root + _TINY)
        cosine = 1.0 / numbers.square_root(1.0 + tangent * tangent)
        for rows in (columns, turned):
            rows[i], rows[j] = (
                [cosine * (x - tangent * y) for x, y in zip(rows[i], rows[j], strict=True)],
                [cosine * (y + tangent * x) for x, y in zip(rows[i], rows[j], strict=True)],
            )
    sizes = [numbers.square_root(_dot(column, column)) for column in columns]
    found = [[s, *c, *t] for s, c, t in zip(sizes, columns, turned, strict=True)]
    for i, j in pairs:  # the largest first
        is_less = found[i][0] < found[j][0]
        found[i], found[j] = (
            [select(is_less, *both) for both in zip(found[k], found[n], strict=True)]
            for k, n in ((j, i), (i, j))
        )
    made = _objects(found)
    left = made[:, 1 : 1 + len(a)].T / _each(lambda size: numbers.larger(size, _TINY), made[:, 0])
    return left, made[:, 0], made[:, 1 + len(a) :]


def _dot(a: Any, b: Any) -> Any:
    return sum((x * y for x, y in zip(a[1:], b[1:], strict=True)), a[0] * b[0])


@rule(np.linalg.inv)
def _inv(a: Any) -> Any:
    return _solve(a, np.broadcast_to(np.eye(np.shape(a)[-1]), np.shape(a)))


def _ufunc(self: Any, ufunc: Any, method: str, *given: Any, **more: Any) -> Any:
    own = [traced(each) if isinstance(each, Traceable) else each for each in given]
    return getattr(ufunc, method)(*own, **more)


def _function(self: Any, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
    return function(*map(_deep, args), **kwargs)


def _deep(value: Any) -> Any:
    if isinstance(value, Traceable):
        return traced(value)
    return type(value)(map(_deep, value)) if type(value) in (list, tuple) else value


Traceable.__array_ufunc__ = _ufunc  # type: ignore[attr-defined]
Traceable.__array_function__ = _function  # type: ignore[attr-defined]
