"""Matplotlib figures of one run, or of several overlaid. Each function returns a Figure."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from ffsm_drake.common.files import published
from ffsm_drake.common.steps import step
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.chart import Chart, merged
from ffsm_drake.show.figures.axes import draw, plain
from ffsm_drake.show.results import Result, results_of
from ffsm_drake.show.run_charts import (
    attitude_charts,
    coordinate_charts,
    position_charts,
    rms_charts,
    step_charts,
)
from ffsm_drake.show.style import GROUP_TITLES, VERMILION
from ffsm_drake.spacecraft.coordinates import BASE_POSITION

FORMATS = ("png", "pdf", "svg")
_EFFORTS = {"N m": "torque", "N": "force"}
_TALLEST = 1.28  # height of a page's figure, of its width
_DOTS = {"png": 130, "pdf": 300, "svg": 300}  # per inch, in vector files of noisy curves only
# without the date: the same run gives the same file
_METADATA: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}


@step("drawing figures")
def save_figures(
    records: Sequence[RunRecord],
    directory: Path,
    formats: Sequence[str] = FORMATS[:1],
    *,
    width: float | None = None,
) -> list[Path]:
    """Draw every figure of one or several runs into a directory, all or none; returns the paths.

    Args:
      records: the runs.
      directory: folder for the files.
      formats: of ``FORMATS``; a file of each figure in each format.
      width: of a page, inches, to fit the figures to, with small labels and no headings.

    Raises:
      RecordError: a file cannot be written.
    """
    figures = {
        "trajectories": plot_trajectories(records[0]),
        "errors": plot_errors(records),
        "efforts": plot_efforts(records),
        "gains": plot_gains(records),
    }
    drawn = {name: figure for name, figure in figures.items() if figure is not None}
    if width is not None:
        for figure in drawn.values():
            _fit(figure, width)
    names = [f"{name}.{kind}" for kind in formats for name in drawn]
    with published(directory) as folder, mpl.rc_context({"svg.hashsalt": "ffsm_drake"}):
        for file in names:
            name, _, kind = file.partition(".")
            drawn[name].savefig(folder / file, dpi=_DOTS[kind], metadata=_METADATA.get(kind))
    return [directory / name for name in names]


def _fit(figure: Figure, width: float) -> None:
    """Fit a figure to a page of a width, inches: labels of 7 pt, of 5.5 pt on a full page, no
    heading.
    """
    scale = width / figure.get_figwidth()
    height = 1.2 * scale * figure.get_figheight()
    is_tall = height > _TALLEST * width
    figure.set_size_inches(width, min(height, _TALLEST * width))
    for text in [*figure.texts]:  # the heading among them
        text.remove()
    for axes in figure.axes:
        axes.tick_params(which="both", labelsize=6, width=0.6, pad=1)
        axes.yaxis.labelpad = 0
        if is_tall:
            axes.tick_params(labelbottom=bool(axes.get_xlabel()))
        if hasattr(axes, "zaxis"):
            axes.set_box_aspect(None, zoom=0.9)  # type: ignore[call-arg]
    for text in figure.findobj(Text):
        text.set_fontsize(min(text.get_fontsize(), 5.5 if is_tall else 7))
    for line in figure.findobj(Line2D):
        line.set_linewidth(0.7 * line.get_linewidth())


def plot_trajectories(record: RunRecord) -> Figure:
    """Return the paper's Figure 3: end effector in space, base attitude and position, joints.

    The reference is dashed.
    """
    figure = _figure(record, "Planned and tracked trajectories", (11.0, 8.0))
    _draw_path(figure.add_subplot(2, 2, 1, projection="3d"), record)
    run = results_of([record])
    positions = position_charts(run)
    base = [chart for chart in positions if chart.title.replace(" ", "_") in BASE_POSITION]
    panels = (
        merged(attitude_charts(run), "(b) Base attitude"),
        merged(base, "(c) Base position"),
        merged([chart for chart in positions if chart not in base], "(d) Joints"),
    )
    for number, (chart, what) in enumerate(
        zip(panels, ("angle", "position", "position"), strict=True), start=2
    ):
        axes = figure.add_subplot(2, 2, number)
        draw(axes, chart, what=what)
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def _draw_path(space: Any, record: RunRecord) -> None:
    """The end effector's path in three-dimensional axes, and its reference."""
    path, desired = (
        record.dataset[f"{kind}end_effector_position"].values for kind in ("", "desired_")
    )
    space.plot(*path.T, color=VERMILION, linewidth=2, label="end effector")
    space.plot(*desired.T, color="black", linestyle="--", linewidth=1, label="reference")
    space.scatter(*path[0], color="black", marker="o", s=25, label="start")
    space.scatter(*path[-1], color="black", marker="*", s=60, label="end")
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    space.set_title("(a) End effector in task space", y=0.99, fontsize=10)
    space.locator_params(nbins=4)
    space.tick_params(labelsize=8)
    space.view_init(elev=22.0, azim=-125.0)
    space.set_box_aspect(None, zoom=1.0)
    space.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.98, 0.92))


