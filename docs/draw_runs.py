"""Draw the figures of the task pages from recorded runs.

python docs/draw_runs.py errors docs/quickstart_errors.webp out/postcapture
python docs/draw_runs.py actuators docs/thrusters_wheels.webp out/mission

``errors`` draws the tracking errors of one run by coordinate, or the largest error of several runs.
``actuators`` draws the forces of thrusters and the torques of wheels.
"""

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.show.figures.axes import STYLE
from ffsm_drake.show.style import SERIES

GROUPS = ("base_rotation", "base_position", "joints")


def draw_errors(panels: list[Axes], runs: dict[str, xr.Dataset]) -> None:
    """One panel per group of coordinates."""
    for axes, group in zip(panels, GROUPS, strict=True):
        for colour, (name, run) in zip(SERIES, runs.items(), strict=False):
            error = run["error"].where(run["group"] == group, drop=True)
            if len(runs) > 1:
                size = np.abs(error).max("coordinate")
                axes.semilogy(run["time"], size, color=colour, linewidth=0.8, label=name)
                continue
            axes.set_prop_cycle(color=SERIES)
            labels = [str(each).rsplit("_", 1)[-1] for each in error["coordinate"].values]
            axes.plot(error["time"], error, linewidth=0.8, label=labels)
        unit = error["unit"].values[0]
        what = "largest |error|" if len(runs) > 1 else "error"
        axes.set(title=group.replace("_", " "), xlabel="time [s]", ylabel=f"{what} [{unit}]")
        axes.legend(fontsize=7)


def draw_actuators(panels: list[Axes], runs: dict[str, xr.Dataset]) -> None:
    """Forces of all thrusters, one above the other, and torques of the wheels."""
    (run,) = runs.values()
    force = run["thruster_force"]
    largest = float(force.max())
    for row, name in enumerate(force["thruster"].values):
        panels[0].plot(
            run["time"], row + 0.8 * force.sel(thruster=name) / largest, color=SERIES[0],
            linewidth=0.6,
        )  # fmt: skip
    panels[0].set_yticks(range(force.sizes["thruster"]), list(force["thruster"].values), fontsize=7)
    panels[0].set(title=f"force of each thruster (full: {largest:.3g} N)", xlabel="time [s]")
    panels[1].set_prop_cycle(color=SERIES)
    panels[1].plot(run["time"], run["wheel_torque"], linewidth=0.6, label=list(run["wheel"].values))
    panels[1].set(title="motor torque of each wheel", xlabel="time [s]", ylabel="torque [N m]")
    panels[1].legend(fontsize=7)


DRAWN = {"errors": (draw_errors, 3), "actuators": (draw_actuators, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("what", choices=DRAWN)
    parser.add_argument("file", type=Path)
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs")
    arguments = parser.parse_args()
    draw, count = DRAWN[arguments.what]
    mpl.rcParams.update(STYLE)
    figure = Figure(figsize=(9.0, 2.6), layout="constrained")
    panels = [figure.add_subplot(1, count, number + 1) for number in range(count)]
    draw(panels, {run.name: xr.load_dataset(run / "record.nc") for run in arguments.runs})
    figure.savefig(arguments.file, dpi=110)


if __name__ == "__main__":
    main()
