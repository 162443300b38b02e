"""Plotly figures for the pages: panels of one style, over time or not."""

import dataclasses
import html
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go  # type: ignore[import-untyped]

from ffsm_drake.show.curves import thinned
from ffsm_drake.show.style import NEUTRAL, Style

FONT = {
    "family": "system-ui, -apple-system, Segoe UI, Roboto, Helvetica Neue, DejaVu Sans, sans-serif",
    "size": 11.5,
}
_AXIS = {
    "gridcolor": "rgba(128, 136, 146, 0.25)",
    "linecolor": "rgba(128, 136, 146, 0.5)",
    "zerolinecolor": "rgba(128, 136, 146, 0.4)",
    "zerolinewidth": 1,
    "automargin": True,
    "ticks": "",
    "title": {"standoff": 6},
    "hoverformat": ".4~g",
    "exponentformat": "power",
    "showexponent": "all",
    "nticks": 6,
}
_SPACE_AXIS = {
    "color": NEUTRAL,
    "gridcolor": "rgba(128, 136, 146, 0.35)",
    "zerolinecolor": "rgba(128, 136, 146, 0.5)",
    "showbackground": False,
    "showspikes": False,
    "nticks": 5,
}
# Layout shared by all figures of a page; legible on light and dark backgrounds.
TEMPLATE: dict[str, Any] = {
    "layout": {
        "font": FONT | {"color": NEUTRAL},
        "paper_bgcolor": "rgba(0, 0, 0, 0)",
        "plot_bgcolor": "rgba(0, 0, 0, 0)",
        "margin": {"l": 48, "r": 10, "t": 8, "b": 36},
        "hoverlabel": {
            "bgcolor": "#ffffff",
            "bordercolor": "#c9ced6",
            "font": FONT | {"color": "#1b1f24"},
        },
        "modebar": {"bgcolor": "rgba(0, 0, 0, 0)", "color": NEUTRAL, "activecolor": NEUTRAL},
        "legend": {"orientation": "h", "x": 0, "yref": "container", "y": 0.01, "yanchor": "bottom"},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
        "scene": {
            f"{name}axis": {**_SPACE_AXIS, "title": {"text": f"{name} [m]"}} for name in "xyz"
        },
    }
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Panel:
    """One Plotly figure with its caption."""

    title: str
    figure: go.Figure
    # "time" panels share their time axis; other styles are "map", "space" and "chart"
    kind: str = "time"
    group: str = ""  # heading above the group's first panel
    height: int = 0  # px; 0: the stylesheet's


@dataclasses.dataclass(frozen=True, kw_only=True)
class View:
    """Panels shown together; a section shows one of its views."""

    label: str
    panels: list[Panel]

    @property
    def wide(self) -> bool:
        """True if its panels need more room than curves over time."""
        return any(panel.kind != "time" for panel in self.panels)


@dataclasses.dataclass
class Thinning:
    """Limits curves to ``points`` points and remembers the longest one given."""

    points: int
    longest: int = 0

    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A thinned curve in single precision, enough for a screen."""
        self.longest = max(self.longest, x.size)
        kept = thinned(y, self.points)
        with np.errstate(over="ignore"):
            return x[kept].astype(np.float32), y[kept].astype(np.float32)


Trace = dict[str, Any]  # Plotly's; a Figure checks it once, on adding


def curve(
    xy: tuple[np.ndarray, np.ndarray],
    style: Style,
    *,
    name: str = "",
    width: float = 1.4,
    **rest: Any,
) -> Trace:
    """A line; a single point is drawn as a marker."""
    line = {
        "color": style.color,
        "dash": style.dash,
        "width": width,
        "shape": rest.pop("shape", "linear"),
    }
    mode = "markers" if len(xy[0]) == 1 else "lines"
    return {
        "type": "scatter",
        "x": xy[0],
        "y": xy[1],
        "name": escape(name),
        "line": line,
        "mode": mode,
        **rest,
    }


def escape(text: str) -> str:
    """Text for a Plotly label, with tags escaped: none may come from a scenario."""
    return html.escape(text, quote=False)


def figure(traces: Sequence[Trace], *, x: str, y: str, **layout: Any) -> go.Figure:
    """A figure; the page has the template. ``xaxis`` and ``yaxis`` extend the axes."""
    axes = {
        name: {"title": {"text": escape(title)}, **layout.pop(name, {})}
        for name, title in (("xaxis", x), ("yaxis", y))
    }
    return go.Figure(
        list(traces),
        {"template": "none", "showlegend": False, "hovermode": "closest", **axes, **layout},
    )


def time_panel(
    title: str,
    unit: str,
    traces: Sequence[Trace],
    *,
    group: str = "",
    log: bool = False,
    range: Sequence[float] | None = None,
    level: tuple[float, str] | None = None,
    legend: bool = False,
) -> Panel:
    """Curves over time; ``range`` is in decades if ``log``; ``level``: a labelled line."""
    yaxis: dict[str, Any] = {} if range is None else {"range": list(range)}
    if log:
        yaxis |= log_axis()
    xaxis = {"showgrid": False, "unifiedhovertitle": {"text": "%{x} s"}}
    layout: dict[str, Any] = {
        "xaxis": xaxis,
        "yaxis": yaxis,
        "showlegend": legend,
        "hovermode": "x unified",
    }
    if level is not None:
        layout["shapes"] = [
            {
                "type": "line",
                "xref": "paper",
                "x0": 0,
                "x1": 1,
                "y0": level[0],
                "y1": level[0],
                "line": {"color": NEUTRAL, "width": 1.2},
            }
        ]
        layout["annotations"] = [
            {
                "xref": "paper",
                "x": 1,
                "xanchor": "right",
                "y": level[0],
                "yanchor": "bottom",
                "text": level[1],
                "showarrow": False,
            }
        ]
    shown = figure(traces, x="time [s]", y="" if unit == "1" else unit, **layout)
    return Panel(title=title, group=group, figure=shown)


def log_axis(form: str = "~e", *, ticks: int = 4) -> dict[str, Any]:
    """A logarithmic axis; the format writes labels in full, so that none appears twice."""
    return {"type": "log", "tickformat": form, "nticks": ticks}