def plot_errors(records: Sequence[RunRecord]) -> Figure:
    """Return the tracking error of every coordinate, runs overlaid (the paper's Figure 4).

    Two panels each: the error itself, the roughest run behind the others, and below it its rms over
    one second on a logarithmic axis, to separate controllers with errors that differ by orders of
    magnitude or overlap in noise.
    """
    runs = results_of(records)
    errors = coordinate_charts(runs, "error", "{unit}")
    return _plot_coordinates(runs, errors, rms_charts(runs), "Tracking errors", "error", "rms")


def plot_efforts(records: Sequence[RunRecord]) -> Figure:
    """Control force or torque of every coordinate, runs overlaid (the paper's Figure 5).

    Two panels each: the force itself, the roughest run behind the others, and below it the rms over
    one second of its change from one control sample to the next, on a logarithmic axis: noise and
    chattering without the motion.
    """
    runs = results_of(records)
    forces = coordinate_charts(runs, "generalized_force", "{effort}")
    title = "Control forces and torques"
    return _plot_coordinates(runs, forces, step_charts(runs), title, "", "rms step")


def plot_gains(records: Sequence[RunRecord]) -> Figure | None:
    """K_s and G of every coordinate over time, a column per adaptive run; None if there is none."""
    kinds = {"reaching_gain": ("Kₛ", "1/s"), "switching_gain": ("G", "rad/s², m/s²")}
    adaptive = [record for record in records if any(kind in record.dataset for kind in kinds)]
    if not adaptive:
        return None
    figure = _figure(records[0], "Adaptive gains", (max(6.5, 4.6 * len(adaptive)), 6.5))
    panels = np.atleast_2d(figure.subplots(2, len(adaptive), squeeze=False, sharex=True))
    dashes = dict(zip(GROUP_TITLES.values(), ("solid", "dash", "dot"), strict=True))
    handles: list[Any] = []
    for column, run in zip(panels.T, results_of(adaptive), strict=True):
        for axes, (kind, (name, unit)) in zip(column, kinds.items(), strict=True):
            title = plain(run.label) if axes is column[0] else ""
            if kind in run.record.dataset:
                charts = coordinate_charts([run], kind, unit)
                draw(axes, merged(charts, "", dashes=dashes), what=name)
                handles = axes.get_legend_handles_labels()[0]
            else:
                text = "constant or absent"
                axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
                axes.set_axis_off()
            axes.set_title(title, fontsize=10)
        column[0].set_xlabel("")
    figure.legend(handles=handles, loc="outside right upper", fontsize=8)
    return figure


