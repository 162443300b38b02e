"""Figure of a gain design: accuracy against effort."""

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.plugins.design.gains import Design
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.figures.axes import plot_charts
from ffsm_drake.show.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    GROUP_TITLES,
    VERMILION,
    Style,
    label_of,
)

_LEAST = 1e-3  # least effort beyond perfect tracking in the drawing


def plot_design(found: Design) -> Figure:
    """Front of accuracy against effort, with the LQG limit and the given and default gains."""
    scenario = found.chosen.scenario
    charts = [_chart(found, name) for name in found.chosen.prediction.by_group()]
    return plot_charts(
        [[chart] for chart in charts],
        f"Predicted accuracy against effort: {label_of(scenario.controller)}",
        scenario.description, columns=len(charts), size=(11.0, 4.6), below=True,
    )  # fmt: skip


def _chart(found: Design, group: str) -> Chart:
    part = found.chosen.prediction.groups[group].errors
    least = np.sqrt(np.mean(found.limit.front_error[:, part] ** 2, axis=1))
    curves = [Curve(found.limit.front_excess, least, Style(BLACK), "least possible (LQG)")]
    if found.front:
        x, y = np.transpose(
            [(point.isv - found.ideal_isv, point.rms_error[group]) for point in found.front]
        )
        curves.append(Curve(x, y, Style(BLUE), "front", marker="circle", size=8.0))
    for label, prediction, marker, color in (
        ("chosen", found.chosen.prediction, "star", VERMILION),
        ("given", found.given.prediction, "square", GREEN),
        ("default gains and estimator", found.with_defaults, "x-thick", GREY),
    ):
        if prediction is not None and np.isfinite(prediction.isv):
            x = np.array([max(prediction.isv - found.ideal_isv, _LEAST)])
            y, size = np.array([prediction.by_group()[group]]), 17.0 if marker == "star" else 10.0
            point = Curve(x, y, Style(color), label, marker=marker, size=size)
            curves.append(point)
    budget = max(found.requirement.budget - found.ideal_isv, _LEAST)
    return Chart(
        title=GROUP_TITLES.get(group, group.replace("_", " ").capitalize()),
        x="ISV above perfect tracking", curves=curves,
        y="rms error after 5 s [rad or m]", margin=0.08,
        levels=[Level(budget, axis="x", style=Style(BLACK, "dash"))],
        log_x="~e", log_y="~e",
    )  # fmt: skip
