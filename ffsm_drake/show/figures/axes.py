"""Charts as Matplotlib draws them, and the style that all panels of the figures share."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.style import GRID

LARGEST = 1e100  # largest drawn value: near the largest float, axes have no ticks
_MARKERS = {
    "": "", "circle": "o", "diamond": "D", "dot": ".", "square": "s", "star": "*", "x": "x",
    "x-thick": "X",
}  # fmt: skip


def draw(
    axes: Axes, chart: Chart, *, what: str = "", thickness: float = 1.0, ticks: int = 7
) -> None:
    """Draw a chart.

    Args:
      axes: the axes to draw in.
      chart: the chart to draw.
      what: the quantity, before the unit on the y axis.
      thickness: multiplies the widths of the curves.
      ticks: the largest number of ticks on a logarithmic y axis.
    """
    for curve in chart.curves:
        _draw_curve(axes, curve, thickness)
    for band in chart.bands:
        axes.broken_barh(
            [(low, high - low) for low, high in band.spans.tolist()], (0.0, 1.0),
            transform=axes.get_xaxis_transform(), color=band.color, alpha=band.opacity,
            linewidth=0, zorder=1.5, label=plain(band.name),
        )  # fmt: skip
    for level in chart.levels:
        _draw_level(axes, level)
    label = f"{what} [{chart.label_y}]" if what and chart.label_y else what or chart.label_y
    axes.set(xlabel=plain(chart.x), ylabel=plain(label))
    axes.set_title(plain(chart.title), fontsize=10)
    tidy(axes)
    if chart.range_x is not None:
        axes.set_xlim(*chart.range_x)
    if chart.range is not None:
        axes.set_ylim(*chart.range)
    if chart.log_x:
        axes.set_xscale("log")
    if chart.log_y:
        set_log_scale(axes, ticks)
    else:
        axes.ticklabel_format(axis="y", useOffset=False)
    if chart.legend:
        axes.legend(fontsize=8)


def _draw_curve(axes: Axes, curve: Curve, thickness: float) -> None:
    look = curve.style.matplotlib
    if not curve.line:
        look |= {"linestyle": "none", "markeredgewidth": 0.0 if curve.size < 5.0 else 1.0}
    # Steps are rasterized, because steps of noise would need megabytes as vectors.
    axes.plot(
        curve.x, np.where(np.abs(curve.y) < LARGEST, curve.y, np.nan),
        marker=_MARKERS[curve.marker or "dot" * (len(curve.x) == 1)], markersize=0.75 * curve.size,
        linewidth=thickness * curve.width, drawstyle="steps-post" if curve.steps else "default",
        rasterized=curve.steps, alpha=curve.opacity, label=plain(curve.name), **look,
    )  # fmt: skip


def _draw_level(axes: Axes, level: Level) -> None:
    """Draw a line, with its text above its right end, or next to its lower end."""
    look = {"linewidth": 1.2, "label": plain(level.name), **level.style.matplotlib}
    small: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8}
    if level.axis == "y":
        axes.axhline(level.value, **look)
        axes.annotate(
            level.text, (0.99, level.value), xycoords=axes.get_yaxis_transform(), ha="right",
            xytext=(0, -2 if level.below else 2), va="top" if level.below else "bottom", **small,
        )  # fmt: skip
    else:
        axes.axvline(level.value, **look)
        axes.annotate(
            level.text, (level.value, 0.02), xycoords=axes.get_xaxis_transform(), xytext=(4, 0),
            **small,
        )  # fmt: skip


def tidy(axes: Axes) -> None:
    """Apply the style that all panels share."""
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)


def legend_below(figure: Figure | SubFigure, axes: Axes, *, columns: int = 3) -> None:
    """Put a panel's legend below it, clear of the curves."""
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, fontsize=8, loc="outside lower center", ncols=columns, frameon=False)


def plain(text: object) -> str:
    """Return a user's text for a Matplotlib label, dollar signs escaped: they would mark
    mathematics.
    """
    return str(text).replace("$", r"\$")


def set_log_scale(axes: Axes, ticks: int) -> None:
    """A logarithmic y axis with at least two labelled ticks, however few decades it spans."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if np.floor(np.log10(high)) > np.ceil(np.log10(low)):  # two powers of ten
        axes.yaxis.set_major_locator(LogLocator(numticks=ticks))
    else:
        subs: tuple[float, ...] = (1.0, 3.0)
        if high < 10.0 * low:
            subs = (1.0, 2.0, 5.0) if high > 4.0 * low else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
        axes.yaxis.set_major_locator(LogLocator(subs=subs))
        axes.yaxis.set_major_formatter(FuncFormatter(_tick_label))
    axes.yaxis.set_minor_locator(NullLocator())


def _tick_label(value: float, _: int | None = None) -> str:
    if 1e-2 <= value < 1e3:
        return f"{value:.4g}"
    mantissa, exponent = f"{value:.3e}".split("e")
    return rf"${float(mantissa):g}{{\times}}10^{{{int(exponent)}}}$".replace(r"$1{\times}", "$")
