"""Tracking errors on symbols: ``coordinates.tracking_errors``, but for rounding.

The quaternion of the rotation from the actual attitude to the desired one has a scalar part c and a
vector part of length s. Half the rotation's angle is h = atan2(s, |c|) = 4 atan(tan(h / 4)), and
the tangents of h / 2 and h / 4 follow from s and c, so that the series of fdlibm (Sun Microsystems,
1993; freely usable) for small angles does.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.so3 import times_conjugate
from ffsm_drake.plugins.tape.numbers import select, signed, square_root

_TINY = 1e-300  # keeps divisors from zero, and changes no number of any size
_SERIES = (  # of 1 - atan(x) / x in x^2
    3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
    -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
    6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
    -3.65315727442169155270e-02, 1.62858201153657823623e-02,
)  # fmt: skip


_NEAR = 0.01  # h^2 up to which the weight is a series, whose derivative has no zero divisor
_WEIGHT = (1.0 / 12.0, 1.0 / 180.0, 1.0 / 1890.0, 1.0 / 18900.0, 1.0 / 187110.0)  # in h^2


def tracking_errors(desired: Any, actual: Any, num_positions: int) -> tuple[Any, Any]:
    """Tracking error and its rate (nv each) from states [q; v] (nq + nv)."""
    split = num_positions
    c, *parts = times_conjugate(desired[:4], actual[:4])
    axis = np.stack(parts)
    s_square = axis @ axis
    s, norm, near = square_root(s_square + _TINY), square_root(s_square + c * c), signed(c, 1.0)
    tangent = s * (1.0 / (near + norm))  # tan(h / 2)
    tangent = tangent * (1.0 / (1.0 + square_root(1.0 + tangent * tangent)))  # tan(h / 4)
    square = tangent * tangent
    half = 4.0 * (tangent - tangent * (square * _polynomial(_SERIES, square)))
    e = 2.0 * half * (1.0 / s) * signed(1.0, c) * axis
    w_d, w = desired[split : split + 3], actual[split : split + 3]
    difference, half_sum = w_d - w, 0.5 * (w_d + w)
    weight = _weight(half * half, half * near * (1.0 / s))
    rate = difference + np.cross(e, weight * np.cross(e, difference) - half_sum)
    others = desired - actual
    return (
        np.concatenate([e, others[4:split]]),
        np.concatenate([rate, others[split + 3 :]]),
    )


def _polynomial(coefficients: Sequence[float], x: Any) -> Any:
    total: Any = coefficients[-1]
    for each in reversed(coefficients[:-1]):
        total = each + x * total
    return total


def _weight(square: Any, h_cot_h: Any) -> Any:
    """(1 - h cot(h)) / (4 h^2)."""
    series = _polynomial(_WEIGHT, square)
    return select(square < _NEAR, series, (1.0 - h_cot_h) * (1.0 / (4.0 * square)))
