"""Solids on the base, as Meshcat shows the units of a part."""

import dataclasses
from typing import Literal

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
    """A solid on the base, shown in Meshcat. Lengths without a unit are shares of the base's
    longest edge.
    """

    group: str  # group of solids of one kind
    name: str
    shape: Literal["cone", "disc"]  # a cone has its point at its place, and opens along the axis
    axis: np.ndarray  # (3,) in the base's axes, of any length
    position: np.ndarray  # (3,) m, in the base
    offset: float = 0.0  # distance from there along the axis
    length: float
    radius: float
    color: tuple[float, float, float, float]  # red, green, blue, opacity
    through: bool = False  # seen through the base
    # signal whose component of this solid's name shows it while above zero; "": always shown
    shown_by: str = ""
    legend: str = ""
