"""Vectors and matrices of numbers or symbols, as lists."""

from collections.abc import Sequence
from typing import Any

Vector = list[Any]  # three numbers or symbols
Matrix = list[Vector]  # rows

ZERO: Vector = [0.0, 0.0, 0.0]


def dot(a: Sequence[Any], b: Sequence[Any]) -> Any:
    total: Any = 0.0
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def plus(*several: Sequence[Any]) -> Vector:
    return [sum(each[1:], each[0]) for each in zip(*several, strict=True)]


def minus(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [x - y for x, y in zip(a, b, strict=True)]


def scaled(factor: Any, a: Sequence[Any]) -> Vector:
    return [factor * x for x in a]


def cross(a: Sequence[Any], b: Sequence[Any]) -> Vector:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]


def skew(a: Sequence[Any]) -> Matrix:
    """The matrix of ``cross(a, .)``."""
    x, y, z = a
    return [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]


def transposed(matrix: Sequence[Sequence[Any]]) -> Matrix:
    return [list(column) for column in zip(*matrix, strict=True)]


def times(matrix: Sequence[Sequence[Any]], a: Sequence[Any]) -> Vector:
    """Matrix times vector."""
    return [dot(row, a) for row in matrix]


def product(a: Sequence[Sequence[Any]], b: Sequence[Sequence[Any]]) -> Matrix:
    """Matrix times matrix."""
    columns = transposed(b)
    return [[dot(row, column) for column in columns] for row in a]


def sum_of(*matrices: Sequence[Sequence[Any]]) -> Matrix:
    return [plus(*rows) for rows in zip(*matrices, strict=True)]


def symmetric(matrix: Sequence[Sequence[Any]]) -> Matrix:
    """With the upper half in the lower one, which then needs no computation."""
    size = range(len(matrix))
    return [[matrix[min(i, j)][max(i, j)] for j in size] for i in size]


def diagonal(x: Any) -> Matrix:
    return [[x, 0.0, 0.0], [0.0, x, 0.0], [0.0, 0.0, x]]
