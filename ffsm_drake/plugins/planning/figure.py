"""Figure of a plan: forces and rates with their limits."""

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.plugins.planning.planner import PlannedMotionReport
from ffsm_drake.scenario import Scenario
from ffsm_drake.show.figures.axes import plain, tidy
from ffsm_drake.show.style import GREY, GROUP_TITLES, NEUTRAL, SERIES

_UNITS = {
    "base_rotation": ("N m", "rad/s"),
    "base_position": ("N", "m/s"),
    "joints": ("N m or N", "rad/s or m/s"),
}


def plot_plan(found: PlannedMotionReport, scenario: Scenario) -> Figure:
    """Forces (above) and rates (below) by group, with their limits and the end of the plan."""
    figure = Figure(figsize=(12.0, 6.4), layout="constrained")
    least = (
        f", at least {found.least_by_torque:.2f} s by base torque alone"
        if found.least_by_torque > 0.0
        else ""
    )
    figure.suptitle(
        f"{plain(scenario.description)}: {found.plan.duration:.3f} s to rest{least}", fontsize=11
    )
    names = found.plan.coordinates
    num_positions = found.rows.shape[1] - 2 * len(names)
    rates = found.rows[:, num_positions : num_positions + len(names)]
    groups = {
        "base_rotation": slice(0, 3),
        "base_position": slice(3, 6),
        "joints": slice(6, len(names)),
    }
    panels = figure.subplots(2, 3, sharex=True)
    for column, (group, part) in enumerate(groups.items()):
        for axes, values, limits, unit, what in (
            (panels[0, column], found.force, found.limits.force, _UNITS[group][0], "force"),
            (panels[1, column], rates, found.limits.rate, _UNITS[group][1], "rate"),
        ):
            for name, color, curve in zip(names[part], SERIES * 3, values[:, part].T, strict=False):
                label = plain(name) if group == "joints" else name[-1]
                axes.plot(found.times, curve, color=color, linewidth=1.3, label=label)
            for limit in np.unique(limits[part][np.isfinite(limits[part])]):
                for side in (-limit, limit):
                    axes.axhline(side, color=GREY, linestyle="--", linewidth=0.9)
            axes.axvline(found.plan.duration, color=NEUTRAL, linestyle=":", linewidth=0.9)
            axes.set_ylabel(f"{what} [{unit}]")
            tidy(axes)
        panels[0, column].set_title(GROUP_TITLES[group])
        panels[1, column].legend(fontsize=8)
        panels[1, column].set_xlabel("time [s]")
    return figure
