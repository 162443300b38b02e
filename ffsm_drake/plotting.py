"""Matplotlib figures of one run, or of several runs overlaid. Each function returns a Figure; nothing is shown."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.files import written_whole
from ffsm_drake.record import RunRecord

# Okabe and Ito's palette: told apart by the colour-blind, and with the dash patterns also in grey print.
STYLES = {
    "tde_aismc": {"color": "#D55E00", "linestyle": "-"},
    "aismc": {"color": "#0072B2", "linestyle": "--"},
    "asmc": {"color": "#009E73", "linestyle": "-."},
    "tdc": {"color": "#7A7A7A", "linestyle": ":"},
}
LABELS = {"tde_aismc": "TDE-AISMC (proposed)", "aismc": "AISMC", "asmc": "ASMC", "tdc": "TDC"}
_COORDINATE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_GROUP_TITLES = {"base_rotation": "Base attitude", "base_position": "Base position", "joints": "Joints"}
# Drawn in this order, so that the smallest error lies on top.
_DRAWING_ORDER = ("tdc", "asmc", "aismc", "tde_aismc")


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
    """The paper's Figure 3: end effector in task space, base attitude, base position, joints; reference dashed."""
    data = record.dataset
    figure = _figure(record, "Planned and tracked trajectories", (11.0, 8.0))
    space = figure.add_subplot(2, 2, 1, projection="3d")
    path, desired = data["end_effector_position"].values, data["desired_end_effector_position"].values
    space.plot(*path.T, color=_COORDINATE_COLORS[1], linewidth=2, label="end effector")
    space.plot(*desired.T, color="black", linestyle="--", linewidth=1, label="reference")
    space.scatter(*path[0], color="black", marker="o", s=25, label="start")
    space.scatter(*path[-1], color="black", marker="*", s=60, label="end")
    space.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", title="(a) End effector in task space")
    space.locator_params(nbins=4)
    space.tick_params(labelsize=8)
    space.view_init(elev=22.0, azim=-125.0)
    space.set_box_aspect(None, zoom=0.92)
    space.legend(fontsize=8, loc="upper right")

    joints = data["group"].values == "joints"
    joint_names = data["coordinate"].values[joints]
    joint_units = data["unit"].values[joints]
    revolute = all(unit == "rad" for unit in joint_units)
    panels = (
        ("(b) Base attitude", "angle [deg]", np.rad2deg(1.0), data["base_rpy"], data["desired_base_rpy"],
         ("roll", "pitch", "yaw")),
        ("(c) Base position", "position [m]", 1.0, data["position"].sel(position_name=_base_position_names()),
         data["desired_position"].sel(position_name=_base_position_names()), ("x", "y", "z")),
        ("(d) Joints", "angle [deg]" if revolute else "angle [rad], travel [m]", np.rad2deg(1.0) if revolute else 1.0,
         data["position"].sel(position_name=joint_names), data["desired_position"].sel(position_name=joint_names),
         tuple(joint_names)),
    )  # fmt: skip
    for number, (title, label, factor, actual, reference, names) in enumerate(panels, start=2):
        axes = figure.add_subplot(2, 2, number)
        for k, name in enumerate(names):
            color = _COORDINATE_COLORS[k % len(_COORDINATE_COLORS)]
            axes.plot(data["time"], factor * actual.values[:, k], color=color, linewidth=2, label=name)
            axes.plot(data["time"], factor * reference.values[:, k], color="black", linestyle="--", linewidth=1)
        axes.set(xlabel="time [s]", ylabel=label, title=title)
        axes.legend(fontsize=8)
        _tidy(axes)
    return figure


def plot_errors(records: Sequence[RunRecord]) -> Figure:
    """Tracking error of every coordinate, runs overlaid (the paper's Figure 4)."""
    return _plot_coordinates(records, "error", "Tracking errors", {"rad": "error [rad]", "m": "error [m]"})


def plot_efforts(records: Sequence[RunRecord]) -> Figure:
    """Control force or torque of every coordinate, runs overlaid (the paper's Figure 5)."""
    labels = {"rad": "torque [N m]", "m": "force [N]"}
    return _plot_coordinates(records, "generalized_force", "Control forces and torques", labels)


