"""Charts as Matplotlib draws them: stacks of charts in a grid, in one style."""

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullLocator

from ffsm_drake.common.files import written_whole
from ffsm_drake.show.chart import Chart, Curve, Level
from ffsm_drake.show.style import GRID

LARGEST = 1e100  # largest drawn value: near the largest float, axes have no ticks
# Style of all figures (Matplotlib's settings).
STYLE: Any = {
    "axes.axisbelow": True, "axes.grid": True, "grid.color": GRID, "grid.linewidth": 0.6,
    "axes.spines.top": False, "axes.spines.right": False, "axes.xmargin": 0.01,
    "axes.titlesize": 10, "axes.titlelocation": "left", "axes.labelsize": 9,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "legend.fontsize": 8, "legend.frameon": False,
    "figure.titlesize": 13, "figure.titleweight": "bold", "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-2, 4), "axes.formatter.min_exponent": 3,
    "axes.formatter.use_mathtext": True, "svg.hashsalt": "ffsm_drake",
}  # fmt: skip
_MARKERS = {
    "": "", "circle": "o", "diamond": "D", "dot": ".", "square": "s", "star": "*", "x": "x",
    "x-thick": "X", "diamond-open": "D",
}  # fmt: skip
_DOTS = {"png": 130, "pdf": 300, "svg": 300}  # per inch, in vector files of noisy curves only
# without the date: the same run gives the same file
_METADATA: dict[str, dict[str, Any]] = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
_MOST_LAID_OUT = 6
_MARGINS = {"left": 0.21, "right": 0.97, "bottom": 0.17, "top": 0.87, "hspace": 0.12}
_LETTERS_PER_INCH = 15  # of a legend


