# ruff: noqa: RUF001, RUF002 (the texts use mathematical signs)
"""Numbers as text, and whether they can be calculated with."""

import math

import numpy as np

NONE = "–"
LARGEST = 1e100  # bound on the numbers of a run; squares and products of larger ones overflow
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 4) -> str:
    """Such as 12.35 or 1.235×10⁻⁶; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NONE
    if 1e-3 <= abs(value) < 1e5:
        power = int(f"{value:.{digits - 1}e}".split("e")[1])
        return f"{value:.{max(digits - 1 - power, 0)}f}"
    return scientific(value, digits)


def short(value: float, digits: int = 3) -> str:
    """Such as 5, 0.25 or 2891: significant digits, without an exponent from 1e-4 to 1e6."""
    text = f"{value:.{digits}g}"
    return f"{value:.0f}" if "e+" in text and abs(value) < 1e6 else text


def scientific(value: float, digits: int) -> str:
    """Return a finite number such as 1.70×10⁻⁴."""
    if value == 0.0:
        return "0"
    mantissa, power = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}{power_of_ten(int(power))}"


def power_of_ten(exponent: int) -> str:
    """Such as ×10⁻⁴."""
    return f"×10{str(exponent).translate(_SUPERSCRIPTS)}"


def rounded_up(value: float, digits: int) -> float:
    """Return the smallest number with so many digits that a finite value does not exceed, for a
    bound.
    """
    unit = 10.0 ** (math.floor(math.log10(abs(value) or 1.0)) - digits + 1)
    return math.ceil(value / unit - 1e-9) * unit


def percent(share: float | None) -> str:
    """Such as 97.5 %; a dash where there is none."""
    return f"{100.0 * share:.1f} %" if share is not None and math.isfinite(share) else NONE


def counted(number: int, noun: str) -> str:
    """Such as 1 run, 2 runs, 0 bodies."""
    many = f"{noun[:-1]}ies" if noun.endswith("y") else f"{noun}s"
    return f"{number} {noun if number == 1 else many}"


def magnification(ratio: float) -> int:
    """Return the largest of 1, 2, 5, 10, ... 1000 whose product with a length ratio stays below
    one.
    """
    allowed = [step for step in (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000) if step * ratio <= 1.0]
    return allowed[-1] if allowed and ratio > 0.0 else 1


def usable(values: np.ndarray) -> np.ndarray:
    """Return the mask of the samples (n) of values (n, ...) that are below ``LARGEST`` in size
    throughout.
    """
    within = np.abs(values) < LARGEST  # false for NaN too
    return within.all(axis=tuple(range(1, within.ndim)))
