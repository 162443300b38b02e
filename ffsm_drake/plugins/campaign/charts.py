"""The charts of a campaign's page."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.plugins.campaign.statistics import Findings, GridPoint, Runs
from ffsm_drake.runs.metrics import METRICS
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.curves import cumulative
from ffsm_drake.show.panels import Panel, Thinning, Trace, View, panel
from ffsm_drake.show.style import BLUE, NEUTRAL, UNSTABLE, Style, styles_of

FAILED = "#CC3311"
SETTLED = "#4477AA"
_LIMITS = (FAILED, "#EE7733", "#AA3377", "#009988", "#BBBBBB")  # failed runs by the first limit
_THIN = Thinning(1500)
_SHARE = (0.0, 101.0)  # %
_HEADINGS = {each.column_name: each.column_heading for each in METRICS}
GRID_METRICS = {
    name: _HEADINGS[name]
    for name in ("isv", "itae", "peak_effort_base_position", "peak_error_base_rotation")
}


def chart_views(findings: Findings) -> dict[str, list[View]]:
    """Section -> its charts; sections without any are left out."""
    limits = sorted({limit for runs in findings.table.runs.values() for limit in limits_of(runs)})
    colors = dict(zip(limits, itertools.cycle(_LIMITS), strict=False))  # the same in every map
    panels = {
        "success": [_success(findings)],
        "accuracy": [_cumulative(findings, metric) for metric in ("itae", "isv")],
        "difference": _differences(findings),
        "sensitivity": [_sensitivity(findings)] if findings.drivers else [],
        "map": [_map(findings, runs, colors) for runs in findings.table.runs.values()]
        if findings.map is not None
        else [],
    }
    views = {key: [View(label="", panels=shown)] for key, shown in panels.items() if shown}
    grid = _grid(findings)
    return views | ({"grid": grid} if grid else {})


def _styles(findings: Findings) -> dict[str, Style]:
    names = list(findings.table.runs)
    return dict(zip(names, styles_of(names), strict=True))


def _bars(title: str, traces: Sequence[Trace], *, x: str, rows: int, **rest: Any) -> Panel:
    """Horizontal bars over the page's whole width, the first row at the top."""
    chart = Chart(title=title, x=x, curves=[], kind="full", height=90 + 40 * rows, **rest)
    rows_down = {"autorange": "reversed", "showgrid": False}
    return panel(chart, _THIN, before=traces, yaxis=rows_down)


def _success(findings: Findings) -> Panel:
    """Success rate of every controller with its interval."""
    styles, rates = _styles(findings), findings.success
    whiskers = {
        "array": [100.0 * (rate.high - rate.value) for rate in rates.values()],
        "arrayminus": [100.0 * (rate.value - rate.low) for rate in rates.values()],
    }
    bars: Trace = {
        "type": "bar",
        "orientation": "h",
        "x": [100.0 * rate.value for rate in rates.values()],
        "y": [findings.spec.label(name) for name in rates],
        "marker": {"color": [styles[name].color for name in rates], "opacity": 0.6},
        "error_x": {"type": "data", "symmetric": False, "color": NEUTRAL, **whiskers},
        "hovertemplate": "%{y}: %{x:.2f} %<extra></extra>",
    }
    title = "Share of settled runs; the whiskers are the interval"
    return _bars(title, [bars], x="settled runs [%]", rows=len(rates), range_x=_SHARE)


def _cumulative(findings: Findings, metric: str) -> Panel:
    """Share of all cases that settled with at most a given value of the metric."""
    curves, name = [], metric.upper()
    for controller, style in _styles(findings).items():
        runs = findings.table.runs[controller]
        x, y = cumulative(runs.metrics[metric][runs.settled], runs.case.size)
        label = findings.spec.label(controller)
        curves.append(Curve(x, y, style, label, width=2.0, steps=True))
    chart = Chart(
        title=f"Cases settled with at most a given {name}", kind="chart", curves=curves, x=name,
        y="settled [% of cases]", log_x="~g", range=_SHARE,
        legend=True,
    )  # fmt: skip
    return panel(chart, _THIN)


def _differences(findings: Findings) -> list[Panel]:
    """Return the distribution of each pair's ITAE ratio on the same cases: quartiles and the middle
    90 %.
    """
    pairs = [item for item in findings.differences if item.ratios.size]
    if not pairs:
        return []
    levels = {"lowerfence": 0.05, "q1": 0.25, "median": 0.5, "q3": 0.75, "upperfence": 0.95}
    boxes: Trace = {
        "type": "box", "orientation": "h", "line": {"color": BLUE, "width": 1.4}, "name": "",
        "y": [
            " /<br>".join(map(findings.spec.label, (item.first, item.second))) for item in pairs
        ],
    }  # fmt: skip
    for name, level in levels.items():
        boxes[name] = [float(np.quantile(item.ratios, level)) for item in pairs]
    title = (
        "Ratio of ITAE on the same case (below 1: the first is more accurate): quartiles and "
        "the middle 90 %"
    )
    one = [Level(1.0, axis="x")]
    return [_bars(title, [boxes], x="ratio of ITAE", rows=len(pairs), log_x="~g", levels=one)]


def _grid(findings: Findings) -> list[View]:
    """Metrics over the value of a grid that has most numbers, a view for each combination of the
    others.
    """
    if not findings.grid or not findings.table.values:
        return []
    levels = {name: item.levels for name, item in findings.spec.distributions.items()}
    along = max(findings.table.values, key=lambda name: len(levels[name]))
    views: dict[str, list[GridPoint]] = {}
    for point in findings.grid:
        others = [level for name, level in point.levels.items() if name != along]
        views.setdefault(", ".join(others), []).append(point)
    return [
        View(
            label=label, panels=[_grid_panel(findings, along, points, key) for key in GRID_METRICS]
        )
        for label, points in views.items()
    ]


