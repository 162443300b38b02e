"""Sine and cosine of traced angles as sums and products, within a unit in the last place.

The angle less a multiple k of pi / 2, as a sum of two numbers, then polynomials between -pi / 4 and
pi / 4, with the constants of fdlibm (Sun Microsystems, 1993; freely usable). Beyond a million
radians the results are not numbers.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

from ffsm_drake.plugins.tape.numbers import Symbol, Tape, floor, select

_LARGEST = 1e6  # rad
_ROUNDING = 1.5 * 2.0**52  # a number plus this, and minus it, is its nearest integer
_QUARTERS = 6.36619772367581382433e-01  # 2 / pi
# pi / 2 in three pieces of 33 bits or more
_HIGH, _MIDDLE, _LOW = (
    1.57079632673412561417e00,
    6.07710050630396597660e-11,
    2.02226624879595063154e-21,
)
_SINE = (
    1.58969099521155010221e-10, -2.50507602534068634195e-08, 2.75573137070700676789e-06,
    -1.98412698298579493134e-04, 8.33333333332248946124e-03,
)  # fmt: skip
_CUBE = -1.66666666666666324348e-01
_COSINE = (
    -1.13596475577881948265e-11, 2.08757232129817482790e-09, -2.75573143513906633035e-07,
    2.48015872894767294178e-05, -1.38888888888741095749e-03, 4.16666666666666019037e-02,
)  # fmt: skip


def without_angles(
    tape: Tape, results: Mapping[str, Sequence[Symbol | float]]
) -> tuple[Tape, dict[str, list[Symbol | float]]]:
    """Return a tape that has sums and products in place of sines and cosines, and the results on
    it.

    Args: the tape; symbols and numbers, a row of each array of results.
    """
    own, made = Tape(), list[Any]()
    own.loops = tape.loops
    for kind, operands in tape.operations:
        given = operands
        if kind != "input":
            given = tuple(made[each] if isinstance(each, int) else each for each in operands)
        if kind in ("sine", "cosine"):
            made.append(sine_and_cosine(*given)[kind == "cosine"])
        else:
            made.append(own.record(kind, *given))
    return own, {
        array: [made[each.index] if isinstance(each, Symbol) else each for each in row]
        for array, row in results.items()
    }


def sine_and_cosine(angle: Any) -> tuple[Any, Any]:
    """Return sine and cosine of an angle, rad."""
    k = (angle * _QUARTERS + _ROUNDING) - _ROUNDING
    # the remainder x + y
    first, middle = angle - k * _HIGH, k * _MIDDLE
    second = first - middle
    rest = k * _LOW - ((first - second) - middle)
    x = second - rest
    y = (second - x) - rest
    z = x * x
    cube = z * x
    inner = z * (0.5 * y - cube * _polynomial(_SINE, z)) - y
    s = x - (inner - cube * _CUBE)
    half = 0.5 * z
    w = 1.0 - half
    tail = (z * z) * _polynomial(_COSINE, z) - x * y
    c = w + (((1.0 - w) - half) + tail)
    quadrant = k - 4.0 * floor(k * 0.25)
    is_odd = (quadrant == 1.0) | (quadrant == 3.0)
    is_near = angle * angle < _LARGEST**2
    sine, cosine = (select(is_near, select(is_odd, *pair), math.nan) for pair in ((c, s), (s, c)))
    is_left = (quadrant == 1.0) | (quadrant == 2.0)
    return select(quadrant >= 2.0, -sine, sine), select(is_left, -cosine, cosine)


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    return functools.reduce(lambda total, each: total * x + each, coefficients)
