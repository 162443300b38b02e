"""Figure of a plan: forces and rates with their limits."""

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.plugins.planning.planned_report import PlannedMotionReport
from ffsm_drake.scenario import Scenario
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.figures.axes import plot_charts
from ffsm_drake.show.style import GREY, GROUP_TITLES, SERIES, Style

_UNITS = {
    "base_rotation": ("N m", "rad/s"),
    "base_position": ("N", "m/s"),
    "joints": ("N m or N", "rad/s or m/s"),
}


def plot_plan(found: PlannedMotionReport, scenario: Scenario) -> Figure:
    """Forces (above) and rates (below) by group, with their limits and the end of the plan."""
    least = (
        f", at least {found.least_by_torque:.2f} s by base torque alone"
        if found.least_by_torque > 0.0
        else ""
    )
    names = found.plan.coordinates
    first = found.rows.shape[1] - 2 * len(names)
    rates = found.rows[:, first : first + len(names)]
    parts = (slice(0, 3), slice(3, 6), slice(6, len(names)))
    stacks = []
    for (group, units), part in zip(_UNITS.items(), parts, strict=True):
        labels = [name if group == "joints" else name[-1] for name in names[part]]
        stack = []
        for what, unit, values, limits in (
            ("force", units[0], found.force, found.limits.force),
            ("rate", units[1], rates, found.limits.rate),
        ):
            curves = [
                Curve(found.times, curve, Style(color), label)
                for label, color, curve in zip(labels, SERIES * 3, values[:, part].T, strict=False)
            ]
            largest = np.unique(limits[part][np.isfinite(limits[part])])
            levels = [Level(each, style=Style(GREY, "dash")) for each in (*-largest, *largest)]
            levels.append(Level(found.plan.duration, axis="x", style=Style(GREY, "dot")))
            stack.append(
                Chart(
                    title=GROUP_TITLES[group], what=what, y=unit, curves=curves, levels=levels,
                    legend="inside" if what == "rate" else "",
                )
            )  # fmt: skip
        stacks.append(stack)
    title = f"{found.plan.duration:.3f} s to rest{least}"
    return plot_charts(
        stacks, title, scenario.description, columns=3, size=(12.0, 6.4), heights=(1.0, 1.0)
    )