def plot_charts(
    stacks: Sequence[Sequence[Chart]],
    title: str,
    description: str = "",
    *,
    columns: int,
    size: tuple[float, float],
    heights: Sequence[float] = (1.0,),
    below: bool = False,
) -> Figure:
    """Return a figure of stacks of charts in a grid, lettered.

    Args:
      stacks: charts on a common x axis, from top to bottom, by cell; a subfigure each.
      title: heading.
      description: text below the heading.
      columns: of the grid.
      size: width and height, inches.
      heights: relative heights of the charts of a stack.
      below: put the legend of the last chart below the figure.
    """
    # The layout of many axes would take seconds, so they have fixed margins.
    many = len(stacks) > _MOST_LAID_OUT
    pad, rows = int(many), -(-len(stacks) // columns)
    with mpl.rc_context(STYLE):
        layout = None if many else ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.07)
        figure = Figure(figsize=size, layout=layout)
        # The constrained layout keeps room for the title only if it places it itself.
        figure.suptitle(f"{plain(title)}\n", **{"y": 1.0 - 0.12 / size[1]} if many else {})
        place: dict[str, Any] = {"x": 0.5, "y": 1.0 - 0.4 / size[1], "ha": "center", "va": "top"}
        figure.text(s=plain(description), fontsize=9, color="#444444", **place)
        inches = [*[0.7] * pad, *[size[1] / rows] * rows, *[0.4] * pad]
        grid = figure.add_gridspec(rows + 2 * pad, columns, height_ratios=inches)
        for number, stack in enumerate(stacks):
            part = figure.add_subfigure(grid[number // columns + pad, number % columns])
            letter = f"({chr(ord('a') + number)}) " if len(stacks) > 1 else ""
            _draw_stack(part, stack, heights[: len(stack)], _MARGINS if many else {})
            part.axes[0].set_title(letter + plain(stack[0].title))
        if below:
            _legend_below(figure, figure.axes[-1])
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure whole; the same figure gives the same file.

    Raises:
      RecordError: the file cannot be written.
    """
    kind = path.suffix[1:]
    with written_whole(path) as temporary, mpl.rc_context(STYLE):
        figure.savefig(temporary, format=kind, dpi=_DOTS[kind], metadata=_METADATA.get(kind))


def _draw_stack(
    part: SubFigure, stack: Sequence[Chart], heights: Sequence[float], margins: dict[str, float]
) -> None:
    space = {"projection": "3d"} if stack[0].kind == "space" else {}
    axes = part.subplots(
        len(stack), 1, sharex=True, height_ratios=heights, squeeze=False, subplot_kw=space,
        gridspec_kw=margins,
    )  # fmt: skip
    for each, chart in zip(axes[:, 0], stack, strict=True):
        _draw(each, chart, ticks=7 if len(stack) == 1 else 4)
        each.label_outer(remove_inner_ticks=False)
        if chart.legend == "below":
            _legend_below(part, each)


def _draw(axes: Any, chart: Chart, ticks: int) -> None:
    """Draw a chart, with at most ``ticks`` ticks on a logarithmic y axis."""
    if chart.note:
        text = textwrap.fill(plain(chart.note), 60)
        axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
    for curve in chart.curves:
        _draw_curve(axes, curve)
    for band in chart.bands:
        across = axes.axvspan if band.axis == "x" else axes.axhspan
        for k, span in enumerate(band.spans):
            name = "" if k else plain(band.name)
            across(*span, color=band.color, alpha=band.opacity, lw=0, zorder=1.5, label=name)
    for level in chart.levels:
        _draw_level(axes, level)
    if chart.kind == "space":
        axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.locator_params(nbins=4)
        axes.view_init(elev=22.0, azim=-125.0)
        axes.set_box_aspect(None, zoom=0.9)
    else:
        _set_plane(axes, chart, ticks)
    if chart.legend == "inside":
        axes.legend(frameon=True)
    elif chart.legend == "right":
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _set_plane(axes: Axes, chart: Chart, ticks: int) -> None:
    label = f"{chart.what} [{chart.label_y}]" if chart.what and chart.label_y else ""
    axes.set_xlabel(plain(chart.x))
    axes.set_ylabel(plain(label or chart.what or chart.label_y))
    axes.margins(x=chart.margin, y=max(chart.margin, 0.05))
    if chart.range_x is not None:
        axes.set_xlim(*chart.range_x)
    if chart.range is not None:
        axes.set_ylim(*chart.range)
    if chart.log_x:
        axes.set_xscale("log")
    if chart.log_y:
        _set_log_scale(axes, ticks)
    if chart.rows:
        axes.set_yticks(range(len(chart.rows)), map(plain, chart.rows))
        axes.set_ylim(len(chart.rows) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")


def _draw_curve(axes: Any, curve: Curve) -> None:
    look = curve.style.matplotlib
    if curve.marker.endswith("open"):
        look["markerfacecolor"] = "none"
    if not curve.line:
        look |= {"linestyle": "none", "markeredgewidth": 0.0 if curve.size < 5.0 else 1.0}
    points = [curve.x, np.where(np.abs(curve.y) < LARGEST, curve.y, np.nan)]
    width = curve.width
    if curve.z is None:
        look["drawstyle"] = "steps-post" if curve.steps else "default"
    else:
        points, width = [*points, curve.z], 0.4 * width
        for *place, text in zip(*points, curve.texts, strict=False):
            axes.text(*place, f" {text}", fontsize=8, color=curve.style.color)
    # Steps are rasterized, because steps of noise would need megabytes as vectors.
    axes.plot(
        *points, marker=_MARKERS[curve.marker or "dot" * (len(curve.x) == 1)],
        markersize=0.75 * curve.size, linewidth=width, rasterized=curve.steps,
        alpha=curve.opacity, label=plain(curve.name), **look,
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


def _legend_below(figure: Figure | SubFigure, axes: Axes) -> None:
    """Put the legend of some axes below a figure, in as many columns as have room."""
    handles, labels = axes.get_legend_handles_labels()
    longest = 6 + max(map(len, "\n".join(labels).split("\n")))
    inches = figure.bbox.width / figure.dpi
    figure.legend(
        handles, labels, loc="outside lower center",
        ncols=max(1, int(_LETTERS_PER_INCH * inches / longest)),
    )  # fmt: skip


def plain(text: object) -> str:
    """Return a user's text for a Matplotlib label, dollar signs escaped: they would mark
    mathematics.
    """
    return str(text).replace("$", r"\$")


def _set_log_scale(axes: Axes, ticks: int) -> None:
    """A logarithmic y axis with labelled ticks, however few decades it spans."""
    axes.set_yscale("log")
    low, high = np.nan_to_num(axes.get_ylim(), nan=1.0)
    if not 1.0 / LARGEST <= low < high <= LARGEST:  # the line of a huge bound
        axes.set_ylim(max(low, 1e-12), min(max(high, 1.0), LARGEST))
    axes.yaxis.set_major_locator(LogLocator(numticks=ticks))
    low, high = axes.get_ylim()
    between: tuple[float, ...] = ()
    if np.floor(np.log10(high)) <= np.ceil(np.log10(low)):  # not two powers of ten
        between = (3.0,) if high >= 10.0 * low else (2.0, 5.0)
        between = between if high > 4.0 * low else (1.5, 2.0, 3.0, 5.0, 7.0)
    axes.yaxis.set_minor_locator(LogLocator(subs=between) if between else NullLocator())
    axes.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(np.inf, np.inf)))
