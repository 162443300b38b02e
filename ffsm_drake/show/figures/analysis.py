"""One page of an analysis: the quantities of the proof over time, with their bounds."""

import dataclasses
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from ffsm_drake.analysis.findings import Analysis
from ffsm_drake.show.figures.axes import LARGEST, legend_below, plain, tidy
from ffsm_drake.show.style import (
    BAD,
    BLUE,
    GOOD,
    GREEN,
    GROUP_STYLES,
    GROUP_TITLES,
    MUTE,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
)

_VERDICT_COLORS = {"does not hold": BAD, "holds": GOOD, "not tested": MUTE, "not applicable": MUTE}
_DASHED: Any = (0, (5, 3))
_LIMIT: Any = {"linewidth": 1.1, "linestyle": _DASHED}
# Noisy magnitudes are drawn as the maximum of each time interval: comparable with bounds, and
# legible.
_INTERVALS = 200


def plot_analysis(analysis: Analysis) -> Figure:
    """Six panels: TDE error, condition (8), sliding variable, Lyapunov function, gains, spectrum.

    The verdicts of a panel's findings are at the right of its title; an inapplicable panel gives
    its reason.
    """
    drawn = analysis.series.map(
        lambda one: one.where(np.abs(one) < LARGEST) if one.dtype.kind == "f" else one
    )
    analysis = dataclasses.replace(analysis, series=drawn.assign_attrs(analysis.series.attrs))
    figure = Figure(figsize=(13.0, 12.5), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.07))
    attributes = analysis.series.attrs
    subtitle = plain(
        f"{attributes['title']}. Controller {attributes['controller']}; {attributes['outcome']}"
    )
    figure.suptitle("The paper's claims on this run\n" + textwrap.fill(subtitle, 140), fontsize=11)
    grid = figure.add_gridspec(3, 2)
    panels: tuple[tuple[str, str, dict[str, str], Callable[[SubFigure, Analysis], Axes]], ...] = (
        ("(a) TDE error and its bound N*", "tde_error", {"tde_error_bound": "N*"}, _plot_tde_error),
        ("(b) Match of inertias", "eta", {"condition_8": "condition (8)"}, _plot_condition_8),
        (
            "(c) Sliding variable",
            "sliding_variable",
            {"direct_bound": "bound from (7)", "ultimate_bound": "(16)"},
            _plot_sliding_variable,
        ),
        (
            "(d) Lyapunov function",
            "lyapunov",
            {"lyapunov_derivative": "dV/dt ≤ 0 outside"},
            _plot_lyapunov,
        ),
        (
            "(e) Gains against N*",
            "reaching_gain",
            {
                "lemma_1_premise": "β‖s‖ < N*",
                "lemma_1_conclusion": "K$_s$ < N*",
                "switching_gain_bound": "G ≤ N*",
            },
            _plot_gains,
        ),
        (
            "(f) Spectrum of the control force",
            "effort_spectrum",
            {"chattering": "chattering"},
            _plot_spectrum,
        ),
    )
    for number, (title, needed, keys, draw) in enumerate(panels):
        part = figure.add_subfigure(grid[number // 2, number % 2])
        findings = {label: analysis.finding(key) for key, label in keys.items()}
        if needed in analysis.series:
            axes = draw(part, analysis)
            evaluated: dict[str, list[str]] = {}
            for label, item in findings.items():
                if item.verdict != "measured":
                    evaluated.setdefault(item.verdict, []).append(label)
            verdicts = "; ".join(
                f"{verdict}: {', '.join(labels)}" for verdict, labels in evaluated.items()
            )
            # The least favourable verdict determines the colour.
            color = next(
                (shade for verdict, shade in _VERDICT_COLORS.items() if verdict in evaluated), MUTE
            )
            axes.set_title(verdicts, fontsize=9, loc="right", color=color)
        else:
            axes = part.subplots()
            axes.set_axis_off()
            reason = next(iter(findings.values())).statement
            axes.text(
                0.5,
                0.5,
                textwrap.fill(reason, 60),
                ha="center",
                va="center",
                fontsize=10,
                color=MUTE,
            )
        axes.set_title(title, fontsize=10, loc="left", fontweight="bold")
        for each in part.axes:
            low, high = np.nan_to_num(each.get_ylim(), nan=1.0)
            # line of a huge bound
            if each.get_yscale() == "log" and not 1.0 / LARGEST <= low < high <= LARGEST:
                each.set_ylim(max(low, 1e-12), min(max(high, 1.0), LARGEST))
    return figure


def _plot_tde_error(part: SubFigure, analysis: Analysis) -> Axes:
    axes = _axes(part, "largest |Ñ$_i$| [rad/s$^2$, m/s$^2$]")
    _plot_groups(axes, analysis, "tde_error", "period")
    _plot_bounds(axes, analysis, "tde_error_bound_late", "N*, without start-up by group")
    bound, late = (
        float(analysis.series[name].max()) for name in ("tde_error_bound", "tde_error_bound_late")
    )
    axes.axhline(bound, color="black", **_LIMIT)
    _note(axes, bound, f"N* = {bound:.3g}")
    axes.set_yscale("log")
    if np.isfinite(late):
        text = f"{late:.3g} without the first {analysis.series.attrs['start_up_time']:g} s"
        _note(axes, late, text, below=late > 0.3 * bound)
    legend_below(part, axes)
    return axes


def _plot_condition_8(part: SubFigure, analysis: Analysis) -> Axes:
    axes = _axes(part, "eigenvalue, norm")
    time, eta = analysis.series["posture_time"].values, analysis.series["eta"].values
    marker = "." if len(time) < 5 else ""
    for k, curve in enumerate(eta.T):
        axes.plot(
            time,
            curve,
            color=SKY,
            linewidth=1.0,
            marker=marker,
            label="" if k else "eigenvalues η of $H^{-1}Ĥ$",
        )
    axes.plot(
        time, analysis.series["condition_8"], color=VERMILION, linewidth=1.8, marker=marker,
        label="‖E - $H^{-1}Ĥ$‖$_2$ of (8), in m and rad",
    )  # fmt: skip
    axes.plot(
        time,
        analysis.series["condition_8_in_h"],
        color=GREEN,
        linewidth=1.8,
        linestyle=(0, (4, 1)),
        marker=marker,
        label="the same in the metric of $H$: max |1 - η|",
    )
    axes.axhline(
        1.0,
        color="black",
        linewidth=1.0,
        linestyle=_DASHED,
        label="limit of (8); η for the true payload",
    )
    axes.set_ylim(
        0.0, 1.05 * max(1.05, float(eta.max()), float(analysis.series["condition_8"].max()))
    )
    legend_below(part, axes, columns=2)
    return axes


def _plot_sliding_variable(part: SubFigure, analysis: Analysis) -> Axes:
    axes = _axes(part, "largest |s$_i$| [rad/s, m/s]")
    _plot_groups(axes, analysis, "sliding_variable", "time")
    axes.set_yscale("log")
    if "direct_bound" in analysis.series:
        _plot_bounds(axes, analysis, "direct_bound", "bound from (7), by group")
    lines = {
        "(16): ‖s‖$_2$ ≤ {:.3g}": analysis.finding("ultimate_bound").numbers.get("ultimate_bound"),
        "ε = {:.3g}": analysis.finding("lyapunov_derivative").numbers.get("epsilon"),
    }
    for text, line in lines.items():
        if isinstance(line, float) and np.isfinite(line):
            axes.axhline(
                line,
                color="black",
                linewidth=1.1,
                linestyle=_DASHED if "16" in text else (0, (1, 2)),
            )
            _note(axes, line, text.format(line))
    legend_below(part, axes, columns=4)
    return axes


def _plot_lyapunov(part: SubFigure, analysis: Analysis) -> Axes:
    upper, lower = part.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.6))
    series = analysis.series
    upper.plot(series["time"], series["lyapunov"], color="black", linewidth=1.4)
    upper.set_ylabel("V of (12)", fontsize=9)
    upper.ticklabel_format(axis="y", useOffset=False)
    time, rate = series["period"].values, series["lyapunov_rate"].values
    outside = series["outside"].values[:-1] > 0
    for color, marker, label, picked in (
        (VERMILION, "o", "dV/dt > 0", rate > 0.0),
        (BLUE, "s", "dV/dt ≤ 0", rate <= 0.0),
    ):
        for name, where, size, alpha in (
            ("outside", outside, 16.0, 1.0),
            ("inside", ~outside, 5.0, 0.4),
        ):
            chosen = picked & where
            lower.scatter(
                time[chosen],
                np.where(rate[chosen] != 0.0, np.abs(rate[chosen]), np.nan),
                s=size,
                marker=marker,
                color=color,
                alpha=alpha,
                linewidths=0,
                zorder=3 if name == "outside" else 2,
                label=f"{label}, {name}: {chosen.sum()} samples",
            )
    lower.set_yscale("log")
    lower.set_ylabel("|dV/dt| of (13) [1/s]", fontsize=9)
    lower.set_xlabel("time [s]", fontsize=9)
    # Shade the samples outside, each as wide as its period but never too narrow to be seen.
    width = max(float(series.attrs["sample_time"]), 0.003 * float(time[-1] - time[0]))
    for axes in (upper, lower):
        _style(axes)
        axes.broken_barh(
            [(start, width) for start in time[outside].tolist()],
            (0.0, 1.0),
            transform=axes.get_xaxis_transform(),
            color="#F7DFB0",
            linewidth=0,
            zorder=0,
        )
    lower.plot(
        [],
        [],
        color="#F7DFB0",
        linewidth=6,
        label="outside is some |s$_i$| > max(K$_{si}$/β$_i$, ε)",
    )
    legend_below(part, lower, columns=2)
    return upper


