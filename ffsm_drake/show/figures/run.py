"""Matplotlib figures of one run, or of several overlaid. Each function returns a Figure."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ffsm_drake.common.files import written_whole
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show.curves import completed_range, moving_rms
from ffsm_drake.show.figures.axes import LARGEST, plain, set_log_scale, tidy
from ffsm_drake.show.style import (
    EFFORT_UNITS,
    GROUP_TITLES,
    SERIES,
    VERMILION,
    labels_of,
    styles_of,
)
from ffsm_drake.spacecraft.coordinates import BASE_POSITION

_STARTING_STEPS = 5


def save_figures(records: Sequence[RunRecord], directory: Path) -> list[Path]:
    """Draw every figure of one or several runs as PNG into a directory; returns the paths.

    Raises:
      RecordError: a file cannot be written.
    """
    figures = {
        "trajectories": plot_trajectories(records[0]),
        "errors": plot_errors(records),
        "efforts": plot_efforts(records),
        "gains": plot_gains(records),
    }
    paths = []
    for name, figure in figures.items():
        if figure is not None:
            path = directory / f"{name}.png"
            with written_whole(path) as temporary:
                figure.savefig(temporary, dpi=130)
            paths.append(path)
    return paths


def plot_trajectories(record: RunRecord) -> Figure:
    """The paper's Figure 3: end effector in space, base attitude and position, joints.

    The reference is dashed.
    """
    data = record.dataset
    figure = _figure(record, "Planned and tracked trajectories", (11.0, 8.0))
    space = figure.add_subplot(2, 2, 1, projection="3d")
    path, desired = (
        data["end_effector_position"].values,
        data["desired_end_effector_position"].values,
    )
    space.plot(*path.T, color=VERMILION, linewidth=2, label="end effector")
    space.plot(*desired.T, color="black", linestyle="--", linewidth=1, label="reference")
    space.scatter(*path[0], color="black", marker="o", s=25, label="start")
    space.scatter(*path[-1], color="black", marker="*", s=60, label="end")
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    space.set_title("(a) End effector in task space", y=0.99)
    space.locator_params(nbins=4)
    space.tick_params(labelsize=8)
    space.view_init(elev=22.0, azim=-125.0)
    space.set_box_aspect(None, zoom=1.0)
    space.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.98, 0.92))

    joints = data["group"].values == "joints"
    joint_names = data["coordinate"].values[joints]
    degrees = np.rad2deg(1.0)
    revolute = (data["unit"].values[joints] == "rad").all()
    travel = ("angle [deg]", degrees) if revolute else ("angle [rad], travel [m]", 1.0)
    motions = [data[f"{kind}position"] for kind in ("", "desired_")]
    base = [motion.sel(position_name=list(BASE_POSITION)) for motion in motions]
    arm = [motion.sel(position_name=joint_names) for motion in motions]
    attitude = [data["base_rpy"], data["desired_base_rpy"]]
    panels = (
        ("(b) Base attitude", "angle [deg]", degrees, attitude, ("roll", "pitch", "yaw")),
        ("(c) Base position", "position [m]", 1.0, base, ("x", "y", "z")),
        ("(d) Joints", *travel, arm, tuple(joint_names)),
    )
    for number, (title, label, factor, motion, names) in enumerate(panels, start=2):
        axes = figure.add_subplot(2, 2, number)
        actual, reference = (factor * part.values for part in motion)
        for k, name in enumerate(names):
            axes.plot(
                data["time"],
                actual[:, k],
                color=SERIES[k % len(SERIES)],
                linewidth=2,
                label=plain(name),
            )
            axes.plot(data["time"], reference[:, k], color="black", linestyle="--", linewidth=1)
        axes.set(xlabel="time [s]", ylabel=label, title=title)
        axes.legend(fontsize=8)
        tidy(axes)
    return figure


def plot_errors(records: Sequence[RunRecord]) -> Figure:
    """Tracking error of every coordinate, runs overlaid (the paper's Figure 4).

    Two panels each: the error itself, and below it its rms over one second on a logarithmic axis,
    which separates controllers whose errors differ by orders of magnitude or overlap in noise.
    """
    errors = [record.dataset["error"].values for record in records]
    units = {unit: f"error [{unit}]" for unit in EFFORT_UNITS}
    return _plot_coordinates(records, errors, errors, "Tracking errors", units)


def plot_efforts(records: Sequence[RunRecord]) -> Figure:
    """Control force or torque of every coordinate, runs overlaid (the paper's Figure 5).

    Two panels each: the force itself, the roughest run behind the others, and below it the rms over
    one second of its change from one control sample to the next, on a logarithmic axis: noise and
    chattering without the motion.
    """
    efforts = [record.dataset["generalized_force"].values for record in records]
    # Without the first steps, in which the loop builds up the force from zero.
    steps = [np.diff(effort, axis=0)[_STARTING_STEPS:] for effort in efforts]
    labels = {"rad": "torque [N m]", "m": "force [N]"}
    return _plot_coordinates(
        records, efforts, steps, "Control forces and torques", labels, lower_label="rms step"
    )


def plot_gains(records: Sequence[RunRecord]) -> Figure | None:
    """K_s and G of every coordinate over time, a column per adaptive run; None if there is none."""
    kinds = {"reaching_gain": "$K_s$ [1/s]", "switching_gain": "$G$ [rad/s$^2$, m/s$^2$]"}
    adaptive = [record for record in records if any(kind in record.dataset for kind in kinds)]
    if not adaptive:
        return None
    figure = _figure(records[0], "Adaptive gains", (max(6.5, 4.6 * len(adaptive)), 6.5))
    panels = np.atleast_2d(figure.subplots(2, len(adaptive), squeeze=False, sharex=True))
    handles: list[Line2D] = []
    dashes = dict(zip(GROUP_TITLES, ("-", "--", ":"), strict=True))
    for column, record in enumerate(adaptive):
        for axes, (kind, label) in zip(panels[:, column], kinds.items(), strict=True):
            if kind not in record.dataset:
                axes.text(
                    0.5,
                    0.5,
                    "constant or absent",
                    ha="center",
                    va="center",
                    transform=axes.transAxes,
                )
                axes.set_axis_off()
                continue
            series = record.dataset[kind]
            handles = []
            for k, (name, group) in enumerate(
                zip(series["coordinate"].values, series["group"].values, strict=True)
            ):
                look = {
                    "color": SERIES[k % len(SERIES)],
                    "linestyle": dashes[str(group)],
                    "linewidth": 1.4,
                }
                handles += axes.plot(
                    record.dataset["time"], series.values[:, k], label=plain(name), **look
                )
            axes.set(ylabel=label)
            if axes is panels[0, column]:
                axes.set_title(plain(labels_of(adaptive)[column]))
            tidy(axes)
        panels[-1, column].set_xlabel("time [s]")
    figure.legend(handles=handles, loc="outside right upper", fontsize=8)
    return figure


def _plot_coordinates(
    records: Sequence[RunRecord],
    upper: Sequence[np.ndarray],
    lower: Sequence[np.ndarray],
    title: str,
    units: dict[str, str],
    *,
    lower_label: str = "rms",
) -> Figure:
    """For each coordinate, the runs' upper values (n, nv), and below them the rms of lower ones.

    Lower values may have fewer rows: those of the last samples.
    """
    coordinates, kinds = (
        records[0].dataset[name].values.astype(str) for name in ("coordinate", "unit")
    )
    upper, lower = (
        [np.where(np.abs(one) < LARGEST, one, np.nan) for one in part] for part in (upper, lower)
    )
    magnitudes = [
        moving_rms(values, record.scenario.sample_time)
        for record, values in zip(records, lower, strict=True)
    ]
    styles = styles_of([record.scenario.controller for record in records])
    labels = [
        plain(label)
        if record.outcome.completed
        else f"{plain(label)}, {record.outcome.status} at {record.outcome.time:.1f} s"
        for record, label in zip(records, labels_of(records), strict=True)
    ]
    # Largest first, so that none covers a smaller one.
    order = np.argsort([-float(np.median(magnitude)) for magnitude in magnitudes], kind="stable")
    columns = 3
    rows = -(-(len(coordinates) + 1) // columns)
    height = 3.1 * rows + 1.1
    figure = _figure(records[0], title, (12.0, height), layout=None)
    grid = figure.add_gridspec(
        rows,
        columns,
        left=0.075,
        right=0.985,
        bottom=0.55 / height,
        top=1.0 - 1.05 / height,
        wspace=0.3,
        hspace=0.3,
    )
    for k, name in enumerate(coordinates):
        cell = grid[k // columns, k % columns].subgridspec(2, 1, height_ratios=(3, 2), hspace=0.12)
        upper_axes = figure.add_subplot(cell[0])
        lower_axes = figure.add_subplot(cell[1], sharex=upper_axes)
        for i in order:
            time, magnitude = records[i].dataset["time"].values, magnitudes[i]
            # Dashes would not show in the noise. Rasterized: as vectors this would be megabytes.
            upper_axes.plot(
                time,
                upper[i][:, k],
                drawstyle="steps-post",
                color=styles[i].color,
                linewidth=0.7,
                rasterized=True,
            )
            later = time[len(time) - len(lower[i]) :][: len(magnitude)]
            lower_axes.plot(
                later, magnitude[:, k], linewidth=1.3, label=labels[i], **styles[i].matplotlib
            )
        completed = [record.outcome.completed for record in records]
        if (
            shown := completed_range(
                [(done, v[:, k]) for done, v in zip(completed, upper, strict=True)]
            )
        ) is not None:
            upper_axes.set_ylim(*shown)
        upper_axes.set_title(
            f"({chr(ord('a') + k)}) {plain(name.replace('_', ' '))}", fontsize=10, loc="left"
        )
        upper_axes.set_ylabel(units[kinds[k]], fontsize=8)
        upper_axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
        upper_axes.yaxis.get_offset_text().set_fontsize(8)
        upper_axes.tick_params(labelsize=8, labelbottom=False)
        lower_axes.set_ylabel(lower_label, fontsize=8)
        lower_axes.tick_params(labelsize=8)
        set_log_scale(lower_axes)
        if k + columns >= len(coordinates):
            lower_axes.set_xlabel("time [s]", fontsize=8)
        for axes in (upper_axes, lower_axes):
            axes.xaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10]))
            tidy(axes)
    drawn = dict(zip(order.tolist(), lower_axes.lines, strict=True))
    empty = figure.add_subplot(grid[len(coordinates) // columns, len(coordinates) % columns])
    empty.set_axis_off()
    handles = [drawn[i] for i in range(len(records))]
    empty.legend(handles=handles, loc="center", fontsize=10, handlelength=3.2, frameon=False)
    return figure


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
