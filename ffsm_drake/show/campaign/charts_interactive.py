"""The report's figures for the browser: plain data for plotly.js."""

from typing import Any

import numpy as np

from ffsm_drake.campaign.findings import Findings
from ffsm_drake.show.campaign.charts_still import FAILED, SETTLED, cumulative
from ffsm_drake.show.figures.run import LABELS, STYLES

Chart = dict[str, Any]  # data and layout
_FONT = {"family": "system-ui, sans-serif", "size": 13}
_POINTS = 1500  # of a cumulative curve


def success_chart(findings: Findings) -> Chart:
    """Success rate of every controller with its interval."""
    names = list(reversed(findings.success))
    rates = [findings.success[name] for name in names]
    data = {
        "type": "bar",
        "orientation": "h",
        "x": [100.0 * rate.value for rate in rates],
        "y": [LABELS[name] for name in names],
        "marker": {"color": [STYLES[name]["color"] for name in names], "opacity": 0.6},
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": [100.0 * (rate.high - rate.value) for rate in rates],
            "arrayminus": [100.0 * (rate.value - rate.low) for rate in rates],
        },
        "hovertemplate": "%{y}: %{x:.2f} %<extra></extra>",
    }
    return _chart([data], height=90 + 55 * len(names), xaxis=_axis("settled runs [%]", range=[0, 101]), margin_left=190)


def accuracy_chart(findings: Findings) -> Chart:
    """Share of all cases that settled with at most a given ITAE (left) and ISV (right)."""
    data = []
    for name, runs in findings.table.runs.items():
        for axis, metric in (("", "itae"), ("2", "isv")):
            x, y = cumulative(runs.metrics[metric][runs.settled], runs.case.size)
            data.append(_curve(x, y, LABELS[name], STYLES[name]["color"], axis=axis, legend=axis == ""))
    return _chart(
        data,
        height=430,
        xaxis=_axis("ITAE", type="log", domain=[0.0, 0.46]),
        xaxis2=_axis("ISV", type="log", domain=[0.54, 1.0], anchor="y2"),
        yaxis=_axis("settled with at most this [% of cases]", range=[0, 101]),
        yaxis2=_axis("", range=[0, 101], anchor="x2"),
    )


def difference_chart(findings: Findings) -> Chart:
    """Distribution of the ITAE ratio of every pair on the same cases."""
    data = []
    for difference in findings.differences:
        x, y = cumulative(difference.ratios, difference.ratios.size)
        data.append(_curve(x, y, f"{difference.first} / {difference.second}", None))
    one = {"type": "line", "x0": 1, "x1": 1, "y0": 0, "y1": 1, "yref": "paper", "line": {"width": 1}}
    return _chart(
        data,
        height=430,
        xaxis=_axis("ratio of ITAE on the same case", type="log"),
        yaxis=_axis("cases with at most this ratio [%]", range=[0, 101]),
        shapes=[one],
    )


def sensitivity_chart(findings: Findings) -> Chart:
    """Share of the variance of failure that each value explains."""
    names = list(reversed(findings.influential))
    data = []
    for controller in findings.table.runs:
        items = {item.name: item for item in findings.sensitivities if item.controller == controller}
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "name": LABELS[controller],
                "y": names,
                "x": [_number(100.0 * items[name].share) for name in names],
                "customdata": [
                    [_number(items[name].correlation), _number(100.0 * items[name].chance)] for name in names
                ],
                "marker": {"color": STYLES[controller]["color"]},
                "hovertemplate": "%{y}: %{x:.1f} % (chance %{customdata[1]:.1f} %), "
                "rank correlation %{customdata[0]:.2f}",
            }
        )
    return _chart(
        data,
        height=140 + 75 * len(names),
        xaxis=_axis("variance of failure that the value alone explains [%]"),
        margin_left=190,
    )


def map_chart(findings: Findings) -> Chart:
    """Outcomes over two values with the predicted boundary; a menu chooses the controller."""
    grid = findings.map
    assert grid is not None
    data: list[Chart] = []
    names = list(findings.table.runs)
    for place, (name, runs) in enumerate(findings.table.runs.items()):
        x, y = (findings.table.at(axis, runs) for axis in (grid.x_name, grid.y_name))
        shown = place == 0
        data.append(
            {
                "type": "contour",
                "x": grid.x.tolist(),
                "y": grid.y.tolist(),
                "z": grid.side(name).tolist(),
                # One level, at 1: what is below it is left clear, what is above is shaded.
                "autocontour": False,
                "contours": {"start": 1.0, "end": 1.0, "size": 0.1, "coloring": "fill"},
                "zmin": 0.95,
                "zmax": 1.05,
                "colorscale": [[0.0, "rgba(255, 255, 255, 0)"], [1.0, "rgba(244, 217, 204, 1)"]],
                "showscale": False,
                "line": {"color": "black", "width": 2, "smoothing": 0},
                "hoverinfo": "skip",
                "visible": shown,
            }
        )
        for which, label, color, symbol in (
            (runs.settled, "settled", SETTLED, "circle"),
            (~runs.settled, "not settled", FAILED, "x"),
        ):
            data.append(
                {
                    "type": "scattergl" if x.size > 3000 else "scatter",
                    "mode": "markers",
                    "name": label,
                    "x": x[which].tolist(),
                    "y": y[which].tolist(),
                    "text": [
                        f"case {case}: {outcome}"
                        for case, outcome in zip(runs.case[which], runs.outcome[which], strict=True)
                    ],
                    "hovertemplate": "%{text}<br>%{x:.4g}, %{y:.4g}<extra></extra>",
                    "marker": {"color": color, "symbol": symbol, "size": 7 if x.size < 1000 else 4},
                    "visible": shown,
                }
            )
    buttons = [
        {"label": LABELS[name], "method": "update", "args": [{"visible": [k // 3 == i for k in range(len(data))]}]}
        for i, name in enumerate(names)
    ]
    return _chart(
        data,
        height=560,
        xaxis=_axis(grid.x_name, type="log" if grid.x_log else "linear"),
        yaxis=_axis(grid.y_name, type="log" if grid.y_log else "linear"),
        updatemenus=[
            {"buttons": buttons, "type": "buttons", "direction": "right", "x": 0.0, "xanchor": "left", "y": 1.12}
        ],
    )


def _curve(x: np.ndarray, y: np.ndarray, name: str, color: str | None, *, axis: str = "", legend: bool = True) -> Chart:
    keep = np.unique(np.linspace(0, x.size - 1, min(x.size, _POINTS)).astype(int)) if x.size else slice(None)
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "legendgroup": name,
        "showlegend": legend,
        "x": x[keep].tolist(),
        "y": y[keep].tolist(),
        "xaxis": f"x{axis}",
        "yaxis": f"y{axis}",
        "line": {"shape": "hv", "width": 2} | ({"color": color} if color else {}),
    }


def _axis(title: str, **rest: Any) -> Chart:
    return {"title": {"text": title}, "gridcolor": "#DDDDDD", "linecolor": "#888888", "exponentformat": "power", **rest}


def _chart(data: list[Chart], *, height: int, margin_left: int = 70, **layout: Any) -> Chart:
    margin = {"l": margin_left, "r": 20, "t": 50 if "updatemenus" in layout else 20, "b": 55}
    plain = {"font": _FONT, "margin": margin, "height": height, "plot_bgcolor": "white", "paper_bgcolor": "white"}
    return {"data": data, "layout": {**plain, **layout}}


def _number(value: float) -> float | None:
    """For JSON, which has no NaN."""
    return value if np.isfinite(value) else None
