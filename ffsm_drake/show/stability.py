"""Margins for the eye: a table and a picture."""

import dataclasses
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ffsm_drake.control_design.stability.margins import Margins
from ffsm_drake.control_design.stability.sampled_loop import LoopGains, axis_poles
from ffsm_drake.spacecraft.coordinates import GROUPS

_GROUP_COLORS = dict(zip(GROUPS, ("#D55E00", "#0072B2", "#009E73"), strict=True))
_DASHES = ("-", "--", ":", "-.", (0, (1, 1)), (0, (6, 2, 1, 2, 1, 2)), (0, (9, 3)))  # seven joints can be told apart


def margins_table(margins: Margins) -> str:
    """Plain text: per coordinate the limits against what the scenario uses, then what holds for all of them."""
    scenario, law = margins.scenario, margins.law
    has_k_s = scenario.controller != "tdc"
    plant = "explicit Euler at the control period" if margins.sampling.euler else "exactly integrated"
    lines = [
        f"{scenario.description or 'scenario'}: {scenario.controller}, L = {scenario.sample_time:g} s, plant {plant}",
        f"eigenvalues eta of H^-1 Hhat along the planned motion: {margins.eta.min():.3f} to {margins.eta.max():.3f}",
        "",
        f"{'coordinate':<18}{'K_s start':>11}{'expected':>11}{'bound':>9}{'limit':>9}{'margin':>9}"
        f"{'largest L':>12}{'tolerated eta':>18}",
        f"{'':<18}{'1/s':>11}{'1/s':>11}{'1/s':>9}{'1/s':>9}{'':>9}{'ms':>12}",
    ]
    for i, name in enumerate(margins.coordinates.names):
        low, high = margins.eta_tolerated[i]
        gains = f"{law.k_s[i]:>11.4g}{margins.forecast_k_s[:, i].max():>11.4g}"
        bound = f"{law.k_s_max[i]:>9.4g}" if np.isfinite(law.k_s_max[i]) else f"{'none':>9}"
        margin = f"{margins.k_s_limit[i] / max(margins.forecast_k_s[:, i].max(), 1e-9):>9.2f}"
        shown = (
            gains + bound + f"{margins.k_s_limit[i]:>9.4g}" + margin
            if has_k_s
            else f"{'-':>11}{'-':>11}{'-':>9}{'-':>9}{'-':>9}"
        )
        lines.append(f"{name:<18}{shown}{1e3 * margins.sample_time_limit[i]:>12.2f}{low:>11.2f} .. {high:.2f}")
    lines += [
        "",
        f"coupled loop at the starting gains: spectral radius {margins.spectral_radius.max():.5f} at the worst posture",
        margins.verdict,
    ]
    return "\n".join(lines)


def margins_data(margins: Margins) -> dict[str, Any]:
    """The table's figures as plain data, by coordinate where they differ (1/s, s)."""
    by_coordinate = {
        name: {
            "k_s_start": float(margins.law.k_s[i]),
            "k_s_expected": float(margins.forecast_k_s[:, i].max()),
            "k_s_bound": float(margins.law.k_s_max[i]),
            "k_s_limit": float(margins.k_s_limit[i]),
            "sample_time_limit": float(margins.sample_time_limit[i]),
            "eta_tolerated": margins.eta_tolerated[i].tolist(),
        }
        for i, name in enumerate(margins.coordinates.names)
    }
    return {
        "controller": margins.scenario.controller,
        "verdict": margins.verdict,
        "stable": margins.is_stable,
        "spectral_radius": float(margins.spectral_radius.max()),
        "eta": [float(margins.eta.min()), float(margins.eta.max())],
        "coordinates": by_coordinate,
    }


