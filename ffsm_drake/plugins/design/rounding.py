"""Numbers with few digits, for files that people read."""

import math
from collections.abc import Collection
from typing import Any

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates


def rounded(value: float) -> float:
    """A number with three digits."""
    return float(f"{value:.3g}")


def readable(data: Any, kept: Collection[str] = ()) -> Any:
    """Return plain data with its numbers rounded to six digits, except below the ``kept`` keys."""
    if isinstance(data, dict):
        return {k: each if k in kept else readable(each, kept) for k, each in data.items()}
    if isinstance(data, (list, tuple)):
        return [readable(each, kept) for each in data]
    return float(f"{data:.6g}") if isinstance(data, float) else data


def rounded_down(value: float) -> float:
    """The next number with three digits below a positive one, or the number itself."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return rounded(math.floor(value / unit * (1.0 + 1e-12)) * unit)


def rounded_by_group(values: np.ndarray, coordinates: Coordinates) -> dict[str, float]:
    """Values (nv) by coordinate, or by group where those of a group are equal; three digits."""
    result: dict[str, float] = {}
    for group, part in coordinates.groups.items():
        numbers = [rounded(value) for value in values[part].tolist()]
        names = coordinates.names[part] if len(set(numbers)) > 1 else (group,)
        result |= dict(zip(names, numbers, strict=False))
    return result