def plot_gains(records: Sequence[RunRecord]) -> Figure | None:
    """K_s and G of every coordinate over time, a column for each run that adapts them; None where none does."""
    kinds = {"reaching_gain": "$K_s$ [1/s]", "switching_gain": "$G$ [rad/s$^2$, m/s$^2$]"}
    adaptive = [record for record in records if any(kind in record.dataset for kind in kinds)]
    if not adaptive:
        return None
    figure = _figure(records[0], "Adaptive gains", (max(6.5, 4.6 * len(adaptive)), 6.5))
    panels = np.atleast_2d(figure.subplots(2, len(adaptive), squeeze=False, sharex=True))
    handles = []
    for column, record in enumerate(adaptive):
        for axes, (kind, label) in zip(panels[:, column], kinds.items(), strict=True):
            if kind not in record.dataset:
                axes.text(0.5, 0.5, "constant or absent", ha="center", va="center", transform=axes.transAxes)
                axes.set_axis_off()
                continue
            series = record.dataset[kind]
            groups = list(_GROUP_TITLES)
            handles = [
                axes.plot(
                    record.dataset["time"], series.values[:, k],
                    color=_COORDINATE_COLORS[k % len(_COORDINATE_COLORS)],
                    linestyle=("-", "--", ":")[groups.index(str(series["group"].values[k]))],
                    linewidth=1.4, label=name,
                )[0]
                for k, name in enumerate(series["coordinate"].values)
            ]  # fmt: skip
            axes.set(ylabel=label)
            if axes is panels[0, column]:
                axes.set_title(_label(record))
            _tidy(axes)
        panels[-1, column].set_xlabel("time [s]")
    figure.legend(handles=handles, loc="outside right upper", fontsize=8)
    return figure


def _plot_coordinates(records: Sequence[RunRecord], variable: str, title: str, labels: dict[str, str]) -> Figure:
    coordinates = records[0].dataset["coordinate"].values
    columns = 3
    rows = -(-(len(coordinates) + 1) // columns)
    figure = _figure(records[0], title, (12.0, 2.1 * rows + 0.8))
    panels = figure.subplots(rows, columns, sharex=True).ravel()
    ordered = sorted(records, key=lambda record: _rank(record.scenario.controller))
    for k, (axes, name) in enumerate(zip(panels, coordinates, strict=False)):
        for record in ordered:
            axes.plot(
                record.dataset["time"], record.dataset[variable].values[:, k],
                drawstyle="steps-post", linewidth=0.9, label=_label(record), **_style(record),
            )  # fmt: skip
        axes.set_title(str(name).replace("_", " "), fontsize=9)
        axes.set_ylabel(labels[str(records[0].dataset["unit"].values[k])], fontsize=8)
        axes.ticklabel_format(axis="y", style="sci", scilimits=(-2, 3), useMathText=True)
        axes.tick_params(labelsize=8, labelbottom=k + columns >= len(coordinates))
        if k + columns >= len(coordinates):
            axes.set_xlabel("time [s]", fontsize=8)
        _tidy(axes)
    for axes in panels[len(coordinates) :]:
        axes.set_axis_off()
    panels[len(coordinates)].legend(*panels[0].get_legend_handles_labels(), loc="center", fontsize=10)
    return figure


def _figure(record: RunRecord, title: str, size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(f"{title}\n", fontsize=13, fontweight="bold")
    description = record.scenario.description
    if not record.outcome.completed:
        description = f"{description}. {record.outcome.message}"
    figure.text(0.5, 0.962, description, ha="center", va="top", fontsize=9, color="#444444")
    return figure


def _tidy(axes: Axes) -> None:
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)


def _base_position_names() -> list[str]:
    return [f"base_position_{axis}" for axis in "xyz"]


def _rank(controller: str) -> int:
    return _DRAWING_ORDER.index(controller) if controller in _DRAWING_ORDER else -1


def _style(record: RunRecord) -> dict[str, str]:
    return STYLES.get(record.scenario.controller, {"color": "#CC79A7", "linestyle": "-"})


def _label(record: RunRecord) -> str:
    return LABELS.get(record.scenario.controller, record.scenario.controller)
