"""Figure of a scenario's sampled-loop margins: stability map, and its inputs along the motion."""

import dataclasses

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
from ffsm_drake.show.chart import Band, Chart, Curve
from ffsm_drake.show.figures.axes import plot_charts
from ffsm_drake.show.style import BLACK, BLUE, UNSTABLE, VERMILION, Style, label_of

_TIME = "time along the planned motion [s]"


def plot_margins(margins: Margins) -> Figure:
    """The stability map with operating point and expected path, and its inputs along the motion."""
    axes, scenario = margins.axes, margins.scenario
    curves = [
        Curve(x, y, name=name, style=style, width=2.0, marker="circle", size=6.0)
        for (name, (x, y)), style in zip(
            radii_of(margins).items(), (Style(VERMILION), Style(BLUE, "dash")), strict=False
        )
    ]
    radius = radius_chart(curves, "The wired loop of all coordinates")
    radius = dataclasses.replace(radius, what="spectral radius", x=_TIME, legend="inside")
    charts = [_poles(margins), radius]
    if axes is not None:
        title = "Expected adaptation of Kₛ"
        forecast = Chart(title=title, curves=[], note="this law has no Kₛ")
        if axes.has_k_s:
            forecast = dataclasses.replace(forecast_chart(margins, axes, title), what="Kₛ")
        charts = [map_chart(margins, axes, Style(BLACK)), forecast, _eta(margins, axes), radius]
    figure = plot_charts(
        [[chart] for chart in charts],
        f"Sampled-loop stability: {label_of(scenario.controller)}: {margins.verdict}",
        scenario.description, columns=2, size=(12.0, 0.5 + 2.0 * len(charts)),
    )  # fmt: skip
    if axes is None:
        figure.axes[0].set_aspect("equal")
    else:
        _shade_map(figure.axes[0], charts[0].curves[0].x, axes)
    return figure


def _shade_map(axes: Axes, ends: np.ndarray, limits: AxisMargins) -> None:
    """Shade the map by the poles of the weakest coordinate."""
    eta = np.linspace(ends[0], ends[-1], 90)
    top = axes.get_ylim()[1]
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
    axes.figure.colorbar(shades, ax=axes, label="ringing: minus the most negative pole")
    axes.text(0.97, 0.93, "unstable", fontsize=10, ha="right", transform=axes.transAxes)


def _eta(margins: Margins, limits: AxisMargins) -> Chart:
    """The eigenvalues of H^-1 Hhat, and those that every coordinate tolerates."""
    chart = eta_chart(margins, "Eigenvalues of H⁻¹Ĥ")
    low, high = limits.eta_tolerated[:, 0].max(), limits.eta_tolerated[:, 1].min()
    name = "no η is tolerated by every coordinate after adaptation"
    if low < high:
        name = f"tolerated after adaptation: {low:.2f} to {high:.2f}"
    else:
        low = high = 1.0
    band = Band(np.array([[low, high]]), BLUE, opacity=0.12, name=name, axis="y")
    curves = [dataclasses.replace(curve, name="") for curve in chart.curves]
    return dataclasses.replace(
        chart, curves=curves, bands=[band], what="η", x=_TIME, legend="inside"
    )


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
