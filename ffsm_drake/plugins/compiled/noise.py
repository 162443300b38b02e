"""The samples of Drake's Gaussian sources, with their bits.

A source draws 32-bit numbers from a Mersenne Twister (NumPy's), and makes two normal numbers of
each accepted pair by the polar method, as the C++ library does. Its own seed is the first number
that the run's seed gives.
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ffsm_drake.plugins.compiled.code import declarations, function
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.tape.arrays import inputs
from ffsm_drake.tape.numbers import Tape, one, smaller, square_root

_LARGEST = float(np.nextafter(1.0, 0.0))
_PAIRS = 2**12  # at once, so that they stay in the cache


class Noise(NamedTuple):
    """Samples of deviation 1 of a run's sensors."""

    white: np.ndarray  # (samples, size)
    start: np.ndarray  # (n) of what drifts, at the start
    drift: np.ndarray  # (samples, n)


def noise_of(seed: int, count: int, *, size: int, drifting: int) -> Noise:
    """Return the samples of a run with ``size`` white numbers and as many that drift."""
    seeds = _generator(seed)
    white = _samples(int(seeds.random_raw()), count, size)
    if not drifting:
        return Noise(white, np.zeros(0), np.zeros((count, 0)))
    start = _few(seeds, drifting)
    return Noise(white, start, _samples(int(seeds.random_raw()), count, drifting))


def _samples(seed: int, count: int, size: int) -> np.ndarray:
    # A source draws once before its first update.
    return _normal(_generator(seed), (count + 1) * size).reshape(count + 1, size)[1:]


def _few(generator: np.random.MT19937, count: int) -> np.ndarray:
    """Normal numbers (count), without a draw more than they need."""
    made = np.empty(0)
    while made.size < count:
        made = np.append(made, _accepted(generator.random_raw(4)))
    return made[:count]


def _generator(seed: int) -> np.random.MT19937:
    """A twister that begins as C++'s with a seed."""
    made = np.random.MT19937(0)
    np.random.RandomState(made).seed(seed)
    return made


def _normal(generator: np.random.MT19937, count: int) -> np.ndarray:
    """Normal numbers (count)."""
    parts, found = list[np.ndarray](), 0
    while found < count:
        pairs = min(int(0.64 * (count - found)) + 64, _PAIRS)  # pi / 4 of which are accepted
        parts.append(_accepted(generator.random_raw(4 * pairs)))
        found += parts[-1].size
    return np.concatenate(parts)[:count]


def _accepted(raw: np.ndarray) -> np.ndarray:
    """The normal numbers of 32-bit ones, four for a pair."""
    drawn = raw.astype(float)
    pairs, square = np.empty(raw.size // 4, dtype=complex), np.empty(raw.size // 4)
    _polar()(drawn.ctypes.data, pairs.ctypes.data, square.ctypes.data, square.size)
    accepted: np.ndarray = pairs[(square <= 1.0) & (square != 0.0)].view(float)
    return accepted


@functools.cache
def _polar() -> Callable[[int, int, int, int], None]:
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
    results = {"pairs": [y * factor, x * factor], "square": [square]}
    text = "\n".join((
        *declarations(registers()), function(registers(), "polar", tape, {"raw": 4}, results),
    ))  # fmt: skip
    code = Code(lambda: text)
    polar = code.function("polar", 3)

    def call(raw: int, pairs: int, square: int, count: int, _held: Code = code) -> None:
        polar(raw, pairs, square, count)

    return call
