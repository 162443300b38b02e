"""Figure of a scenario's sampled-loop margins: stability map, and its inputs along the motion."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.plugins.design.charts import (
    eta_chart,
    forecast_chart,
    map_chart,
    radii_of,
    radius_chart,
    weakest,
)
from ffsm_drake.plugins.design.stability.margins import AxisMargins, Margins
from ffsm_drake.plugins.design.stability.one_axis import axis_loop, of_axes, with_sample_time
from ffsm_drake.show.chart import Chart, Curve
from ffsm_drake.show.figures.axes import draw, plain
from ffsm_drake.show.style import BLACK, BLUE, UNSTABLE, VERMILION, Style, label_of

_TIME = "time along the planned motion [s]"


def plot_margins(margins: Margins) -> Figure:
    """The stability map with operating point and expected path, and its inputs along the motion."""
    axes = margins.axes
    rows = 1 if axes is None else 2
    figure = Figure(figsize=(12.0, 0.5 + 4.0 * rows), layout="constrained")
    scenario = margins.scenario
    figure.suptitle(
        plain(f"Sampled-loop stability: {label_of(scenario.controller)}, {scenario.description}")
        + f"\n{margins.verdict}",
        fontsize=11,
    )
    panels = figure.subplots(rows, 2).ravel()
    if axes is None:
        draw(panels[0], _poles(margins))
        panels[0].set_aspect("equal")
    else:
        _draw_map(figure, panels[0], margins, axes)
        title = "Expected adaptation of Kₛ"
        if axes.has_k_s:
            draw(panels[1], forecast_chart(margins, axes, title), what="Kₛ")
        else:
            panels[1].text(0.5, 0.5, "this law has no Kₛ", ha="center", va="center")
            panels[1].set(title=title, xticks=[], yticks=[])
        _draw_eta(panels[2], margins, axes)
    curves = [
        Curve(x, y, name=name, style=style, width=2.0, marker="circle", size=6.0)
        for (name, (x, y)), style in zip(
            radii_of(margins).items(), (Style(VERMILION), Style(BLUE, "dash")), strict=False
        )
    ]
    draw(
        panels[-1], radius_chart(curves, "The wired loop of all coordinates"),
        what="spectral radius",
    )  # fmt: skip
    panels[-1].set_xlabel(_TIME)
    panels[-1].legend(fontsize=8)
    for letter, each in zip("abcd", panels, strict=False):
        each.set_title(f"({letter}) {each.get_title()}")
    return figure


def _draw_map(figure: Figure, axes: Axes, margins: Margins, limits: AxisMargins) -> None:
    chart = map_chart(margins, limits, Style(BLACK))
    draw(axes, chart)
    ends, (_, top) = chart.curves[0].x, axes.get_ylim()
    eta = np.linspace(ends[0], ends[-1], 90)
    vertical = np.linspace(top / 200, top, 90)
    law, each = of_axes(limits.law, [weakest(limits)]), vertical[:, None, None]
    law = law.with_reaching_gain(each) if limits.has_k_s else with_sample_time(law, 1e-3 * each)
    poles = axis_loop(law, eta=eta[:, None], euler=limits.euler).poles[..., 0, :]
    largest, ringing = np.abs(poles).max(axis=-1), -poles.real.min(axis=-1)
    # poles at zero are found only to about 0.01
    shades = axes.contourf(
        eta, vertical, ringing, levels=[-1.0, 0.05, 0.25, 0.5, 0.75, 1.0], cmap="Blues", alpha=0.75
    )
    axes.contourf(eta, vertical, largest, levels=[1.0, np.inf], colors=[UNSTABLE])
    figure.colorbar(shades, ax=axes, label="ringing: minus the most negative pole")
    axes.text(0.97, 0.93, "unstable", fontsize=10, ha="right", transform=axes.transAxes)


def _draw_eta(axes: Axes, margins: Margins, limits: AxisMargins) -> None:
    draw(axes, eta_chart(margins, "Eigenvalues of H⁻¹Ĥ"), what="η")
    low, high = limits.eta_tolerated[:, 0].max(), limits.eta_tolerated[:, 1].min()
    label = "no η is tolerated by every coordinate after adaptation"
    if low < high:
        label = f"tolerated after adaptation: {low:.2f} to {high:.2f}"
    else:
        low = high = 1.0
    band = axes.axhspan(low, high, color=BLUE, alpha=0.12, label=label)
    axes.set_xlabel(_TIME)
    axes.legend(handles=[band], fontsize=8, loc="lower left")


def _poles(margins: Margins) -> Chart:
    """The poles of the worst posture, and the unit circle."""
    poles, circle = margins.worst.poles, np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 361))
    stable = np.abs(poles) < 1.0
    shown = {BLUE: poles[stable], VERMILION: poles[~stable]}
    return Chart(
        title=f"Poles at t = {margins.worst.time:g} s", x="real part of z", y="imaginary part",
        curves=[
            Curve(circle.real, circle.imag, Style(BLACK), width=1.0),
            *(
                Curve(part.real, part.imag, Style(color), line=False, marker="x")
                for color, part in shown.items()
            ),
        ],
    )  # fmt: skip
