"""Charts as Plotly draws them in the pages: panels of one style, over time or not."""

import dataclasses
import html
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go  # type: ignore[import-untyped]

from ffsm_drake.show.chart import Chart, Curve
from ffsm_drake.show.curves import thinned
from ffsm_drake.show.style import NEUTRAL

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
    """One Plotly figure with its caption. The fields have the names of its chart."""

    title: str
    figure: go.Figure
    kind: str = "time"
    group: str = ""
    height: int = 0


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

    def __call__(self, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
        """Return a thinned curve in single precision, enough for a screen."""
        self.longest = max(self.longest, curve.x.size)
        kept = thinned(curve.y, curve.points or self.points)
        with np.errstate(over="ignore"):
            return curve.x[kept].astype(np.float32), curve.y[kept].astype(np.float32)


Trace = dict[str, Any]  # Plotly's; a Figure checks it once, on adding


def escape(text: str) -> str:
    """Return text for a Plotly label, with tags escaped: none may come from a scenario."""
    return html.escape(text, quote=False)


def figure(traces: Sequence[Trace], *, x: str, y: str, **layout: Any) -> go.Figure:
    """Return a figure; the page has the template. ``xaxis`` and ``yaxis`` extend the axes."""
    axes = {
        name: {"title": {"text": escape(title)}, **layout.pop(name, {})}
        for name, title in (("xaxis", x), ("yaxis", y))
    }
    return go.Figure(
        list(traces),
        {"template": "none", "showlegend": False, "hovermode": "closest", **axes, **layout},
    )


def panels(charts: Iterable[Chart], thin: Thinning) -> list[Panel]:
    """Charts as Plotly draws them."""
    return [panel(chart, thin) for chart in charts]


def panel(chart: Chart, thin: Thinning, *, before: Sequence[Trace] = (), **layout: Any) -> Panel:
    """Return a chart as Plotly draws it, above the traces ``before``; ``layout`` extends
    Plotly's.
    """
    axes = {
        "xaxis": _axis(chart.log_x, chart.range_x, ticks=3),
        "yaxis": _axis(chart.log_y, chart.range, ticks=4),
    }
    if chart.kind == "time":
        axes["xaxis"] |= {"showgrid": False, "unifiedhovertitle": {"text": "%{x} s"}}
        layout = {"hovermode": "x unified"} | layout
    for name, axis in axes.items():
        axis.update(layout.pop(name, {}))
    shown = figure(
        [*before, *(_trace(curve, thin) for curve in chart.curves)], x=chart.x, y=chart.label_y,
        **axes, showlegend=chart.legend, **_marks(chart), **layout,
    )  # fmt: skip
    return Panel(
        title=chart.title, figure=shown, kind=chart.kind, group=chart.group, height=chart.height
    )


def _axis(log: str, extent: Sequence[float] | None, *, ticks: int) -> dict[str, Any]:
    axis: dict[str, Any] = log_axis(log, ticks=ticks) if log else {}
    if extent is not None:
        axis["range"] = np.log10(extent).tolist() if log else list(extent)
    return axis


def log_axis(form: str, *, ticks: int) -> dict[str, Any]:
    """Return a logarithmic axis; the format writes labels in full, so that none appears twice."""
    return {"type": "log", "tickformat": form, "nticks": ticks}


def _trace(curve: Curve, thin: Thinning) -> Trace:
    """Return a line, markers or both, as Plotly has them."""
    x, y = thin(curve)
    color = curve.style.color
    modes = ["lines"] * (curve.line and x.size != 1)
    modes += ["markers"] * bool(curve.marker or not modes)
    name, mode = escape(curve.name), "+".join(modes)
    trace: Trace = {"type": "scatter", "x": x, "y": y, "name": name, "mode": mode}
    if curve.line:
        shape = "hv" if curve.steps else "linear"
        trace["line"] = {
            "color": color, "dash": curve.style.dash, "width": curve.width, "shape": shape,
        }  # fmt: skip
    if curve.marker:
        trace["marker"] = {"color": color, "size": curve.size, "symbol": curve.marker}
    if curve.opacity < 1.0:
        trace |= {"opacity": curve.opacity, "hoverinfo": "skip"}
    if curve.filled:
        red, green, blue = bytes.fromhex(color.removeprefix("#"))
        trace |= {"fill": "tozeroy", "fillcolor": f"rgba({red}, {green}, {blue}, 0.11)"}
    if curve.run is not None:
        trace["legendgroup"] = f"run-{curve.run}"
    return trace


def _marks(chart: Chart) -> dict[str, list[dict[str, Any]]]:
    """Shapes of the levels and bands of a chart, and the texts at the levels."""
    shapes, notes = [], []
    for level in chart.levels:
        along, across = ("y", "x") if level.axis == "y" else ("x", "y")
        line = {"color": level.style.color, "dash": level.style.dash, "width": 1.2}
        shapes.append({
            "type": "line", f"{across}ref": "paper", f"{across}0": 0, f"{across}1": 1,
            f"{along}0": level.value, f"{along}1": level.value, "line": line,
        })  # fmt: skip
        if level.text:
            notes.append({
                "xref": "paper", "x": 1, "xanchor": "right", "y": level.value,
                "yanchor": "bottom", "text": escape(level.text), "showarrow": False,
            })  # fmt: skip
    for band in chart.bands:
        for low, high in band.spans:
            shapes.append({
                "type": "rect", "yref": "paper", "y0": 0, "y1": 1, "x0": float(low),
                "x1": float(high), "layer": "below", "fillcolor": band.color,
                "opacity": band.opacity, "line": {"width": 0},
            })  # fmt: skip
    marks = {"shapes": shapes, "annotations": notes}
    return {key: value for key, value in marks.items() if value}