def _plot_gains(part: SubFigure, analysis: Analysis) -> Axes:
    axes = _axes(part, "gain [1/s; rad/s$^2$, m/s$^2$]")
    axes.set_yscale("log")
    series, time = analysis.series, analysis.series["time"].values
    if "scaled_sliding_variable" in series:
        when, most = _interval_maxima(time, series["scaled_sliding_variable"].values)
        axes.plot(when, most, color=PURPLE, linewidth=0.9, label="premise: max β$_i$ ‖s‖$_∞$")
    for name, label, color in (
        ("reaching_gain", "K$_{si}$", VERMILION),
        ("switching_gain", "G$_i$", BLUE),
    ):
        values = np.where(series[name].values > 0.0, series[name].values, np.nan)
        if not np.isnan(values).all():
            first, *_ = axes.plot(time, values, color=color, linewidth=0.9)
            first.set_label(f"{label}, every coordinate")
    bound, late = (
        float(series[name].max()) for name in ("tde_error_bound", "tde_error_bound_late")
    )
    axes.axhline(bound, color="black", **_LIMIT)
    _note(axes, bound, f"N* = {bound:.3g}")
    if np.isfinite(late):
        axes.axhline(late, color=MUTE, linewidth=1.1, linestyle=(0, (1, 2)))
        text = f"{late:.3g} without the first {series.attrs['start_up_time']:g} s"
        _note(axes, late, text, below=late > 0.05 * bound)
    legend_below(part, axes)
    return axes


