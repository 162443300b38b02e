"""Charts: the content of a picture, as plain data. ``panels`` draws them with Plotly,
``figures.axes`` with Matplotlib.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ffsm_drake.show.style import BLACK, NEUTRAL, SERIES, Style

DASHES = ("solid", "dash", "dashdot", "dot", "longdashdot", "longdash")


@dataclasses.dataclass(frozen=True)
class Curve:
    """Values y (n,) over x (n,), or points (x, y, z) in space. A single point is drawn as a
    marker.
    """

    x: np.ndarray
    y: np.ndarray
    style: Style
    name: str = ""  # in the legend; "": not there
    width: float = 1.4
    steps: bool = False  # held from each point to the next
    marker: str = ""  # at each point: "circle", "diamond", "square", "star", "x", ...
    line: bool = True  # line through the points
    size: float = 8.0  # marker size
    opacity: float = 1.0
    filled: Literal["", "tozeroy", "toself"] = ""  # tinted down to zero, or its closed outlines
    points: int = 0  # the largest number drawn of a line; 0: the backend's
    run: int | None = None  # a page's chips hide and show the curves of a run
    z: np.ndarray | None = None
    texts: Sequence[str] = ()  # of the points: in space beside them, in a plane under the pointer


@dataclasses.dataclass(frozen=True)
class Level:
    """A line across the picture at a value of an axis, with a text at its end."""

    value: float
    text: str = ""
    name: str = ""  # in the legend; "": not there
    axis: Literal["x", "y"] = "y"
    style: Style = Style(NEUTRAL)
    below: bool = False  # whether the text is below the line


@dataclasses.dataclass(frozen=True)
class Band:
    """Shaded spans (n, 2) of an axis, across the whole picture."""

    spans: np.ndarray
    color: str
    opacity: float = 0.2
    name: str = ""  # in the legend; "": not there
    axis: Literal["x", "y"] = "x"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Chart:
    """Curves on common axes."""

    title: str
    curves: Sequence[Curve]
    x: str = "time [s]"
    y: str = ""  # unit of y, or its name
    what: str = ""  # quantity, before the unit on the y axis of figures
    log_x: str = ""  # "": a linear axis, else Plotly's format of its tick labels
    log_y: str = ""
    range_x: Sequence[float] | None = None  # None: that of the curves
    range: Sequence[float] | None = None  # range of y
    margin: float = 0.01  # around the curves in figures, share of their range
    levels: Sequence[Level] = ()
    bands: Sequence[Band] = ()
    legend: Literal["", "inside", "right", "below"] = ""  # pages have it below
    # Panels of kind "time" share their time axis; others are "map", "space", "chart" and "full".
    kind: str = "time"
    group: str = ""  # heading above the group's first panel
    height: int = 0  # px of the panel; 0: the stylesheet's
    rows: Sequence[str] = ()  # y counts rows from the top, with these names
    traces: Sequence[Mapping[str, Any]] = ()  # Plotly's own, behind the curves; of pages only
    note: str = ""  # why there is no curve, in figures

    @property
    def label_y(self) -> str:
        """Label of the y axis; none for a number without a unit."""
        return "" if self.y == "1" else self.y


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Charts shown together; a section of a page shows one of its views."""

    label: str
    charts: Sequence[Chart]

    @property
    def wide(self) -> bool:
        """True if its charts need more room than curves over time."""
        return any(chart.kind != "time" for chart in self.charts)


def merged(
    charts: Sequence[Chart], *, dashes: Mapping[str, str] = MappingProxyType({}), **look: Any
) -> Chart:
    """Return the charts of one run on common axes: a colour for each chart, dashes for each group,
    and the references (curves of no run) dashed in black. ``look`` as of ``Chart``.
    """
    curves = [
        dataclasses.replace(curve, style=Style(BLACK, "dash"), name="")
        if curve.run is None
        else dataclasses.replace(
            curve, style=Style(SERIES[k % len(SERIES)], dashes.get(chart.group, "solid")),
            name=chart.title,
        )
        for k, chart in enumerate(charts)
        for curve in chart.curves
    ]  # fmt: skip
    units = ", ".join(dict.fromkeys(chart.y for chart in charts))
    return Chart(curves=curves, y=units, **look)
