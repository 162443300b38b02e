"""LLVM code of sine and cosine of several angles at once, within a unit in the last place.

The angle less a multiple k of pi / 2, as a sum of two numbers, then polynomials between -pi / 4 and
pi / 4, with the constants of fdlibm (Sun Microsystems, 1993; freely usable). Beyond a million
radians the results are not numbers.
"""

from collections.abc import Iterator

from ffsm_drake.plugins.compiled.registers import Registers

_LARGEST = 1e6  # rad
_ROUNDING = 1.5 * 2.0**52  # a number plus this holds its nearest integer in its last bits
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


def sine_and_cosine(registers: Registers, angle: str, name: str) -> Iterator[str]:
    """Lines that make ``name.sine`` and ``name.cosine``, as bits, from an angle."""
    lines = list[str]()

    def made(what: str, operation: str, *operands: str | float) -> str:
        texts = [registers.real(each) if isinstance(each, float) else each for each in operands]
        lines.append(f"  {name}.{what} = {operation} {registers.reals} {', '.join(texts)}")
        return f"{name}.{what}"

    def polynomial(what: str, coefficients: tuple[float, ...], x: str) -> str:
        total: str | float = coefficients[0]
        for i, each in enumerate(coefficients[1:]):
            total = made(f"{what}m{i}", "fmul", x, total)
            total = made(f"{what}a{i}", "fadd", total, each)
        return str(total)

    scaled = made("scaled", "fmul", angle, _QUARTERS)
    shifted = made("shifted", "fadd", scaled, _ROUNDING)
    k = made("k", "fsub", shifted, _ROUNDING)
    # the remainder x + y
    first = made("first", "fsub", angle, made("high", "fmul", k, _HIGH))
    middle = made("middle", "fmul", k, _MIDDLE)
    second = made("second", "fsub", first, middle)
    lost = made("lost", "fsub", made("gone", "fsub", first, second), middle)
    rest = made("rest", "fsub", made("low", "fmul", k, _LOW), lost)
    x = made("x", "fsub", second, rest)
    y = made("y", "fsub", made("left", "fsub", second, x), rest)
    z = made("z", "fmul", x, x)
    cube = made("cube", "fmul", z, x)
    r = polynomial("s", _SINE, z)
    half = made("half", "fmul", y, 0.5)
    inner = made("inner", "fsub", half, made("cr", "fmul", cube, r))
    inner = made("zinner", "fsub", made("zi", "fmul", z, inner), y)
    inner = made("whole", "fsub", inner, made("c3", "fmul", cube, _CUBE))
    s = made("s", "fsub", x, inner)
    fourth = polynomial("c", _COSINE, z)
    hz = made("hz", "fmul", z, 0.5)
    w = made("w", "fsub", 1.0, hz)
    correction = made("fix", "fsub", made("onew", "fsub", 1.0, w), hz)
    tail = made("zzc", "fmul", made("zz", "fmul", z, z), fourth)
    tail = made("tail", "fsub", tail, made("xy", "fmul", x, y))
    c = made("c", "fadd", w, made("fixed", "fadd", correction, tail))
    yield from lines
    yield from _in_quadrant(registers, angle, shifted, s, c, name)


def _in_quadrant(
    registers: Registers, angle: str, shifted: str, s: str, c: str, name: str
) -> Iterator[str]:
    """Exchange sine and cosine and change their signs as the multiple of pi / 2 says."""
    reals, wholes, truths = registers.reals, registers.wholes, registers.truths
    yield f"  {name}.n = bitcast {reals} {shifted} to {wholes}"
    yield f"  {name}.odd = trunc {wholes} {name}.n to {truths}"
    yield f"  {name}.next = add {wholes} {name}.n, {registers.whole(1)}"
    yield f"  {name}.square = fmul {reals} {angle}, {angle}"
    yield f"  {name}.near = fcmp olt {reals} {name}.square, {registers.real(_LARGEST**2)}"
    none = registers.real(float("nan"))
    for kind, count, own, other in (("sine", "n", s, c), ("cosine", "next", c, s)):
        at = f"{name}.{kind}"
        yield f"  {at}.o = select {truths} {name}.odd, {reals} {other}, {reals} {own}"
        yield f"  {at}.f = select {truths} {name}.near, {reals} {at}.o, {reals} {none}"
        yield f"  {at}.b = bitcast {reals} {at}.f to {wholes}"
        yield f"  {at}.two = and {wholes} {name}.{count}, {registers.whole(2)}"
        yield f"  {at}.sign = shl {wholes} {at}.two, {registers.whole(62)}"
        yield f"  {at} = xor {wholes} {at}.b, {at}.sign"
