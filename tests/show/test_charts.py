"""Charts: Plotly and Matplotlib draw the same from one description."""

import html
import itertools

import numpy as np
import pytest

from ffsm_drake.show.chart import Band, Chart, Curve, Level
from ffsm_drake.show.figures.axes import plot_charts
from ffsm_drake.show.panels import panel_data
from ffsm_drake.show.style import SERIES, Style


def drawn_chart(rng):
    """A chart of any kind of curves, levels and bands, with names as users give them."""

    def curve(name):
        size = int(rng.integers(1, 400))
        line = bool(rng.random() < 0.7)
        return Curve(
            np.sort(rng.uniform(0.1, 9.0, size)), rng.lognormal(size=size),
            Style(rng.choice(SERIES)), name, line=line, steps=bool(rng.random() < 0.5),
            marker="" if line else str(rng.choice(["circle", "x"])),
        )  # fmt: skip

    low, high = np.sort(rng.uniform(0.2, 8.0, 2))
    return Chart(
        title="a $title$ <b>", y="N m", what="torque", log_y="~e" * int(rng.integers(2)),
        curves=[curve(f"<i>${k}$") for k in range(rng.integers(1, 5))],
        levels=[Level(each, "a & b", axis=axis) for axis, each in (("x", low), ("y", high))],
        bands=[Band(np.array([[low, high]]), "#112233", axis=str(rng.choice(["x", "y"])))],
        range=(float(low), float(high)), legend="inside",
    )  # fmt: skip


@pytest.mark.smoke
@pytest.mark.parametrize("seed", range(6))
def test_both_libraries_draw_the_same_chart(seed):
    chart = drawn_chart(np.random.default_rng(seed))
    page = panel_data(chart, 50)
    (axes,) = plot_charts([[chart]], "figure", columns=1, size=(4.0, 3.0)).axes
    lines = axes.lines[: len(chart.curves)]
    for curve, trace, line in zip(chart.curves, page["data"], lines, strict=True):
        assert html.unescape(trace["name"]) == curve.name
        assert line.get_label().replace("\\$", "$") == curve.name
        look = trace["line" if curve.line else "marker"]
        assert look["color"] == line.get_color() == curve.style.color
        assert ("lines" in trace["mode"]) == (curve.line and curve.x.size > 1)
        np.testing.assert_array_equal(line.get_xydata(), np.stack([curve.x, curve.y], axis=1))
    layout = page["layout"]
    extent = np.array(layout["yaxis"]["range"], dtype=float)
    assert (10.0**extent if chart.log_y else extent) == pytest.approx(axes.get_ylim())
    assert (layout["yaxis"].get("type") == "log") == (axes.get_yscale() == "log")
    assert len(layout["shapes"]) == len(chart.levels) + len(chart.bands) == 3
    assert len(axes.patches) == len(chart.bands)
    assert len(axes.lines) == len(chart.curves) + len(chart.levels)
    assert layout["showlegend"]
    assert len(axes.get_legend().get_texts()) == len(chart.curves)


@pytest.mark.parametrize("seed", range(6))
def test_labels_of_a_logarithmic_axis_stand_apart(seed):
    """However few decades it spans; in a panel as small as those of the tracking errors."""
    rng = np.random.default_rng(seed)
    low = 10.0 ** rng.uniform(-9.0, 3.0)
    values = np.geomspace(low, low * 10.0 ** rng.uniform(0.3, 5.0), 50)
    chart = Chart(title="rms", log_y="e", curves=[Curve(np.arange(50.0), values, Style(SERIES[0]))])
    figure = plot_charts([[chart, chart]], "figure", columns=1, size=(4.0, 3.7), heights=(1.5, 1.0))
    figure.draw_without_rendering()
    axis = figure.axes[1].yaxis
    labels = [*axis.get_majorticklabels(), *axis.get_minorticklabels()]
    boxes = [each.get_window_extent() for each in labels if each.get_text() and each.get_visible()]
    bottom, top = figure.axes[1].get_window_extent().intervaly
    spans = sorted(
        tuple(each.intervaly) for each in boxes if bottom <= each.y0 + each.height / 2 <= top
    )
    assert len(spans) >= 2
    assert all(low[1] <= high[0] for low, high in itertools.pairwise(spans))
