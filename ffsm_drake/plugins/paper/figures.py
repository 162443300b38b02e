# ruff: noqa: RUF001 (the texts use mathematical signs)
"""The paper's Figures 2 to 5 redrawn, and two more. Each is written as PNG and SVG."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.common.files import written_whole
from ffsm_drake.common.numbers import rounded_up
from ffsm_drake.plugins.paper.runs import (
    CONTROLLERS,
    DISTURBANCES,
    PROPOSED,
    SETTINGS,
    Results,
    gain_of,
)
from ffsm_drake.plugins.paper.table import METRICS, Row
from ffsm_drake.plugins.paper.wording import DISTURBANCE_NAMES, NAMES, ending, fixed
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.scenario import load_scenario
from ffsm_drake.show.block_diagram import closed_loop_dot, write_diagram
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.figures.axes import draw, legend_below
from ffsm_drake.show.figures.run import plot_efforts, plot_errors, plot_trajectories
from ffsm_drake.show.style import BLACK, BLUE, GREEN, GRID, VERMILION, Style

FOLDER = "figures"
# The two settings where every controller completes.
DRAWN = {"euler": "explicit Euler", "bounded": "exact integration"}


_MARKS: dict[str, dict[str, Any]] = {
    "euler": {"marker": "o", "color": BLUE, "label": "ours, explicit Euler"},
    "bounded": {
        "marker": "s",
        "color": VERMILION,
        "label": "ours, exact integration, $K_s$ bounded",
    },
}
_PRINTED: dict[str, Any] = {
    "marker": "D",
    "markersize": 9,
    "markerfacecolor": "none",
    "markeredgewidth": 1.4,
    "color": "black",
    "label": "paper",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class FigureFile:
    """A written figure; if it could not be drawn, the paths are None and ``caption`` says why."""

    key: str
    title: str
    caption: str
    png: Path | None
    svg: Path | None


def write_figure_2(directory: Path) -> FigureFile:
    """The block diagram, by Graphviz."""
    path = directory / FOLDER / "fig2.dot"
    remark = write_diagram(closed_loop_dot(load_scenario("postcapture")), path)
    caption = (
        "Figure 2. The paper draws the inside of its controller; this is the wiring that was "
        "simulated, printed from "
        "the running Drake diagram: reference, controller, disturbance, plant and sensing."
    )
    return FigureFile(
        key="fig2",
        title="Block diagram",
        caption=f"{caption} Not drawn: {remark}" if remark else caption,
        png=None,
        svg=None if remark else path.with_suffix(".svg"),
    )


def write_figure_3(results: Results, directory: Path) -> list[FigureFile]:
    """Planned and tracked motion of the proposed controller."""
    written = []
    for setting, words in DRAWN.items():
        record = results.record(setting, PROPOSED)
        caption = (
            f"Figure 3 with {words}. Motion under the proposed controller, τ_d1: (a) end effector "
            "in task space, "
            "(b) base attitude as roll, pitch, yaw, (c) base position, (d) joints. Dashed: the "
            "planned motion, from "
            f"which the run departs by at most {_largest_departure(record)}."
        )
        title = f"Planned and tracked trajectories, {words}"
        written.append(
            _write(plot_trajectories(record), f"fig3_{setting}", title, caption, directory)
        )
    return written


def write_figure_4(results: Results, directory: Path) -> list[FigureFile]:
    """Tracking errors of the four controllers."""
    caption = (
        "Upper panels: true error e = q_d − q of every control sample, the roughest drawn first. "
        "Lower panels: rms of "
        "that error over one second, logarithmic, since the errors differ by orders of magnitude."
    )
    return _write_overlaid(results, directory, "fig4", "Tracking errors", plot_errors, caption)


def write_figure_5(results: Results, directory: Path) -> list[FigureFile]:
    """Control forces and torques of the four controllers."""
    caption = (
        "Upper panels: force or torque held over every control period, the roughest drawn first. "
        "Lower panels: rms "
        "over one second of its change from one sample to the next, logarithmic: the "
        "contribution of measurement noise and "
        "switching term beside the motion's own force."
    )
    return _write_overlaid(
        results, directory, "fig5", "Control forces and torques", plot_efforts, caption
    )


def _write_overlaid(
    results: Results,
    directory: Path,
    key: str,
    title: str,
    plot: Callable[[list[RunRecord]], Figure],
    caption: str,
) -> list[FigureFile]:
    written = []
    for setting, words in DRAWN.items():
        figure = plot([results.record(setting, name) for name in CONTROLLERS])
        text = (
            f"Figure {key[-1]} with {words}, four controllers, τ_d1, seed 0. (a) to (c) base "
            "attitude x, y, z; "
            f"(d) to (f) base position x, y, z; (g) to (k) joints 1 to 5. {caption}"
        )
        written.append(_write(figure, f"{key}_{setting}", f"{title}, {words}", text, directory))
    return written


def write_overview(rows: list[Row], directory: Path) -> FigureFile:
    """Write Table 2 as a figure."""
    title = "Table 2 as a picture"
    caption = (
        f"{title}: the paper's values and ours, means over the seeds. With exact integration and "
        "the published gains "
        "the proposed controller has no value to show: it diverges."
    )
    return _write(plot_overview(rows), "table2", title, caption, directory)


def write_divergence(results: Results, directory: Path) -> FigureFile:
    """Write the figure of the published gains on an exactly integrated plant."""
    caption = (
        "Not in the paper. The proposed controller, τ_d1, seed 0. Left: the largest K_s of the "
        "eleven coordinates, "
        "which law (9) adapts, and the limit (K_D + K_s) L < 2 of the sampled loop for a "
        "perfectly known mass matrix. "
        "Right: sum of the absolute errors. Explicit Euler at the control period raises the limit "
        "and hides the "
        "divergence."
    )
    title = "The published gains on an exactly integrated plant"
    return _write(plot_divergence(results), "divergence", title, caption, directory)


def plot_overview(rows: list[Row]) -> Figure:
    """ITAE and ISV of every row, the paper's and ours."""
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
    panels = figure.subplots(1, len(METRICS), sharey=True)
    places = {
        (disturbance, name): number * (len(CONTROLLERS) + 1) + k
        for number, disturbance in enumerate(DISTURBANCES)
        for k, name in enumerate(CONTROLLERS)
    }
    for axes, (metric, title) in zip(panels, METRICS.items(), strict=True):
        _draw_metric(axes, rows, metric, places)
        axes.set_title(title, fontweight="bold", pad=14)
    panels[0].set_xscale("log")
    panels[0].set_yticks(list(places.values()), [NAMES[name] for _, name in places])
    panels[0].invert_yaxis()
    for number, disturbance in enumerate(DISTURBANCES):
        panels[0].text(
            -0.16, number * (len(CONTROLLERS) + 1) - 0.8, _math(DISTURBANCE_NAMES[disturbance]),
            transform=panels[0].get_yaxis_transform(),
        )  # fmt: skip
    # one for each label
    handles = dict(zip(*panels[0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(
        handles=list(handles.values()), loc="outside lower center", ncols=3, frameon=False
    )
    return figure


def _draw_metric(
    axes: Axes, rows: list[Row], metric: str, places: dict[tuple[str, str], int]
) -> None:
    """A metric of every case (disturbance, controller) at its place, the paper's and ours."""
    cells = {(row.setting, row.disturbance, row.controller): getattr(row, metric) for row in rows}
    for case, place in places.items():
        printed = cells["euler", *case].paper
        means = {setting: cells[setting, *case].mean for setting in _MARKS}
        values = [printed, *means.values()]
        ends = [np.nanmin(values), np.nanmax(values)]
        axes.plot(ends, [place] * 2, color=GRID, linewidth=2, zorder=1)
        for setting, mark in _MARKS.items():
            axes.plot(means[setting], place, linestyle="none", markersize=7, **mark)
        axes.plot(printed, place, linestyle="none", zorder=3, **_PRINTED)
    labels = {"itae": "ITAE [rad s², m s²], logarithmic", "isv": "ISV [N² s, N² m² s]"}
    axes.set_xlabel(labels[metric])
    axes.grid(True, axis="x", color=GRID, linewidth=0.6)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def plot_divergence(results: Results) -> Figure:
    """K_s and the error of the proposed controller in the three settings."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    styles = {
        "exact": Style(VERMILION),
        "euler": Style(BLUE, "dash"),
        "bounded": Style(GREEN, "dashdot"),
    }
    gains, errors, top = [], [], 0.0
    for setting, style in styles.items():
        run, record = results.run(setting, PROPOSED), results.record(setting, PROPOSED)
        data, name = record.dataset, SETTINGS[setting].title.replace("K_s", "Kₛ")
        if not run.outcome.completed:
            name = f"{name}: {ending(run)}"
        time, gain = data["time"].values, data["reaching_gain"].values.max(axis=1)
        error = np.abs(data["error"].values).sum(axis=1)
        error = np.where(error > 0.0, error, np.nan)
        gains.append(Curve(time, gain, style, name, width=1.8))
        errors.append(Curve(time, error, Style(style.color), width=0.8))
        if run.outcome.completed:
            top = max(top, float(gain.max()))
        else:
            for curves, y in ((gains, gain), (errors, error)):
                end = Style(style.color)
                curves.append(Curve(time[-1:], y[-1:], end, line=False, marker="x", size=12.0))
    scenario = results.record("exact", PROPOSED).scenario
    limit = 2.0 / scenario.sample_time - gain_of(scenario, "k_d")
    level = Level(limit, f"limit {fixed(limit)}", style=Style(BLACK, "dot"))
    extent = (0.0, 1.15 * max(top, limit))
    gain_chart = Chart(title="Adapted gain", y="1/s", curves=gains, levels=[level], range=extent)
    draw(panels[0], gain_chart, what="largest Kₛ")
    error_chart = Chart(title="Tracking error", y="rad, m", curves=errors, log_y="~e")
    draw(panels[1], error_chart, what="‖e‖₁")
    legend_below(figure, panels[0])
    return figure


def _largest_departure(record: RunRecord) -> str:
    peak = record.metrics["peak_error"]
    rotation = max(peak["base_rotation"], peak["joints"])
    sizes = (1e6 * rounded_up(each, 2) for each in (rotation, peak["base_position"]))
    return "{:.2g} µrad and {:.2g} µm".format(*sizes)


def _write(figure: Figure, name: str, title: str, caption: str, directory: Path) -> FigureFile:
    png, svg = (directory / FOLDER / f"{name}{suffix}" for suffix in (".png", ".svg"))
    with written_whole(png) as temporary:
        figure.savefig(temporary, dpi=140)
    # The same figure gives the same file.
    with mpl.rc_context({"svg.hashsalt": name}), written_whole(svg) as temporary:
        figure.savefig(temporary, dpi=200, metadata={"Date": None})
    return FigureFile(key=name, title=title, caption=caption, png=png, svg=svg)


def _math(text: str) -> str:
    """Subscripts of the few symbols that the texts use, as Matplotlib writes them."""
    for plain, mathematical in (
        ("K_s", "$K_s$"),
        *[(f"τ_d{k}", rf"$\tau_{{d{k}}}$") for k in (1, 2, 3)],
    ):
        text = text.replace(plain, mathematical)
    return text