def plot_margins(margins: Margins) -> Figure:
    """The stability map with the operating point and its expected path, and what it rests on along the motion."""
    figure = Figure(figsize=(12.0, 8.5), layout="constrained")
    figure.suptitle(
        f"Sampled-loop stability: {margins.scenario.controller}, {margins.scenario.description}\n{margins.verdict}",
        fontsize=11,
    )
    panels = figure.subplots(2, 2)
    _draw_map(figure, panels[0, 0], margins)
    _draw_forecast(panels[0, 1], margins)
    _draw_eta(panels[1, 0], margins)
    _draw_radius(panels[1, 1], margins)
    for axes in panels.ravel():
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _draw_map(figure: Figure, axes: Axes, margins: Margins) -> None:
    law, scenario = margins.law, margins.scenario
    has_k_s = scenario.controller != "tdc"
    eta = np.linspace(0.2, 1.4, 90)
    top = (
        1.35 * max(np.nanmax(margins.k_s_limit), law.k_s.max())
        if has_k_s
        else 1e3 * 1.5 * margins.sample_time_limit.max()
    )
    vertical = np.linspace(top / 200, top, 90)
    gains = law.at()

    def poles(x: float, y: float) -> np.ndarray:
        if has_k_s:
            changed, sampling = law.at(y), margins.sampling.axis(0)
        else:
            changed, sampling = gains, dataclasses.replace(margins.sampling.axis(0), sample_time=1e-3 * y)
        single = LoopGains(k_v=changed.k_v[0], k_p=changed.k_p[0], k_i=changed.k_i[0])
        return axis_poles(single, eta=x, sampling=sampling)

    values = [[poles(x, y) for x in eta] for y in vertical]
    largest = np.array([[np.abs(entry).max() for entry in row] for row in values])
    ringing = np.array([[-entry.real.min() for entry in row] for row in values])
    shades = axes.contourf(eta, vertical, ringing, levels=[-1.0, 0.0, 0.25, 0.5, 0.75, 1.0], cmap="Blues", alpha=0.75)
    axes.contourf(eta, vertical, largest, levels=[1.0, np.inf], colors=["#F4D9CC"])
    axes.contour(eta, vertical, largest, levels=[1.0], colors="black", linewidths=2)
    figure.colorbar(shades, ax=axes, label="ringing: minus the most negative pole")
    axes.axvspan(margins.eta.min(), margins.eta.max(), color="#999999", alpha=0.35, label="$\\eta$ along the motion")
    axes.text(1.22, 0.93 * top, "unstable", fontsize=10)
    if not has_k_s:
        axes.plot(margins.eta.max(), 1e3 * scenario.sample_time, "o", color="black", label="sample time in use")
        axes.set(ylabel="sample time L [ms]", title="(a) Stability map")
    else:
        for k, (group, part) in enumerate(margins.coordinates.groups.items()):
            if part.start >= law.k_s.size:
                continue
            path = margins.forecast_k_s[:, part]
            extreme = path[:, np.argmax(path.max(axis=0))]
            x = margins.eta.max() - 0.02 * k
            axes.plot(x, extreme[0], "o", color=_GROUP_COLORS[group], markersize=6)
            axes.annotate(
                "", xy=(x, min(extreme[-1], 0.99 * top)), xytext=(x, extreme[0]),
                arrowprops={"arrowstyle": "->", "color": _GROUP_COLORS[group], "linewidth": 2},
            )  # fmt: skip
            axes.plot([], [], "-o", color=_GROUP_COLORS[group], label=f"{group}: start, expected path")
        axes.set(ylabel="$K_s$ [1/s]", title=f"(a) Stability map of {margins.coordinates.names[0]}")
    axes.set(xlabel="$\\eta$ (above 1: inertia over-estimated)", ylim=(0, top), xlim=(eta[0], eta[-1]))
    axes.legend(loc="lower left", fontsize=8)


def _draw_forecast(axes: Axes, margins: Margins) -> None:
    axes.set(xlabel="time [s]", ylabel="$K_s$ [1/s]", title="(b) Where adaptation is expected to take $K_s$")
    if margins.scenario.controller == "tdc":
        axes.text(0.5, 0.5, "TDC has no $K_s$", ha="center", va="center", transform=axes.transAxes)
        return
    for group, part in margins.coordinates.groups.items():
        for i in range(*part.indices(margins.law.k_s.size)):
            axes.plot(
                margins.forecast_times, margins.forecast_k_s[:, i], color=_GROUP_COLORS[group], linewidth=1.3,
                linestyle=_DASHES[(i - part.start) % len(_DASHES)],
                label=group if i == part.start else None,
            )  # fmt: skip
    limit = np.nanmin(margins.k_s_limit)
    axes.axhline(limit, color="black", linewidth=2)
    axes.text(0.01, limit, " limit", va="bottom", transform=axes.get_yaxis_transform())
    if np.isfinite(margins.law.k_s_max).all() and (margins.law.k_s_max > margins.law.k_s).any():
        axes.axhline(margins.law.k_s_max.max(), color="#777777", linestyle="--")
        axes.text(
            0.99, margins.law.k_s_max.max(), "k_s_max", va="bottom", ha="right", transform=axes.get_yaxis_transform()
        )
    axes.legend(fontsize=8)


def _draw_eta(axes: Axes, margins: Margins) -> None:
    axes.plot(margins.times, margins.eta, color="#0072B2", linewidth=1.2)
    axes.axhline(1.0, color="black", linewidth=0.8)
    low, high = margins.eta_tolerated[:, 0].max(), margins.eta_tolerated[:, 1].min()
    axes.axhspan(
        low, high, color="#9ecae1", alpha=0.3, label=f"tolerated at the starting gains: {low:.2f} to {high:.2f}"
    )
    axes.set(xlabel="time along the planned motion [s]", ylabel="$\\eta$", title="(c) Eigenvalues of $H^{-1}\\hat{H}$")
    axes.legend(fontsize=8, loc="lower left")


def _draw_radius(axes: Axes, margins: Margins) -> None:
    axes.plot(margins.times, margins.spectral_radius, color="#D55E00", linewidth=2, label="starting gains")
    if margins.scenario.controller != "tdc":
        expected = margins.spectral_radius_expected
        axes.plot(margins.times, expected, color="#0072B2", linewidth=2, linestyle="--", label="largest expected $K_s$")
    axes.axhline(1.0, color="black", linewidth=2)
    axes.set(xlabel="time along the planned motion [s]", ylabel="spectral radius")
    axes.set_title("(d) Coupled loop of all coordinates")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(fontsize=8)