def _plot_spectrum(part: SubFigure, analysis: Analysis) -> Axes:
    axes = _axes(part, "power density [(N m)$^2$/Hz, N$^2$/Hz]", "frequency [Hz]")
    series, group = analysis.series, analysis.series["group"].values
    numbers = analysis.finding("chattering").numbers
    # The zero frequency was removed with the trend.
    frequency, density = series["frequency"].values[1:], series["effort_spectrum"].values[1:]
    # driven groups only
    for name in (each for each in _groups(analysis) if f"share.{each}" in numbers):
        axes.plot(
            frequency,
            density[:, group == name].sum(axis=1),
            linewidth=1.4,
            **GROUP_STYLES[name].matplotlib,
            label=f"{GROUP_TITLES[name]}: {100.0 * float(numbers[f'share.{name}']):.3g} % of its "
            "variance is shaded, "
            f"{numbers[f'reversals_per_second.{name}']:.0f} reversals/s",
        )
    split = float(series.attrs["split_frequency"])
    axes.axvline(split, color="black", linewidth=1.1, linestyle=_DASHED)
    axes.axvspan(split, frequency[-1], color=ORANGE, alpha=0.12, linewidth=0, zorder=0)
    axes.set(xscale="log", yscale="log")
    axes.annotate(
        f"from {split:g} Hz on", (split, 0.02), xycoords=axes.get_xaxis_transform(), xytext=(4, 0),
        textcoords="offset points", fontsize=8,
    )  # fmt: skip
    legend_below(part, axes, columns=1)
    return axes


