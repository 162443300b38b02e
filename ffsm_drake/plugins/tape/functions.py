"""What functions of NumPy do with arrays of numbers and symbols."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ffsm_drake.plugins.tape import numbers
from ffsm_drake.plugins.tape.elements import each, objects, reduced
from ffsm_drake.plugins.tape.numbers import NotTraceable, Traceable, select

# Function of NumPy -> what it does with arrays of objects.
RULES: dict[Any, Callable[..., Any]] = {}
_SWEEPS = 8  # of ``svd``, enough for 7 columns
_TINY = 1e-300


def rule(*functions: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register what NumPy's functions do with symbols."""

    def register(own: Callable[..., Any]) -> Callable[..., Any]:
        RULES.update(dict.fromkeys(functions, own))
        return own

    return register


@rule(np.where)
def _where(condition: Any, *cases: Any) -> Any:
    if not cases:
        raise NotTraceable("np.where without values")
    return each(select, condition, *cases)


@rule(np.clip)
def _clip(x: Any, a_min: Any = None, a_max: Any = None, **more: Any) -> Any:
    low, high = more.get("min", a_min), more.get("max", a_max)
    x = objects(x) if low is None else each(numbers.larger, x, low)
    return x if high is None else each(numbers.smaller, x, high)


@rule(np.argmin)
def _argmin(a: Any, axis: Any = None, **more: Any) -> Any:
    """The place of the first least number; without an end, NaN is none."""
    if more or np.ndim(a) != 1 or axis not in (None, 0, -1):
        raise NotTraceable("np.argmin other than that of a vector")
    least, place = a[0], 0.0
    for at, value in enumerate(a[1:], start=1):
        is_less = value < least
        least, place = select(is_less, value, least), select(is_less, float(at), place)
    return place


@rule(np.zeros_like)
def _zeros_like(x: Any, *, shape: Any = None, **_: Any) -> Any:
    return objects(np.zeros(np.shape(x) if shape is None else shape))


@rule(np.ones_like)
def _ones_like(x: Any, **_: Any) -> Any:
    return objects(np.ones(np.shape(x)))


@rule(np.full_like)
def _full_like(x: Any, fill_value: Any, **_: Any) -> Any:
    return np.broadcast_to(objects(fill_value), np.shape(x)).copy()


@rule(np.round, np.around)
def _round(x: Any, decimals: int = 0, **_: Any) -> Any:
    scale = 10.0**decimals
    return each(numbers.rounded, objects(x) * scale) * (1.0 / scale)


@rule(np.sinc)
def _sinc(x: Any) -> Any:
    def of(x: Any) -> Any:
        y = math.pi * x
        near = select(y == 0.0, 1.0, y)
        return select(y == 0.0, 1.0, numbers.sine(near) / near)

    return each(of, x)


@rule(np.cross)
def _cross(a: Any, b: Any, *, axis: int = -1, **more: Any) -> Any:
    a, b = (np.moveaxis(objects(vectors), axis, 0) for vectors in (a, b))
    if more or len(a) != 3 or len(b) != 3:
        raise NotTraceable("np.cross of other than vectors of three")
    (ax, ay, az), (bx, by, bz) = a, b
    parts = [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
    return np.stack([objects(part) for part in parts], axis=axis)


@rule(np.linalg.norm)
def _norm(x: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    if ord not in (None, 2) or (ord == 2 and np.ndim(x) > 1 and axis is None):
        raise NotTraceable(f"np.linalg.norm of order {ord}")
    square = objects(x) * objects(x)
    return each(numbers.square_root, reduced("add", square, axis, keepdims))


@rule(np.linalg.solve)
def _solve(a: Any, b: Any) -> Any:
    """By elimination without exchange of rows: for matrices that are positive definite."""
    a, b = objects(a), objects(b)
    if a.ndim > 2:
        rights = np.broadcast_to(b, (*a.shape[:-2], *b.shape[-2:])) if b.ndim > 1 else b
        return np.stack([_solve(*both) for both in zip(a, rights, strict=True)])
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
    a = objects(a)
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
    made = objects(found)
    left = made[:, 1 : 1 + len(a)].T / each(lambda size: numbers.larger(size, _TINY), made[:, 0])
    return left, made[:, 0], made[:, 1 + len(a) :]


def _dot(a: Any, b: Any) -> Any:
    return sum((x * y for x, y in zip(a[1:], b[1:], strict=True)), a[0] * b[0])


@rule(np.linalg.inv)
def _inv(a: Any) -> Any:
    return _solve(a, np.broadcast_to(np.eye(np.shape(a)[-1]), np.shape(a)))
