"""The report's figures as pictures, with Matplotlib."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ffsm_drake.campaign.findings import Findings
from ffsm_drake.show.figures.run import LABELS, STYLES

FAILED = "#CC3311"
SETTLED = "#4477AA"


def success_picture(findings: Findings) -> Figure:
    """Success rate of every controller with its interval."""
    figure = Figure(figsize=(8.0, 0.9 + 0.6 * len(findings.success)), layout="constrained")
    axes = figure.subplots()
    for place, (name, rate) in enumerate(reversed(findings.success.items())):
        color = STYLES[name]["color"]
        axes.barh(place, 100.0 * rate.value, color=color, alpha=0.35, height=0.6)
        axes.plot([100.0 * rate.low, 100.0 * rate.high], [place, place], color=color, linewidth=3)
        axes.plot(100.0 * rate.value, place, "o", color=color)
    axes.set_yticks(range(len(findings.success)), [LABELS[name] for name in reversed(findings.success)])
    axes.set(xlim=(0, 101), xlabel="settled runs [%], with the 95 % Clopper-Pearson interval")
    _tidy(axes)
    return figure


def accuracy_picture(findings: Findings) -> Figure:
    """Share of all cases that settled with at most a given ITAE and effort."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    for axes, metric in zip(figure.subplots(1, 2), ("itae", "isv"), strict=True):
        for name, runs in findings.table.runs.items():
            values, share = cumulative(runs.metrics[metric][runs.settled], runs.case.size)
            axes.plot(values, share, label=LABELS[name], drawstyle="steps-post", **STYLES[name])
        axes.set(xscale="log", xlabel=metric.upper(), ylim=(0, 101), ylabel="settled with at most this [% of cases]")
        _tidy(axes)
    figure.axes[0].legend(fontsize=8)
    return figure


def difference_picture(findings: Findings) -> Figure:
    """Distribution of the ITAE ratio of every pair on the same cases."""
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    axes = figure.subplots()
    for difference in findings.differences:
        if difference.ratios.size:
            values, share = cumulative(difference.ratios, difference.ratios.size)
            axes.plot(values, share, drawstyle="steps-post", label=f"{difference.first} / {difference.second}")
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set(xscale="log", ylim=(0, 101), xlabel="ratio of ITAE on the same case")
    axes.set_ylabel("cases with at most this ratio [%]")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    _tidy(axes)
    return figure


def sensitivity_picture(findings: Findings) -> Figure:
    """Share of the variance of failure that each value explains."""
    names = findings.influential
    figure = Figure(figsize=(9.0, 1.2 + 0.7 * max(len(names), 1)), layout="constrained")
    axes = figure.subplots()
    controllers = list(findings.table.runs)
    height = 0.8 / len(controllers)
    for k, controller in enumerate(controllers):
        for place, name in enumerate(reversed(names)):
            (item,) = (s for s in findings.sensitivities if (s.name, s.controller) == (name, controller))
            at = place + 0.4 - height * (k + 0.5)
            share = np.nan_to_num(100.0 * item.share)
            axes.barh(
                at, share, height=0.9 * height, color=STYLES[controller]["color"], alpha=1.0 if item.matters else 0.3
            )
            axes.plot([100.0 * item.chance] * 2, [at - 0.45 * height, at + 0.45 * height], color="black", linewidth=1)
    axes.set_yticks(range(len(names)), list(reversed(names)))
    axes.set(xlabel="variance of failure that the value alone explains [%]; black: the 95 % level of chance")
    axes.legend(
        handles=[Line2D([], [], color=STYLES[name]["color"], linewidth=6, label=LABELS[name]) for name in controllers],
        fontsize=8,
    )
    _tidy(axes)
    return figure


def map_picture(findings: Findings) -> Figure:
    """Outcomes over two values, with the predicted boundary."""
    grid = findings.map
    assert grid is not None
    runs = list(findings.table.runs.values())
    columns = min(2, len(runs))
    rows = -(-len(runs) // columns)
    figure = Figure(figsize=(5.6 * columns, 4.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes, item in zip(panels.flat, runs, strict=False):
        side = grid.side(item.controller)
        axes.contourf(grid.x, grid.y, side, levels=[1.0, 2.0], colors=["#F4D9CC"])
        if side.min() < 1.0 <= side.max():
            axes.contour(grid.x, grid.y, side, levels=[1.0], colors="black", linewidths=2)
        x, y = (findings.table.at(name, item) for name in (grid.x_name, grid.y_name))
        size = 14 if x.size < 1000 else 4
        axes.scatter(x[item.settled], y[item.settled], s=size, color=SETTLED, label="settled")
        axes.scatter(x[~item.settled], y[~item.settled], s=size + 4, color=FAILED, marker="x", label="not settled")
        axes.set(title=LABELS[item.controller], xlabel=grid.x_name, ylabel=grid.y_name)
        axes.set(xscale="log" if grid.x_log else "linear", yscale="log" if grid.y_log else "linear")
        axes.set(xlim=(grid.x[0], grid.x[-1]), ylim=(grid.y[0], grid.y[-1]))
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels.flat[len(runs) :]:
        axes.remove()
    panels.flat[0].legend(fontsize=8, loc="upper left")
    return figure


def cumulative(values: np.ndarray, total: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorted values and the percentage of ``total`` that is at most each."""
    ordered = np.sort(values[np.isfinite(values)])
    return ordered, 100.0 * np.arange(1, ordered.size + 1) / max(total, 1)


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
