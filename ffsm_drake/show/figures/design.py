"""The picture of a gain design: accuracy against effort."""

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.control_design.gains import Design
from ffsm_drake.show.figures.axes import tidy
from ffsm_drake.show.style import BLUE, GREEN, GREY, GROUP_TITLES, VERMILION, label_of


def plot_design(found: Design) -> Figure:
    """The front of accuracy against effort, with the scenario's own gains and the published ones on it."""
    figure = Figure(figsize=(11.0, 4.6), layout="constrained")
    scenario = found.chosen.scenario
    figure.suptitle(
        f"Predicted accuracy against effort: {label_of(scenario.controller)}, {scenario.description}", fontsize=11
    )
    panels = figure.subplots(1, len(found.chosen.groups), squeeze=False)[0]
    for axes, name in zip(panels, found.chosen.groups, strict=True):
        extra = [point.prediction.isv - found.ideal_isv for point in found.front]
        errors = [point.prediction.by_group()[name] for point in found.front]
        axes.loglog(extra, errors, "o-", color=BLUE, label="front")
        for label, prediction, marker, color in (
            ("chosen", found.chosen.prediction, "*", VERMILION),
            ("scenario as it was", found.reference, "s", GREEN),
            ("published gains and estimate", found.published, "X", GREY),
        ):
            if np.isfinite(prediction.isv):
                axes.loglog(
                    max(prediction.isv - found.ideal_isv, 1e-3), prediction.by_group()[name], marker, color=color,
                    markersize=13 if marker == "*" else 8, linestyle="none", label=label,
                )  # fmt: skip
        axes.axvline(max(found.budget - found.ideal_isv, 1e-3), color="black", linestyle="--", linewidth=0.8)
        axes.set(title=GROUP_TITLES[name], xlabel="ISV above perfect tracking")
        tidy(axes)
        axes.margins(0.08)
    panels[0].set_ylabel("rms error after 5 s [rad or m]")
    figure.legend(
        *panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False, fontsize=9
    )
    return figure
