"""Figure of a scenario's sampled-loop margins: stability map, and its inputs along the motion."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.control_design.stability.margins import AxisMargins, Margins
from ffsm_drake.control_design.stability.one_axis import axis_loop, of_axes, with_sample_time
from ffsm_drake.show.figures.axes import plain, tidy
from ffsm_drake.show.style import (
    BLUE,
    GREY,
    GROUP_STYLES,
    GROUP_TITLES,
    UNSTABLE,
    VERMILION,
    label_of,
)

# seven distinguishable joints
_DASHES = ("-", "--", ":", "-.", (0, (1, 1)), (0, (6, 2, 1, 2, 1, 2)), (0, (9, 3)))


def plot_margins(margins: Margins) -> Figure:
    """The stability map with operating point and expected path, and its inputs along the motion."""
    rows = 1 if margins.axes is None else 2
    figure = Figure(figsize=(12.0, 0.5 + 4.0 * rows), layout="constrained")
    figure.suptitle(
        plain(
            f"Sampled-loop stability: {label_of(margins.scenario.controller)}, "
            f"{margins.scenario.description}\n"
        )
        + margins.verdict,
        fontsize=11,
    )
    panels = figure.subplots(rows, 2).ravel()
    if margins.axes is None:
        _draw_poles(panels[0], margins)
    else:
        _draw_map(figure, panels[0], margins, margins.axes)
        _draw_forecast(panels[1], margins, margins.axes)
        _draw_eta(panels[2], margins, margins.axes)
    _draw_radius(panels[-1], margins)
    for letter, axes in zip("abcd", panels, strict=False):
        axes.set_title(f"({letter}) {axes.get_title()}")
        tidy(axes)
    return figure


def _draw_map(figure: Figure, axes: Axes, margins: Margins, limits: AxisMargins) -> None:
    adapts, eta = limits.has_k_s, np.linspace(0.2, 1.4, 90)
    top = float(
        1.35 * max(np.nanmax(limits.k_s_limit), limits.k_s.max())
        if adapts
        else 1500.0 * limits.sample_time_limit.max()
    )
    vertical = np.linspace(top / 200, top, 90)
    law, each = of_axes(limits.law, [0]), vertical[:, None, None]
    law = law.with_reaching_gain(each) if adapts else with_sample_time(law, 1e-3 * each)
    poles = axis_loop(law, eta=eta[:, None], euler=limits.euler).poles[..., 0, :]
    largest, ringing = np.abs(poles).max(axis=-1), -poles.real.min(axis=-1)
    shades = axes.contourf(
        eta, vertical, ringing, levels=[-1.0, 0.0, 0.25, 0.5, 0.75, 1.0], cmap="Blues", alpha=0.75
    )
    axes.contourf(eta, vertical, largest, levels=[1.0, np.inf], colors=[UNSTABLE])
    axes.contour(eta, vertical, largest, levels=[1.0], colors="black", linewidths=2)
    figure.colorbar(shades, ax=axes, label="ringing: minus the most negative pole")
    axes.axvspan(
        margins.eta.min(),
        margins.eta.max(),
        color=GREY,
        alpha=0.35,
        label="$\\eta$ along the motion",
    )
    axes.text(1.22, 0.93 * top, "unstable", fontsize=10)
    if not adapts:
        axes.plot(
            margins.eta.max(),
            1e3 * margins.scenario.sample_time,
            "o",
            color="black",
            label="sample time in use",
        )
        axes.set(ylabel="sample time L [ms]", title="Stability map")
    else:
        for k, (group, part) in enumerate(margins.coordinates.groups.items()):
            if part.start >= limits.k_s.size:
                continue
            path, color = limits.forecast_k_s[:, part], GROUP_STYLES[group].color
            extreme = path[:, np.argmax(path.max(axis=0))]
            x = margins.eta.max() - 0.02 * k
            axes.plot(x, extreme[0], "o", color=color, markersize=6)
            arrow = {"arrowstyle": "->", "color": color, "linewidth": 2}
            axes.annotate(
                "", xy=(x, min(extreme[-1], 0.99 * top)), xytext=(x, extreme[0]), arrowprops=arrow
            )
            axes.plot(
                [], [], "-o", color=color, label=f"{GROUP_TITLES[group]}: start, expected path"
            )
        axes.set(
            ylabel="$K_s$ [1/s]", title=f"Stability map of {plain(margins.coordinates.names[0])}"
        )
    axes.set(
        xlabel="$\\eta$ (above 1: inertia over-estimated)", ylim=(0, top), xlim=(eta[0], eta[-1])
    )
    axes.legend(loc="lower left", fontsize=8)


def _draw_forecast(axes: Axes, margins: Margins, limits: AxisMargins) -> None:
    axes.set(
        xlabel="time [s]", ylabel="$K_s$ [1/s]", title="Where adaptation is expected to take $K_s$"
    )
    if not limits.has_k_s:
        axes.text(
            0.5, 0.5, "this law has no $K_s$", ha="center", va="center", transform=axes.transAxes
        )
        return
    for group, part in margins.coordinates.groups.items():
        for i in range(*part.indices(limits.k_s.size)):
            axes.plot(
                limits.forecast_times,
                limits.forecast_k_s[:, i],
                color=GROUP_STYLES[group].color,
                linewidth=1.3,
                linestyle=_DASHES[(i - part.start) % len(_DASHES)],
                label=GROUP_TITLES[group] if i == part.start else None,
            )
    limit = np.nanmin(limits.k_s_limit)
    axes.axhline(limit, color="black", linewidth=2)
    axes.text(0.01, limit, " limit", va="bottom", transform=axes.get_yaxis_transform())
    bound = limits.k_s_max
    if np.isfinite(bound).all() and (bound > limits.k_s).any():
        axes.axhline(bound.max(), color=GREY, linestyle="--")
        axes.text(
            0.99,
            bound.max(),
            "k_s_max",
            va="bottom",
            ha="right",
            transform=axes.get_yaxis_transform(),
        )
    axes.legend(fontsize=8)


def _draw_eta(axes: Axes, margins: Margins, limits: AxisMargins) -> None:
    axes.plot(margins.times, margins.eta, color=BLUE, linewidth=1.2)
    axes.axhline(1.0, color="black", linewidth=0.8)
    low, high = limits.eta_tolerated[:, 0].max(), limits.eta_tolerated[:, 1].min()
    axes.axhspan(
        low,
        high,
        color=BLUE,
        alpha=0.12,
        label=f"tolerated at the starting gains: {low:.2f} to {high:.2f}",
    )
    axes.set(
        xlabel="time along the planned motion [s]",
        ylabel="$\\eta$",
        title="Eigenvalues of $H^{-1}\\hat{H}$",
    )
    axes.legend(fontsize=8, loc="lower left")


def _draw_poles(axes: Axes, margins: Margins) -> None:
    poles = margins.worst.poles
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 361))
    axes.plot(circle.real, circle.imag, color="black", linewidth=1)
    stable = np.abs(poles) < 1.0
    for part, color in ((stable, BLUE), (~stable, VERMILION)):
        axes.plot(poles[part].real, poles[part].imag, "x", color=color)
    axes.set(xlabel="real part of z", ylabel="imaginary part", aspect="equal")
    axes.set_title(f"Poles at t = {margins.worst.time:g} s")


def _draw_radius(axes: Axes, margins: Margins) -> None:
    curves = {"starting gains": (margins.loops, VERMILION, "-")}
    if margins.loops_expected is not margins.loops:
        curves["largest expected $K_s$"] = (margins.loops_expected, BLUE, "--")
    for name, (loops, color, dash) in curves.items():
        times, radii = [loop.time for loop in loops], [loop.spectral_radius for loop in loops]
        axes.plot(
            times, radii, "o", linestyle=dash, color=color, linewidth=2, markersize=4, label=name
        )
    axes.axhline(1.0, color="black", linewidth=2)
    axes.set(xlabel="time along the planned motion [s]", ylabel="spectral radius")
    axes.set_title("The loop of all coordinates as it is wired")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(fontsize=8)
