"""Shared style of the Matplotlib figures' panels."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ffsm_drake.show.style import GRID

LARGEST = 1e100  # largest drawn value: near the largest float, axes have no ticks


def tidy(axes: Axes) -> None:
    """Apply the style that all panels share."""
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)


def legend_below(figure: Figure | SubFigure, axes: Axes, *, columns: int = 3) -> None:
    """Put the panel's legend below it, clear of the curves."""
    figure.legend(
        *axes.get_legend_handles_labels(),
        fontsize=8,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
    )


def plain(text: object) -> str:
    """A user's text for a Matplotlib label, dollar signs escaped: they would mark mathematics."""
    return str(text).replace("$", r"\$")


def set_log_scale(axes: Axes) -> None:
    """A logarithmic y axis with at least two labelled ticks, however few decades it spans."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high > 30.0 * low:
        axes.yaxis.set_major_locator(LogLocator(numticks=4))
    else:
        axes.yaxis.set_major_locator(
            LogLocator(subs=(1.0, 2.0, 5.0) if high < 10.0 * low else (1.0, 3.0))
        )
        axes.yaxis.set_major_formatter(FuncFormatter(_tick_label))
    axes.yaxis.set_minor_locator(NullLocator())


def _tick_label(value: float, _: int | None = None) -> str:
    if 1e-2 <= value < 1e3:
        return f"{value:g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return rf"${mantissa}{{\times}}10^{{{int(exponent)}}}$".replace(r"1{\times}", "")
