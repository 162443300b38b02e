"""The samples of Drake's Gaussian sources, with their bits.

A source draws 32-bit numbers from a Mersenne Twister, and makes two normal numbers of each accepted
pair by the polar method, as the C++ library does. Its own seed is the first number that the run's
seed gives.
"""

import ctypes
import functools
import math
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ffsm_drake.plugins.compiled.compiling import Code

_LARGEST = float(np.nextafter(1.0, 0.0))
_WORDS, _FAR = 624, 397  # of the twister
_PAIRS = _WORDS // 4  # of numbers of 64 bits


class Noise(NamedTuple):
    """Samples of deviation 1 of a run's sensors."""

    white: np.ndarray  # (samples, size)
    start: np.ndarray  # (n) of what drifts, at the start
    drift: np.ndarray  # (samples, n)


def noise_of(seed: int, count: int, *, size: int, drifting: int) -> Noise:
    """Return the samples of a run with ``size`` white numbers and as many that drift."""
    words = np.empty((1 + drifting // 64) * _WORDS, dtype=np.uint32)  # far more than are drawn
    _writers().raw(words.ctypes.data, seed, words.size)
    seeds, start = iter(words.tolist()), list[float]()
    white = _samples(next(seeds), count, size)
    while len(start) < drifting:
        start += _polar(*(next(seeds) for _ in range(4)))
    drift = _samples(next(seeds), count, drifting) if drifting else np.zeros((count, 0))
    return Noise(white, np.array(start[:drifting]), drift)


def _samples(seed: int, count: int, size: int) -> np.ndarray:
    """The samples (count, size) of a source."""
    # A source draws once before its first update.
    drawn, last_block = (count + 1) * size, 2 * _PAIRS
    made = np.empty(drawn + last_block)
    _writers().normal(made.ctypes.data, seed, drawn)
    return made[size:drawn].reshape(count, size)


def _polar(*raw: int) -> Iterator[float]:
    """Two normal numbers of four with 32 bits, or none."""
    x, y = (
        2.0 * min((low + high * 2.0**32) * 2.0**-64, _LARGEST) - 1.0
        for low, high in (raw[:2], raw[2:])
    )
    square = x * x + y * y
    if 0.0 < square <= 1.0:
        factor = math.sqrt(-2.0 * math.log(square) / square)
        yield from (y * factor, x * factor)


class _Writers(NamedTuple):
    """Compiled functions that write, from a place on, what a seed gives: at least so many numbers,
    in blocks.
    """

    code: Code
    raw: Callable[[int, int, int], None]  # of 32 bits
    normal: Callable[[int, int, int], None]  # see ``_polar``


@functools.cache
def _writers() -> _Writers:
    code, kinds = Code(_text), (ctypes.c_int64, ctypes.c_int64)
    return _Writers(code, *(code.function(name, 1, *kinds) for name in ("raw", "normal")))


def _all(kind: str, count: int, value: float) -> str:
    """A constant of LLVM's language with equal entries."""
    one = value if kind == "i32" else f"0x{struct.pack('>d', value).hex().upper()}"
    return f"<{', '.join([f'{kind} {one}'] * count)}>"


def _entries(*places: int) -> str:
    return f"<{len(places)} x i32> <{', '.join(f'i32 {place}' for place in places)}>"


def _text() -> str:
    """The functions in LLVM's language.

    The words of a twister stand before the next ones.
    """
    functions = _begin(), _twist(), _accept(), _raw(), _normal()
    return f"""declare double @log(double)
declare double @llvm.sqrt.f64(double)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
{"".join(functions)}"""


def _begin() -> str:
    """The function that fills the words of a twister from a seed."""
    return f"""define internal void @begin(ptr %words, i64 %seed) {{
entry:
  %first = trunc i64 %seed to i32
  store i32 %first, ptr %words, align 4
  br label %fill
fill:
  %i = phi i64 [1, %entry], [%next, %fill]
  %before = phi i32 [%first, %entry], [%word, %fill]
  %top = lshr i32 %before, 30
  %mixed = xor i32 %before, %top
  %times = mul i32 %mixed, 1812433253
  %index = trunc i64 %i to i32
  %word = add i32 %times, %index
  %at = getelementptr i32, ptr %words, i64 %i
  store i32 %word, ptr %at, align 4
  %next = add i64 %i, 1
  %more = icmp ult i64 %next, {_WORDS}
  br i1 %more, label %fill, label %end
end:
  ret void
}}
"""


def _twist() -> str:
    """The function that computes the next words of a twister, and the numbers that it draws.

    Each word follows from three at fixed distances. Sixteen are computed at a time.
    """
    word = functools.partial(_all, "i32", 16)
    return f"""define internal void @twist(ptr noalias %words, ptr noalias %out) {{
entry:
  br label %some
some:
  %i = phi i64 [0, %entry], [%next, %some]
  %at.0 = getelementptr i32, ptr %words, i64 %i
  %at.1 = getelementptr i32, ptr %at.0, i64 1
  %at.far = getelementptr i32, ptr %at.0, i64 {_FAR}
  %at.new = getelementptr i32, ptr %at.0, i64 {_WORDS}
  %at.out = getelementptr i32, ptr %out, i64 %i
  %own = load <16 x i32>, ptr %at.0, align 4
  %second = load <16 x i32>, ptr %at.1, align 4
  %far = load <16 x i32>, ptr %at.far, align 4
  %high = and <16 x i32> %own, {word(2**31)}
  %low = and <16 x i32> %second, {word(2**31 - 1)}
  %both = or <16 x i32> %high, %low
  %half = lshr <16 x i32> %both, {word(1)}
  %odd = trunc <16 x i32> %second to <16 x i1>
  %odds = sext <16 x i1> %odd to <16 x i32>
  %matrix = and <16 x i32> %odds, {word(0x9908B0DF)}
  %turned = xor <16 x i32> %half, %matrix
  %new = xor <16 x i32> %far, %turned
  store <16 x i32> %new, ptr %at.new, align 4
  %s0 = lshr <16 x i32> %new, {word(11)}
  %t0 = xor <16 x i32> %new, %s0
  %s1 = shl <16 x i32> %t0, {word(7)}
  %m1 = and <16 x i32> %s1, {word(0x9D2C5680)}
  %t1 = xor <16 x i32> %t0, %m1
  %s2 = shl <16 x i32> %t1, {word(15)}
  %m2 = and <16 x i32> %s2, {word(0xEFC60000)}
  %t2 = xor <16 x i32> %t1, %m2
  %s3 = lshr <16 x i32> %t2, {word(18)}
  %t3 = xor <16 x i32> %t2, %s3
  store <16 x i32> %t3, ptr %at.out, align 4
  %next = add i64 %i, 16
  %more = icmp ult i64 %next, {_WORDS}
  br i1 %more, label %some, label %end
end:
  %news = getelementptr i32, ptr %words, i64 {_WORDS}
  call void @llvm.memcpy.p0.p0.i64(ptr %words, ptr %news, i64 {4 * _WORDS}, i1 false)
  ret void
}}
"""


def _accept() -> str:
    """The function that keeps the accepted pairs of numbers, four at a time, and counts them."""
    real = functools.partial(_all, "double", 8)
    # an accepted pair stays, the next one overwrites another
    kept = "".join(
        f"""
  %point{i} = getelementptr <2 x double>, ptr %points, i64 %found{i}
  %yx{i} = shufflevector <8 x double> %xy, <8 x double> poison, {_entries(2 * i + 1, 2 * i)}
  store <2 x double> %yx{i}, ptr %point{i}, align 8
  %place{i} = getelementptr double, ptr %squares, i64 %found{i}
  %one{i} = extractelement <4 x double> %square, i64 {i}
  store double %one{i}, ptr %place{i}, align 8
  %is{i} = extractelement <4 x i1> %accepted, i64 {i}
  %more{i} = zext i1 %is{i} to i64
  %found{i + 1} = add i64 %found{i}, %more{i}"""
        for i in range(4)
    )
    arguments = "ptr noalias %raw, ptr noalias %points, ptr noalias %squares"
    return f"""define internal i64 @accept({arguments}) {{
entry:
  br label %some
some:
  %i = phi i64 [0, %entry], [%next, %some]
  %found0 = phi i64 [0, %entry], [%found4, %some]
  %at = getelementptr i64, ptr %raw, i64 %i
  %drawn = load <8 x i64>, ptr %at, align 4
  %number = uitofp <8 x i64> %drawn to <8 x double>
  %share = fmul <8 x double> %number, {real(2.0**-64)}
  %below = fcmp olt <8 x double> %share, {real(1.0)}
  %u = select <8 x i1> %below, <8 x double> %share, <8 x double> {real(_LARGEST)}
  %twice = fmul <8 x double> %u, {real(2.0)}
  %xy = fsub <8 x double> %twice, {real(1.0)}
  %xxyy = fmul <8 x double> %xy, %xy
  %xx = shufflevector <8 x double> %xxyy, <8 x double> poison, {_entries(0, 2, 4, 6)}
  %yy = shufflevector <8 x double> %xxyy, <8 x double> poison, {_entries(1, 3, 5, 7)}
  %square = fadd <4 x double> %xx, %yy
  %inside = fcmp ole <4 x double> %square, {_all("double", 4, 1.0)}
  %apart = fcmp une <4 x double> %square, zeroinitializer
  %accepted = and <4 x i1> %inside, %apart{kept}
  %next = add i64 %i, 8
  %more = icmp ult i64 %next, {_WORDS // 2}
  br i1 %more, label %some, label %end
end:
  ret i64 %found4
}}
"""


def _raw() -> str:
    """The function that writes what a twister draws, in blocks."""
    return f"""define void @raw(ptr noalias %out, i64 %seed, i64 %count) {{
entry:
  %words = alloca [{2 * _WORDS} x i32], align 64
  call void @begin(ptr %words, i64 %seed)
  br label %block
block:
  %written = phi i64 [0, %entry], [%now, %block]
  %target = getelementptr i32, ptr %out, i64 %written
  call void @twist(ptr %words, ptr %target)
  %now = add i64 %written, {_WORDS}
  %more = icmp ult i64 %now, %count
  br i1 %more, label %block, label %end
end:
  ret void
}}
"""


def _normal() -> str:
    """The function that writes normal numbers, by the polar method, in blocks."""
    return f"""define void @normal(ptr noalias %out, i64 %seed, i64 %count) {{
entry:
  %words = alloca [{2 * _WORDS} x i32], align 64
  %raw = alloca [{_WORDS} x i32], align 64
  %points = alloca [{_PAIRS} x <2 x double>], align 64
  %squares = alloca [{_PAIRS} x double], align 64
  call void @begin(ptr %words, i64 %seed)
  br label %check
check:
  %written = phi i64 [0, %entry], [%now, %made]
  %lacks = icmp ult i64 %written, %count
  br i1 %lacks, label %block, label %end
block:
  call void @twist(ptr %words, ptr %raw)
  %found = call i64 @accept(ptr %raw, ptr %points, ptr %squares)
  %target = getelementptr double, ptr %out, i64 %written
  br label %pair
pair:
  %i = phi i64 [0, %block], [%next, %scale]
  %more = icmp ult i64 %i, %found
  br i1 %more, label %scale, label %made
scale:
  %at.square = getelementptr double, ptr %squares, i64 %i
  %at.point = getelementptr <2 x double>, ptr %points, i64 %i
  %at = getelementptr <2 x double>, ptr %target, i64 %i
  %square = load double, ptr %at.square, align 8
  %point = load <2 x double>, ptr %at.point, align 8
  %log = call double @log(double %square)
  %scaled = fmul double %log, -2.0
  %ratio = fdiv double %scaled, %square
  %factor = call double @llvm.sqrt.f64(double %ratio)
  %one = insertelement <2 x double> poison, double %factor, i64 0
  %both = insertelement <2 x double> %one, double %factor, i64 1
  %numbers = fmul <2 x double> %point, %both
  store <2 x double> %numbers, ptr %at, align 8
  %next = add i64 %i, 1
  br label %pair
made:
  %numbers.made = mul i64 %found, 2
  %now = add i64 %written, %numbers.made
  br label %check
end:
  ret void
}}
"""