def _axes(part: SubFigure, ylabel: str, xlabel: str = "time [s]") -> Axes:
    axes = part.subplots()
    axes.set_ylabel(ylabel, fontsize=9)
    axes.set_xlabel(xlabel, fontsize=9)
    _style(axes)
    return axes


def _style(axes: Axes) -> None:
    tidy(axes)
    axes.tick_params(labelsize=8)
    axes.margins(x=0.01, y=0.1)


def _interval_maxima(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maxima of at most _INTERVALS intervals, at the intervals' first times; zero becomes NaN."""
    starts = np.unique(np.linspace(0, len(values), _INTERVALS, endpoint=False, dtype=int))
    most = np.maximum.reduceat(values, starts)
    return time[starts], np.where(most > 0.0, most, np.nan)


def _groups(analysis: Analysis) -> list[str]:
    """The driven groups that have coordinates."""
    driven = analysis.series["group"].values[analysis.series["driven"].values]
    return [name for name in GROUP_TITLES if name in driven]


def _plot_groups(axes: Axes, analysis: Analysis, name: str, time: str) -> None:
    """The largest magnitude of every group's coordinates over time."""
    series, group = analysis.series, analysis.series["group"].values
    for key in _groups(analysis):
        when, most = _interval_maxima(
            series[time].values, np.abs(series[name].values[:, group == key]).max(axis=1)
        )
        style = GROUP_STYLES[key].matplotlib | {"marker": "." if len(when) < 20 else ""}
        axes.plot(when, most, linewidth=1.1, label=GROUP_TITLES[key], **style)


def _plot_bounds(axes: Axes, analysis: Analysis, name: str, label: str) -> None:
    """The largest bound of every group's coordinates, if there is one."""
    bounds, group = analysis.series[name].values, analysis.series["group"].values
    largest = {key: bounds[group == key].max() for key in _groups(analysis)}
    shown = {key: value for key, value in largest.items() if np.isfinite(value) and value > 0.0}
    for key, value in shown.items():
        axes.axhline(value, color=GROUP_STYLES[key].color, **_LIMIT)
    if shown:
        axes.plot([], [], color=MUTE, label=label, **_LIMIT)


def _note(axes: Axes, y: float, text: str, *, below: bool = False) -> None:
    """A small text at the right end of a horizontal line at y."""
    axes.annotate(
        text, (0.99, y), xycoords=axes.get_yaxis_transform(), xytext=(0, -2 if below else 2),
        textcoords="offset points", ha="right", va="top" if below else "bottom", fontsize=8,
    )  # fmt: skip
