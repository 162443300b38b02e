"""The charts of a campaign's page."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.plugins.campaign.rows import FIRST_LIMIT
from ffsm_drake.plugins.campaign.statistics import GRID_METRICS, Findings
from ffsm_drake.show.chart import Chart, Curve, Level, View
from ffsm_drake.show.style import BLUE, NEUTRAL, UNSTABLE, Style, styles_of

Json = dict[str, Any]

FAILED = "#CC3311"
SETTLED = "#4477AA"
_LIMITS = (FAILED, "#EE7733", "#AA3377", "#009988", "#BBBBBB")  # failed runs by the first limit
_SHARE = (0.0, 101.0)  # %


def chart_views(findings: Findings) -> dict[str, list[View]]:
    """Section -> its charts; sections without any are left out."""
    limits = sorted({limit for runs in findings.table.runs.values() for limit in limits_of(runs)})
    colors = dict(zip(limits, itertools.cycle(_LIMITS), strict=False))  # the same in every map
    charts = {
        "success": [_success(findings)],
        "accuracy": [_cumulative(findings, metric) for metric in ("itae", "isv")],
        "difference": _differences(findings),
        "sensitivity": [_sensitivity(findings)] if findings.drivers else [],
        "pairs": [_pairs(findings)] if len(findings.pairs) else [],
        "map": []
        if findings.map is None
        else [_map(findings, name, colors) for name in findings.table.runs],
    }
    views = {key: [View(label="", charts=shown)] for key, shown in charts.items()}
    views["grid"] = _grid(findings)
    return {key: shown for key, shown in views.items() if any(view.charts for view in shown)}


def _styles(findings: Findings) -> dict[str, Style]:
    names = list(findings.table.runs)
    return dict(zip(names, styles_of(names), strict=True))


def _bars(title: str, traces: Sequence[Json], rows: Sequence[str], **rest: Any) -> Chart:
    """Horizontal bars over the page's whole width."""
    horizontal = [trace | {"orientation": "h"} for trace in traces]
    height = 90 + 40 * max(len(rows), len(rows) * len(traces) // 2)
    return Chart(
        title=title, curves=[], kind="full", rows=rows, traces=horizontal, height=height, **rest
    )


def _success(findings: Findings) -> Chart:
    """Success rate of every controller with its interval."""
    styles, rates = _styles(findings), findings.success
    value, low, high = 100.0 * np.array([(r.value, r.low, r.high) for r in rates.values()]).T
    bars = {
        "type": "bar", "x": value, "y": np.arange(len(rates)),
        "marker": {"color": [styles[name].color for name in rates], "opacity": 0.6},
        "error_x": {
            "type": "data", "symmetric": False, "color": NEUTRAL, "array": high - value,
            "arrayminus": value - low,
        },
        "hovertemplate": "%{y}: %{x:.2f} %<extra></extra>",
    }  # fmt: skip
    title = "Share of settled runs; the whiskers are the interval"
    names = [findings.spec.label(name) for name in rates]
    return _bars(title, [bars], names, x="settled runs [%]", range_x=_SHARE)


def _cumulative(findings: Findings, metric: str) -> Chart:
    """Share of all cases that settled with at most a given value of the metric."""
    curves, name = [], metric.upper()
    for controller, style in _styles(findings).items():
        runs = findings.table.runs[controller]
        x = np.sort(runs.loc[runs["is_settled"] & np.isfinite(runs[metric]), metric])
        y = 100.0 * np.arange(1, x.size + 1) / max(len(runs), 1)
        label = findings.spec.label(controller)
        curves.append(Curve(x, y, style, label, width=2.0, steps=True))
    return Chart(
        title=f"Cases settled with at most a given {name}", kind="chart", curves=curves, x=name,
        y="settled [% of cases]", log_x="~g", range=_SHARE, legend="inside",
    )  # fmt: skip


def _differences(findings: Findings) -> list[Chart]:
    """Return the distribution of each pair's ITAE ratio on the same cases: quartiles and the middle
    90 %.
    """
    pairs = [item for item in findings.differences if item.ratios.size]
    levels = {"lowerfence": 0.05, "q1": 0.25, "median": 0.5, "q3": 0.75, "upperfence": 0.95}
    boxes = {
        "type": "box", "line": {"color": BLUE, "width": 1.4}, "name": "",
        "y": np.arange(len(pairs)),
        **{name: [np.quantile(each.ratios, at) for each in pairs] for name, at in levels.items()},
    }  # fmt: skip
    title = (
        "Ratio of ITAE on the same case (below 1: the first is more accurate): quartiles and "
        "the middle 90 %"
    )
    rows = [" / ".join(map(findings.spec.label, (item.first, item.second))) for item in pairs]
    one = [Level(1.0, axis="x")]
    return [_bars(title, [boxes], rows, x="ratio of ITAE", log_x="~g", levels=one)] if pairs else []


def _grid(findings: Findings) -> list[View]:
    """Metrics over the value of a grid that has most numbers, a view for each combination of the
    others.
    """
    if findings.grid.empty or findings.table.values.empty:
        return []
    levels = {name: item.levels for name, item in findings.spec.distributions.items()}
    along = max(findings.table.values, key=lambda name: len(levels[name]))
    others = findings.grid[[name for name in levels if name != along]].agg(", ".join, axis=1)
    return [
        View(
            label=label, charts=[_grid_chart(findings, along, points, key) for key in GRID_METRICS]
        )
        for label, points in findings.grid.groupby(others, sort=False)
    ]


def _grid_chart(findings: Findings, along: str, points: pd.DataFrame, metric: str) -> Chart:
    values, curves = findings.spec.distributions[along].levels, []
    points = points.assign(x=points[along].map(values)).sort_values("x")
    for name, style in _styles(findings).items():
        own = points.loc[points["controller"] == name, ["x", metric]]
        x, y = own.to_numpy(float).T
        look: dict[str, Any] = {"width": 2.0, "marker": "circle", "size": 6.0}
        curves.append(Curve(x, y, style, findings.spec.label(name), **look))
    wide = min(values.values()) > 0 and max(values.values()) >= 100 * min(values.values())
    return Chart(
        title=GRID_METRICS[metric], kind="chart", curves=curves, x=along, legend="inside",
        log_x="~e" if wide else "", log_y="~g",
    )  # fmt: skip


def _sensitivity(findings: Findings) -> Chart:
    """Share of the variance of failure explained by each value, and the share expected by
    chance.
    """
    traces = []
    for controller, style in _styles(findings).items():
        of_controller = findings.sensitivities["controller"] == controller
        items = findings.sensitivities[of_controller].set_index("name").loc[findings.drivers]
        traces.append({
            "type": "bar", "name": findings.spec.label(controller), "y": np.arange(len(items)),
            "x": 100.0 * items["share"],
            "customdata": np.column_stack([items["correlation"], 100.0 * items["chance"]]),
            "marker": {
                "color": style.color,
                "opacity": np.where(items["matters"], 1.0, 0.35),
            },
            "hovertemplate": "%{y}: %{x:.1f} % (chance %{customdata[1]:.1f} %), rank "
            "correlation %{customdata[0]:.2f}",
        })  # fmt: skip
    title = (
        "Share of the variance of failure explained by one value alone; pale: no more than chance"
    )
    x = "explained variance of failure [%]"
    return _bars(title, traces, findings.drivers, x=x, legend="inside")


def _pairs(findings: Findings) -> Chart:
    """Share of the variance of failure that pairs of values explain beyond each alone."""
    found = findings.pairs.assign(pair=findings.pairs["first"] + " and " + findings.pairs["second"])
    rows, traces = list(dict.fromkeys(found["pair"])), []
    for controller, style in _styles(findings).items():
        own = found[found["controller"] == controller]
        if own.empty:
            continue
        traces.append({
            "type": "bar", "name": findings.spec.label(controller),
            "y": [rows.index(pair) for pair in own["pair"]], "x": 100.0 * own["share"],
            "customdata": np.column_stack([100.0 * own["chance"], 100.0 * own["observed"]]),
            "text": own["sides"], "textposition": "none",
            "marker": {"color": style.color},
            "hovertemplate": "%{y}: %{x:.1f} % (chance %{customdata[0]:.1f} %)<br>"
            "%{customdata[1]:.0f} % fail where they are %{text}",
        })  # fmt: skip
    title = "Share of the variance of failure explained by two values together, beyond each alone"
    x = "explained variance of failure [%]"
    return _bars(title, traces, rows, x=x, legend="inside")


def _marked(runs: pd.DataFrame, colors: Mapping[str, str]) -> list[tuple[pd.Series, str, str, str]]:
    """Return the groups of runs to distinguish: mask, label, color and symbol; failed runs by the
    first limit they left.
    """
    failed = ~runs["is_settled"]
    marked = [(~failed, "settled", SETTLED, "circle")]
    if FIRST_LIMIT not in runs:
        return [*marked, (failed, "not settled", FAILED, "x")]
    refused = runs["outcome"] == "refused"
    for limit, count in limits_of(runs).items():
        which = failed & ~refused & (runs[FIRST_LIMIT] == limit)
        marked.append((which, f"{limit or 'within all limits'}: {count}", colors[limit], "x"))
    return [
        *marked,
        (refused, f"no plan within the limits: {refused.sum()}", NEUTRAL, "triangle-up"),
    ]


def limits_of(runs: pd.DataFrame) -> dict[str, int]:
    """Return the limits that failed runs left first, "" for none, and how many; the most frequent
    first.
    """
    if FIRST_LIMIT not in runs:
        return {}
    failed = runs[~runs["outcome"].isin(["settled", "refused", "error"])]
    counts = failed.groupby(FIRST_LIMIT).size().sort_values(ascending=False, kind="stable")
    return dict(counts)


def _map(findings: Findings, controller: str, colors: Mapping[str, str]) -> Chart:
    """Outcomes of one controller over two values, and where it is predicted to fail."""
    grid, runs = findings.map, findings.table.runs[controller]
    assert grid is not None
    known = np.isfinite(grid.radius.get(controller, np.nan)).any()
    boundary = {
        "type": "contour", "x": grid.x, "y": grid.y,
        "z": grid.side(controller) if known else [],
        # One level, at 1: clear below it, shaded above.
        "autocontour": False,
        "contours": {"start": 1.0, "end": 1.0, "size": 0.1, "coloring": "fill"},
        "zmin": 0.95, "zmax": 1.05, "showscale": False, "hoverinfo": "skip",
        "colorscale": [[0.0, "rgba(255, 255, 255, 0)"], [1.0, UNSTABLE]],
        "line": {"color": NEUTRAL, "width": 2, "smoothing": 0},
    }  # fmt: skip
    values = findings.table.values.loc[runs.index]
    x, y = (values[name].to_numpy() for name in (grid.x_name, grid.y_name))
    texts = [f"case {case}: {outcome}" for case, outcome in runs["outcome"].items()]
    size = 7.0 if len(runs) < 1000 else 4.0
    curves = [
        Curve(
            x[which], y[which], Style(color), label, line=False, marker=symbol, size=size,
            texts=list(itertools.compress(texts, which)),
        )
        for which, label, color, symbol in _marked(runs, colors)
    ]  # fmt: skip
    return Chart(
        title=findings.spec.label(controller), kind="map", curves=curves, legend="inside",
        traces=[boundary] if known else [], x=grid.x_name, y=grid.y_name,
        log_x="~g" * grid.x_log, log_y="~g" * grid.y_log,
    )  # fmt: skip
