"""Matplotlib figures of one run, or of several overlaid. Each function returns a Figure."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from ffsm_drake.common.files import published
from ffsm_drake.common.steps import step
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.chart import Chart, Curve, merged
from ffsm_drake.show.figures.axes import plot_charts, save_figure
from ffsm_drake.show.results import Result, results_of
from ffsm_drake.show.run_charts import (
    attitude_charts,
    coordinate_charts,
    path_charts,
    position_charts,
    rms_charts,
    step_charts,
)
from ffsm_drake.show.style import GROUP_TITLES
from ffsm_drake.spacecraft.coordinates import BASE_POSITION

FORMATS = ("png", "pdf", "svg")
_EFFORTS = {"N m": "torque", "N": "force"}
_TALLEST = 1.28  # height of a page's figure, of its width


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
    files = {f"{name}.{kind}": figure for kind in formats for name, figure in drawn.items()}
    with published(directory) as folder:
        for file, figure in files.items():
            save_figure(figure, folder / file)
    return [directory / file for file in files]


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
    for text in figure.findobj(Text):
        text.set_fontsize(min(text.get_fontsize(), 5.5 if is_tall else 7))
    for line in figure.findobj(Line2D):
        line.set_linewidth(0.7 * line.get_linewidth())


def plot_trajectories(record: RunRecord) -> Figure:
    """Return the paper's Figure 3: end effector in space, base attitude and position, joints.

    The reference is dashed.
    """
    run = results_of([record])
    positions = position_charts(run)
    base = [chart for chart in positions if chart.title.replace(" ", "_") in BASE_POSITION]
    joints = [chart for chart in positions if chart not in base]
    path = merged(path_charts(run)[:1], title="End effector in task space", kind="space")
    groups = (
        ("Base attitude", "angle", attitude_charts(run)),
        ("Base position", "position", base),
        ("Joints", "position", joints),
    )
    stacks = [[path]] + [
        [merged(charts, title=title, what=what, legend="right")] for title, what, charts in groups
    ]
    title = "Planned and tracked trajectories"
    description = f"{_description(record)}; the reference is dashed"
    return plot_charts(stacks, title, description, columns=2, size=(11.0, 8.0))


def plot_errors(records: Sequence[RunRecord]) -> Figure:
    """Return the tracking error of every coordinate, runs overlaid (the paper's Figure 4).

    Two panels each: the error itself, the roughest run behind the others, and below it its rms over
    one second on a logarithmic axis, to separate controllers with errors that differ by orders of
    magnitude or overlap in noise.
    """
    runs = results_of(records)
    errors = coordinate_charts(runs, "error", "{unit}")
    return _plot_coordinates(runs, errors, rms_charts(runs), "Tracking errors", ("error", "rms"))


def plot_efforts(records: Sequence[RunRecord]) -> Figure:
    """Control force or torque of every coordinate, runs overlaid (the paper's Figure 5).

    Two panels each: the force itself, the roughest run behind the others, and below it the rms over
    one second of its change from one control sample to the next, on a logarithmic axis: noise and
    chattering without the motion.
    """
    runs = results_of(records)
    forces = coordinate_charts(runs, "generalized_force", "{effort}")
    title = "Control forces and torques"
    return _plot_coordinates(runs, forces, step_charts(runs), title, ("", "rms step"))


def plot_gains(records: Sequence[RunRecord]) -> Figure | None:
    """K_s and G of every coordinate over time, a column per adaptive run; None if there is none."""
    kinds = {"reaching_gain": ("Kₛ", "1/s"), "switching_gain": ("G", "rad/s², m/s²")}
    adaptive = [record for record in records if any(kind in record.dataset for kind in kinds)]
    if not adaptive:
        return None
    dashes = dict(zip(GROUP_TITLES.values(), ("solid", "dash", "dot"), strict=True))
    stacks = []
    for run in results_of(adaptive):
        stack = [
            merged(
                coordinate_charts([run], kind, unit), dashes=dashes, title=run.label, what=name,
                note="" if kind in run.record.dataset else "constant or absent",
            )
            for kind, (name, unit) in kinds.items()
        ]  # fmt: skip
        stacks.append([dataclasses.replace(stack[0], legend="right"), stack[1]])
    size = (max(6.5, 4.6 * len(adaptive)), 6.5)
    return plot_charts(
        stacks, "Adaptive gains", _description(records[0]), columns=len(stacks), size=size,
        heights=(1.0, 1.0),
    )  # fmt: skip


def _plot_coordinates(
    runs: Sequence[Result],
    upper: Sequence[Chart],
    lower: Sequence[Chart],
    title: str,
    what: tuple[str, str],
) -> Figure:
    """For each coordinate its upper chart and below it its lower one, and the runs' legend."""
    stacks = [
        [
            dataclasses.replace(
                above, x="", what=what[0] or _EFFORTS[above.y],
                curves=[
                    dataclasses.replace(curve, steps=True, width=0.9) for curve in above.curves
                ],
            ),
            dataclasses.replace(below, y="", what=what[1]),
        ]
        for above, below in zip(upper, lower, strict=True)
    ]  # fmt: skip
    none = np.empty(0)
    names = [Curve(none, none, run.style, _ended(run)) for run in runs]
    last = stacks[-1][1]
    stacks[-1][1] = dataclasses.replace(
        last, curves=[*names, *(dataclasses.replace(curve, name="") for curve in last.curves)]
    )
    size = (12.0, 3.1 * -(-len(stacks) // 3) + 1.1)
    description = _description(runs[0].record)
    return plot_charts(
        stacks, title, description, columns=3, size=size, heights=(3.0, 2.0), below=True
    )


def _ended(run: Result) -> str:
    """Return the label of a run, and how it ended early."""
    outcome = run.record.outcome
    return (
        run.label
        if outcome.completed
        else f"{run.label},\n{outcome.status} at {outcome.time:.1f} s"
    )


def _description(record: RunRecord) -> str:
    """Return the description of a run, and how it ended early."""
    outcome = record.outcome
    return ". ".join([record.scenario.description, outcome.message][: 2 - outcome.completed])