def _plot_coordinates(
    runs: Sequence[Result],
    upper: Sequence[Chart],
    lower: Sequence[Chart],
    title: str,
    what: str,
    lower_what: str,
) -> Figure:
    """For each coordinate its upper chart and below it its lower one, and the runs' legend."""
    columns = 3
    rows = -(-(len(upper) + 1) // columns)
    alone = len(upper) % columns == 0  # the legend, in its row
    heights = [1.0] * (rows - 1) + [0.45 if alone else 1.0]
    height = 3.1 * sum(heights) + 1.1
    figure = _figure(runs[0].record, title, (12.0, height), layout=None)
    grid = figure.add_gridspec(
        rows, columns, left=0.075, right=0.985, bottom=0.55 / height, top=1.0 - 1.05 / height,
        wspace=0.3, hspace=0.3, height_ratios=heights,
    )  # fmt: skip
    for k, charts in enumerate(zip(upper, lower, strict=True)):
        cell = grid[k // columns, k % columns].subgridspec(2, 1, height_ratios=(3, 2), hspace=0.12)
        upper_axes = figure.add_subplot(cell[0])
        lower_axes = figure.add_subplot(cell[1], sharex=upper_axes)
        _draw_coordinate((upper_axes, lower_axes), charts, f"({chr(ord('a') + k)})")
        unit = charts[0].y
        upper_axes.set_ylabel(f"{what or _EFFORTS[unit]} [{unit}]", fontsize=8)
        lower_axes.set_ylabel(lower_what, fontsize=8)
        lower_axes.set_xlabel("time [s]" if k + columns >= len(upper) else "", fontsize=8)
    empty = figure.add_subplot(grid[-1, :] if alone else grid[-1, len(upper) % columns])
    empty.set_axis_off()
    handles = [
        Line2D([], [], linewidth=1.3, label=plain(_ended(run)), **run.style.matplotlib)
        for run in runs
    ]
    empty.legend(
        handles=handles, loc="lower center" if alone else "center", fontsize=10, handlelength=3.2,
        frameon=False, ncols=3 if alone else 1,
    )  # fmt: skip
    return figure


def _draw_coordinate(both: tuple[Axes, Axes], charts: tuple[Chart, Chart], letter: str) -> None:
    """The upper and the lower chart of a coordinate, with small labels."""
    upper, lower = both
    # Steps are held, and drawn small.
    draw(upper, _stepped(charts[0]))
    upper.set_title(f"{letter} {plain(charts[0].title)}", fontsize=10, loc="left")
    upper.set_title("")
    draw(lower, dataclasses.replace(charts[1], title=""), thickness=0.7, ticks=4)
    upper.set_xlabel("")
    upper.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
    upper.yaxis.get_offset_text().set_fontsize(8)
    for axes in both:
        axes.tick_params(labelsize=8, labelbottom=axes is lower)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))


def _stepped(chart: Chart) -> Chart:
    """Return every control sample of a chart as a thin step."""
    curves = [dataclasses.replace(curve, steps=True, width=0.9) for curve in chart.curves]
    return dataclasses.replace(chart, curves=curves)


def _ended(run: Result) -> str:
    """Return the label of a run, and how it ended early."""
    outcome = run.record.outcome
    return (
        run.label
        if outcome.completed
        else f"{run.label},\n{outcome.status} at {outcome.time:.1f} s"
    )


def _figure(
    record: RunRecord,
    title: str,
    size: tuple[float, float],
    *,
    layout: Literal["constrained"] | None = "constrained",
) -> Figure:
    figure = Figure(figsize=size, layout=layout)
    # The constrained layout keeps room for the title only if it places it itself.
    place = {} if layout == "constrained" else {"y": 1.0 - 0.12 / size[1]}
    figure.suptitle(f"{title}\n", fontsize=13, fontweight="bold", **place)
    description = plain(record.scenario.description)
    if not record.outcome.completed:
        description = f"{description}. {plain(record.outcome.message)}"
    figure.text(
        0.5, 1.0 - 0.4 / size[1], description, ha="center", va="top", fontsize=9, color="#444444"
    )
    return figure
