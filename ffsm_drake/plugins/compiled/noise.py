"""The samples of Drake's Gaussian sources, with their bits.

A source draws 32-bit numbers from a Mersenne Twister (NumPy's), and makes two normal numbers of
each accepted pair by the polar method, as the C++ library does. Its own seed is the first number
that the run's seed gives.
"""

import functools
import math
from collections.abc import Callable

import numpy as np

from ffsm_drake.plugins.generated.code import declarations, function
from ffsm_drake.plugins.generated.compiling import Code, registers
from ffsm_drake.tape.arrays import inputs
from ffsm_drake.tape.numbers import Tape, one, smaller, square_root

_LARGEST = float(np.nextafter(1.0, 0.0))


def samples(seed: int, count: int, size: int) -> np.ndarray:
    """Return what a source of ``size`` numbers gives at each sample (count, size)."""
    first = _generator(seed).random_raw()
    # A source draws once before its first update.
    return _normal(_generator(int(first)), (count + 1) * size).reshape(count + 1, size)[1:]


def _generator(seed: int) -> np.random.MT19937:
    """A twister that begins as C++'s with a seed."""
    made = np.random.MT19937()
    made.state = np.random.RandomState(seed).get_state(legacy=False)
    return made


def _normal(generator: np.random.MT19937, count: int) -> np.ndarray:
    """Normal numbers (count)."""
    parts, found = list[np.ndarray](), 0
    while found < count:
        pairs = int(0.64 * (count - found)) + 64  # pi / 4 of which are accepted
        drawn = generator.random_raw(4 * pairs).astype(float)
        made = np.empty((pairs, 3))
        _polar()(drawn.ctypes.data, made.ctypes.data, pairs)
        accepted = (made[:, 2] <= 1.0) & (made[:, 2] != 0.0)
        parts.append(made[accepted, :2].ravel())
        found += parts[-1].size
    return np.concatenate(parts)[:count]


@functools.cache
def _polar() -> Callable[[int, int, int], None]:
    """The compiled function from four 32-bit numbers to two normal ones, and the square of their
    point's distance from the origin.
    """
    tape = Tape()
    raw = inputs(tape, "raw", (4,))
    x, y = (
        2.0 * smaller((low + high * 2.0**32) * 2.0**-64, _LARGEST) - 1.0
        for low, high in (raw[:2], raw[2:])
    )
    square = x * x + y * y
    factor = square_root(-2.0 * one("log", math.log)(square) / square)
    results = {"made": [y * factor, x * factor, square]}
    text = "\n".join((
        *declarations(registers()), function(registers(), "polar", tape, {"raw": 4}, results),
    ))  # fmt: skip
    code = Code(text, lambda: text)
    polar = code.function("polar", 2)

    def call(raw: int, made: int, pairs: int, _held: Code = code) -> None:
        polar(raw, made, pairs)

    return call
