"""Figure of a gain design: accuracy against effort."""

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.control_design.gains import Design
from ffsm_drake.show.figures.axes import plain, tidy
from ffsm_drake.show.style import BLUE, GREEN, GREY, GROUP_TITLES, VERMILION, label_of


def plot_design(found: Design) -> Figure:
    """Front of accuracy against effort, with the LQG limit and the given and default gains."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    scenario = found.chosen.scenario
    figure.suptitle(
        f"Predicted accuracy against effort: {plain(label_of(scenario.controller))}, "
        f"{plain(scenario.description)}",
        fontsize=11,
    )
    names, coordinates = (
        list(found.chosen.prediction.by_group()),
        found.chosen.prediction.coordinates,
    )
    panels = figure.subplots(1, len(names), squeeze=False)[0]
    points = [
        ("chosen", found.chosen.prediction, "*", VERMILION),
        ("as it was", found.given.prediction, "s", GREEN),
        ("default gains and estimator", found.with_defaults, "X", GREY),
    ]
    for axes, name in zip(panels, names, strict=True):
        least = np.sqrt(np.mean(found.limit.front_error[:, coordinates.groups[name]] ** 2, axis=1))
        axes.loglog(
            found.limit.front_excess, least, "-", color="black", label="least possible (LQG)"
        )
        if found.front:
            extra = [point.isv - found.ideal_isv for point in found.front]
            axes.loglog(
                extra,
                [point.rms_error[name] for point in found.front],
                "o-",
                color=BLUE,
                label="front",
            )
        for label, prediction, marker, color in points:
            if prediction is not None and np.isfinite(prediction.isv):
                axes.loglog(
                    max(prediction.isv - found.ideal_isv, 1e-3),
                    prediction.by_group()[name],
                    marker,
                    color=color,
                    markersize=13 if marker == "*" else 8,
                    linestyle="none",
                    label=label,
                )
        axes.axvline(
            max(found.requirement.budget - found.ideal_isv, 1e-3),
            color="black",
            linestyle="--",
            linewidth=0.8,
        )
        axes.set(title=GROUP_TITLES[name], xlabel="ISV above perfect tracking")
        tidy(axes)
        axes.margins(0.08)
    panels[0].set_ylabel("rms error after 5 s [rad or m]")
    figure.legend(
        *panels[-1].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=4,
        frameon=False,
        fontsize=9,
    )
    return figure