def _grid_panel(findings: Findings, along: str, points: Sequence[GridPoint], metric: str) -> Panel:
    values, curves = findings.spec.distributions[along].levels, []
    for name, style in _styles(findings).items():
        own = sorted(
            (values[point.levels[along]], point.means[metric])
            for point in points
            if point.controller == name
        )
        x, y = np.array(own, dtype=float).reshape(-1, 2).T
        look: dict[str, Any] = {"width": 2.0, "marker": "circle", "size": 6.0}
        curves.append(Curve(x, y, style, findings.spec.label(name), **look))
    wide = min(values.values()) > 0 and max(values.values()) >= 100 * min(values.values())
    chart = Chart(
        title=GRID_METRICS[metric], kind="chart", curves=curves, x=along, legend=True,
        log_x="~e" if wide else "", log_y="~g",
    )  # fmt: skip
    return panel(chart, _THIN)


def _sensitivity(findings: Findings) -> Panel:
    """Share of the variance of failure explained by each value, and the share expected by
    chance.
    """
    names = findings.drivers
    traces: list[Trace] = []
    for k, (controller, style) in enumerate(_styles(findings).items()):
        by_name = {
            item.name: item for item in findings.sensitivities if item.controller == controller
        }
        items = [by_name[name] for name in names]
        opacity = [1.0 if item.matters else 0.35 for item in items]
        traces.append({
            "type": "bar",
            "orientation": "h",
            "name": findings.spec.label(controller),
            "y": names,
            "x": [100.0 * item.share for item in items],
            "customdata": [[item.correlation, 100.0 * item.chance] for item in items],
            "marker": {"color": style.color, "opacity": opacity},
            "offsetgroup": str(k),
            "hovertemplate": "%{y}: %{x:.1f} % (chance %{customdata[1]:.1f} %), rank "
            "correlation %{customdata[0]:.2f}",
        })  # fmt: skip
    title = (
        "Share of the variance of failure explained by one value alone; pale: no more than chance"
    )
    rows = 1 + len(names) * max(1, len(traces) // 2)
    x = "explained variance of failure [%]"
    return _bars(title, traces, x=x, rows=rows, legend=True)


def _marked(runs: Runs, colors: Mapping[str, str]) -> list[tuple[np.ndarray, str, str, str]]:
    """Return the groups of runs to distinguish: mask, label, color and symbol; failed runs by the
    first limit they left.
    """
    failed = ~runs.settled
    marked = [(runs.settled, "settled", SETTLED, "circle")]
    if runs.first_limit is None:
        return [*marked, (failed, "not settled", FAILED, "x")]
    refused = runs.outcome == "refused"
    for limit, count in limits_of(runs).items():
        which = failed & ~refused & (runs.first_limit == limit)
        marked.append((which, f"{limit or 'within all limits'}: {count}", colors[limit], "x"))
    return [
        *marked,
        (refused, f"no plan within the limits: {refused.sum()}", NEUTRAL, "triangle-up"),
    ]


def limits_of(runs: Runs) -> dict[str, int]:
    """Return the limits that failed runs left first, "" for none, and how many; the most frequent
    first.
    """
    if runs.first_limit is None:
        return {}
    failed = runs.first_limit[
        ~runs.settled & (runs.outcome != "refused") & (runs.outcome != "error")
    ]
    names, counts = np.unique(failed, return_counts=True)
    return {str(names[i]): int(counts[i]) for i in np.argsort(-counts, kind="stable")}


def _map(findings: Findings, runs: Runs, colors: Mapping[str, str]) -> Panel:
    """Outcomes of one controller over two values, and where it is predicted to fail."""
    grid = findings.map
    assert grid is not None
    traces: list[Trace] = []
    if runs.controller in grid.radius and np.isfinite(grid.radius[runs.controller]).any():
        traces.append({
            "type": "contour",
            "x": grid.x,
            "y": grid.y,
            "z": grid.side(runs.controller),
            # One level, at 1: clear below it, shaded above.
            "autocontour": False,
            "contours": {"start": 1.0, "end": 1.0, "size": 0.1, "coloring": "fill"},
            "zmin": 0.95,
            "zmax": 1.05,
            "colorscale": [[0.0, "rgba(255, 255, 255, 0)"], [1.0, UNSTABLE]],
            "showscale": False,
            "line": {"color": NEUTRAL, "width": 2, "smoothing": 0},
            "hoverinfo": "skip",
        })  # fmt: skip
    x, y = (findings.table.values[axis][runs.case] for axis in (grid.x_name, grid.y_name))
    for which, label, color, symbol in _marked(runs, colors):
        cases = zip(runs.case[which], runs.outcome[which], strict=True)
        traces.append({
            "type": "scattergl" if x.size > 3000 else "scatter",
            "mode": "markers",
            "name": label,
            "x": x[which],
            "y": y[which],
            "text": [f"case {case}: {outcome}" for case, outcome in cases],
            "hovertemplate": "%{text}<br>%{x:.4g}, %{y:.4g}<extra></extra>",
            "marker": {"color": color, "symbol": symbol, "size": 7 if x.size < 1000 else 4},
        })  # fmt: skip
    chart = Chart(
        title=findings.spec.label(runs.controller), kind="map", curves=[], legend=True,
        x=grid.x_name, y=grid.y_name, log_x="~g" * grid.x_log, log_y="~g" * grid.y_log,
    )  # fmt: skip
    plain = {"zeroline": False}
    return panel(chart, _THIN, before=traces, xaxis=plain, yaxis=plain)
