"""Charts as Plotly draws them in the pages."""

import html
from collections.abc import Iterator, Sequence
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
_CLEAR = "rgba(0, 0, 0, 0)"
# Layout shared by all figures of a page; legible on light and dark backgrounds.
TEMPLATE: dict[str, Any] = {
    "layout": {
        "font": FONT | {"color": NEUTRAL},
        "paper_bgcolor": _CLEAR,
        "plot_bgcolor": _CLEAR,
        "margin": {"l": 48, "r": 10, "t": 8, "b": 36},
        "hoverlabel": {
            "bgcolor": "#ffffff",
            "bordercolor": "#c9ced6",
            "font": FONT | {"color": "#1b1f24"},
        },
        "modebar": {"bgcolor": _CLEAR, "color": NEUTRAL, "activecolor": NEUTRAL},
        "legend": {"orientation": "h", "x": 0, "yref": "container", "y": 0.01, "yanchor": "bottom"},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
        "scene": {
            "camera": {
                "eye": {"x": 1.7, "y": -1.9, "z": 1.0},
                "center": {"x": 0.0, "y": 0.0, "z": -0.1},
            },
            **{f"{name}axis": {**_SPACE_AXIS, "title": {"text": f"{name} [m]"}} for name in "xyz"},
        },
    }
}
_SPACE_POINTS = 600  # largest number drawn of a curve in space
_MOST_MARKERS = 3000  # drawn as SVG; more are drawn by WebGL

Json = dict[str, Any]


def panel_data(chart: Chart, points: int) -> Json:
    """Return a chart as data and layout of Plotly, with at most ``points`` points of each line; the
    page has the template.
    """
    layout: Json = {"template": "none", "showlegend": bool(chart.legend), "hovermode": "closest"}
    if chart.kind == "space":
        layout |= {"dragmode": "turntable", "margin": dict.fromkeys("lrtb", 0)}
        layout["scene"] = {"aspectmode": "data"}
    else:
        layout |= {"xaxis": _axis(chart.x, chart.log_x, chart.range_x, ticks=3)}
        layout |= {"yaxis": _axis(chart.label_y, chart.log_y, chart.range, ticks=4)}
        layout |= {"shapes": list(_shapes(chart)), "annotations": list(_notes(chart))}
    if chart.kind == "time":
        layout["xaxis"] |= {"showgrid": False, "unifiedhovertitle": {"text": "%{x} s"}}
        layout["hovermode"] = "x unified"
    if chart.kind == "map":
        layout["xaxis"]["zeroline"] = layout["yaxis"]["zeroline"] = False
    if chart.rows:
        layout["yaxis"] |= {
            "tickvals": list(range(len(chart.rows))), "ticktext": [*map(_escaped, chart.rows)],
            "range": [len(chart.rows) - 0.4, -0.6], "showgrid": False, "zeroline": False,
        }  # fmt: skip
    traces = [*chart.traces, *(_trace(curve, points) for curve in chart.curves)]
    return go.Figure(traces, layout).to_plotly_json()


def _escaped(text: str) -> str:
    """Escape tags of a Plotly label: none may come from a scenario."""
    return html.escape(text, quote=False)


def _axis(title: str, log: str, extent: Sequence[float] | None, *, ticks: int) -> Json:
    """A logarithmic axis has a format that writes labels in full, so that none appears twice."""
    axis: Json = {"title": {"text": _escaped(title)}}
    if log:
        axis |= {"type": "log", "tickformat": log, "nticks": ticks}
    if extent is not None:
        axis["range"] = np.log10(extent).tolist() if log else list(extent)
    return axis


def _trace(curve: Curve, points: int) -> Json:
    """Return a line, markers or both, in single precision, enough for a screen."""
    kept = np.arange(curve.x.size)
    if curve.z is not None:
        kept = np.unique(np.linspace(0, kept.size - 1, _SPACE_POINTS).astype(int))
    elif curve.line and not curve.filled:
        kept = thinned(curve.y, curve.points or points)
    modes = ["lines"] * (curve.line and kept.size != 1)
    modes += ["text"] * bool(curve.z is not None and curve.texts)
    modes += ["markers"] * bool(curve.marker or "lines" not in modes)
    color, many = curve.style.color, not curve.line and kept.size > _MOST_MARKERS
    trace: Json = {
        "type": "scatter3d" if curve.z is not None else "scattergl" if many else "scatter",
        "name": _escaped(curve.name), "mode": "+".join(modes),
    }  # fmt: skip
    with np.errstate(over="ignore"):
        for name, values in (("x", curve.x), ("y", curve.y), ("z", curve.z)):
            if values is not None:
                trace[name] = values[kept].astype(np.float32)
    if curve.line:
        trace["line"] = {"color": color, "dash": curve.style.dash, "width": curve.width}
    if curve.marker:
        trace["marker"] = {"color": color, "size": curve.size, "symbol": curve.marker}
    if curve.z is not None:
        trace["hovertemplate"] = "x %{x:.4~g} m<br>y %{y:.4~g} m<br>z %{z:.4~g} m"
    elif curve.line:
        trace["line"]["shape"] = "hv" if curve.steps else "linear"
    if curve.texts:
        trace["text"] = [*map(_escaped, curve.texts)]
        if curve.z is None:
            trace["hovertemplate"] = "%{text}<br>%{x:.4g}, %{y:.4g}<extra></extra>"
        else:
            trace |= {"textposition": "top center", "textfont": {"color": color}}
    if curve.opacity < 1.0:
        trace |= {"opacity": curve.opacity, "hoverinfo": "skip"}
    if curve.filled:
        trace |= {"fill": curve.filled}
    if curve.filled == "tozeroy":
        red, green, blue = bytes.fromhex(color.removeprefix("#"))
        trace["fillcolor"] = f"rgba({red}, {green}, {blue}, 0.11)"
    elif curve.filled:
        trace |= {"connectgaps": False, "hoveron": "points", "hovertemplate": "%{x:.2f} s"}
    if curve.run is not None:
        trace["legendgroup"] = f"run-{curve.run}"
    return trace


def _shapes(chart: Chart) -> Iterator[Json]:
    """Lines of the levels, and boxes of the bands."""
    for level in chart.levels:
        line = {"color": level.style.color, "dash": level.style.dash, "width": 1.2}
        yield {"type": "line", "line": line, **_across(level.axis, level.value, level.value)}
    for band in chart.bands:
        look = {"layer": "below", "opacity": band.opacity, "line": {"width": 0}}
        for low, high in band.spans.tolist():
            place = _across(band.axis, low, high)
            yield {"type": "rect", "fillcolor": band.color, **look, **place}


def _across(axis: str, low: float, high: float) -> Json:
    """Place of a shape between two values of an axis, across the whole picture."""
    other = "y" if axis == "x" else "x"
    return {
        f"{axis}0": low, f"{axis}1": high, f"{other}0": 0, f"{other}1": 1, f"{other}ref": "paper",
    }  # fmt: skip


def _notes(chart: Chart) -> Iterator[Json]:
    """Texts at the levels."""
    for level in chart.levels:
        if level.text:
            yield {
                "xref": "paper", "x": 1, "xanchor": "right", "y": level.value,
                "yanchor": "bottom", "text": _escaped(level.text), "showarrow": False,
            }  # fmt: skip
