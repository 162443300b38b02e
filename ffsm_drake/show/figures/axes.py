"""What the Matplotlib figures share: the look of their panels."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from ffsm_drake.show.style import GRID

LARGEST = 1e100  # of what is drawn: axes have no ticks where numbers end


def tidy(axes: Axes) -> None:
    """The look that all panels share."""
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)


def legend_below(figure: Figure | SubFigure, axes: Axes, *, columns: int = 3) -> None:
    """The panel's legend below it, where it hides no curve."""
    figure.legend(
        *axes.get_legend_handles_labels(),
        fontsize=8,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
    )


def plain(text: object) -> str:
    """A user's text for a label of Matplotlib's, which takes what stands between dollar signs for
    mathematics.
    """
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
