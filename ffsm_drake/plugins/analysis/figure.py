"""One page of an analysis: the quantities of the proof over time, with their bounds."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.analysis.findings import Analysis
from ffsm_drake.show.chart import Band, Chart, Curve, Level
from ffsm_drake.show.figures.axes import plot_charts
from ffsm_drake.show.style import (
    BAD,
    BLACK,
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
    Style,
)

_VERDICT_COLORS = {"does not hold": BAD, "holds": GOOD, "not tested": MUTE, "not applicable": MUTE}
_BOUND, _LATE = Style(BLACK, "dash"), Style(MUTE, "dot")
# Noisy magnitudes are drawn as the maximum of each time interval: comparable with bounds, and
# legible.
_INTERVALS = 200


@dataclasses.dataclass(frozen=True)
class _Panel:
    title: str
    needed: str  # a variable of the analysis
    verdicts: dict[str, str]  # finding -> its name in the panel
    charts: Callable[[Analysis], list[Chart]]  # from top to bottom


def plot_analysis(analysis: Analysis) -> Figure:
    """Six panels: TDE error, condition (8), sliding variable, Lyapunov function, gains, spectrum.

    The verdicts of a panel's findings are at the right of its title; an inapplicable panel gives
    its reason.
    """
    attributes = analysis.series.attrs
    figure = plot_charts(
        [_stack(panel, analysis) for panel in _PANELS], "The paper's claims on this run",
        f"{attributes['title']}. Controller {attributes['controller']}; {attributes['outcome']}",
        columns=2, size=(13.0, 12.5), heights=(1.0, 1.6),
    )  # fmt: skip
    for part, panel in zip(figure.subfigs, _PANELS, strict=True):
        if panel.needed in analysis.series:
            text, color = _verdicts(panel, analysis)
            part.axes[0].set_title(text, fontsize=9, loc="right", color=color)
    return figure


def _stack(panel: _Panel, analysis: Analysis) -> list[Chart]:
    """The charts of a panel, with the legend of the lowest, or why it does not apply."""
    if panel.needed in analysis.series:
        *upper, last = panel.charts(analysis)
        charts = [*upper, dataclasses.replace(last, legend="below")]
    else:
        reason = analysis.finding(next(iter(panel.verdicts))).statement
        charts = [Chart(title="", curves=[], note=reason)]
    return [dataclasses.replace(charts[0], title=panel.title), *charts[1:]]


def _verdicts(panel: _Panel, analysis: Analysis) -> tuple[str, str]:
    """The verdicts of a panel's findings, and the colour of the least favourable one."""
    names = {verdict: list[str]() for verdict in _VERDICT_COLORS}
    for key, name in panel.verdicts.items():
        names.get(analysis.finding(key).verdict, []).append(name)
    found = {verdict: ", ".join(each) for verdict, each in names.items() if each}
    text = "; ".join(f"{verdict}: {each}" for verdict, each in found.items())
    return text, _VERDICT_COLORS[next(iter(found), "not tested")]


def _tde_error(analysis: Analysis) -> list[Chart]:
    return [
        Chart(
            title="", y="largest |Ñᵢ| [rad/s², m/s²]", log_y="~e",
            curves=_largest(analysis, "tde_error", "period"),
            levels=[
                *_bounds(analysis, "tde_error_bound_late", "N*, without start-up by group"),
                *_error_bounds(analysis, 0.3),
            ],
        )
    ]  # fmt: skip


def _match(analysis: Analysis) -> list[Chart]:
    series = analysis.series
    eta, condition = series["eta"].values, series["condition_8"].values

    def curve(y: np.ndarray, name: str, style: Style, width: float = 1.8) -> Curve:
        few = "dot" if y.size < 5 else ""
        x = series["posture_time"].values
        return Curve(x, y, name=name, style=style, width=width, marker=few)

    return [
        Chart(
            title="", y="eigenvalue, norm",
            curves=[
                *(
                    curve(y, "" if k else "eigenvalues η of H⁻¹Ĥ", Style(SKY), 1.0)
                    for k, y in enumerate(eta.T)
                ),
                curve(condition, "‖E - H⁻¹Ĥ‖₂ of (8), in m and rad", Style(VERMILION)),
                curve(
                    series["condition_8_in_h"].values, "the same in the metric of H: max |1 - η|",
                    Style(GREEN, "longdash"),
                ),
            ],
            levels=[
                Level(1.0, name="limit of (8); η for the true payload", style=_BOUND)
            ],
            range=(0.0, 1.05 * max(1.05, float(eta.max()), float(condition.max()))),
        )
    ]  # fmt: skip


def _sliding_variable(analysis: Analysis) -> list[Chart]:
    levels: list[Level] = []
    if "direct_bound" in analysis.series:
        levels += _bounds(analysis, "direct_bound", "bound from (7), by group")
    for key, number, text, style in (
        ("ultimate_bound", "ultimate_bound", "(16): ‖s‖₂ ≤ ", _BOUND),
        ("lyapunov_derivative", "epsilon", "ε = ", Style(BLACK, "dot")),
    ):
        value = analysis.finding(key).numbers.get(number)
        if isinstance(value, float) and np.isfinite(value):
            levels.append(Level(value, f"{text}{value:.3g}", style=style))
    curves = _largest(analysis, "sliding_variable", "time")
    label = "largest |sᵢ| [rad/s, m/s]"
    return [Chart(title="", y=label, curves=curves, levels=levels, log_y="~e")]


def _lyapunov(analysis: Analysis) -> list[Chart]:
    series = analysis.series
    time, rate = series["period"].values, series["lyapunov_rate"].values
    outside, size = series["outside"].values[:-1] > 0, np.abs(rate)
    points = [
        Curve(
            time[chosen], np.where(rate[chosen] != 0.0, size[chosen], np.nan),
            name=f"{sign}, {name}: {counted(int(chosen.sum()), 'sample')}", style=Style(color),
            line=False, marker=marker, size=5.5 if name == "outside" else 3.0,
            opacity=1.0 if name == "outside" else 0.4,
        )
        for name, where in (("inside", ~outside), ("outside", outside))
        for color, marker, sign, picked in (
            (VERMILION, "circle", "dV/dt > 0", rate > 0.0),
            (BLUE, "square", "dV/dt ≤ 0", rate <= 0.0),
        )
        for chosen in (picked & where,)
    ]  # fmt: skip
    # Each sample outside is as wide as its period but never too narrow to be seen.
    width = max(float(series.attrs["sample_time"]), 0.003 * float(time[-1] - time[0]))
    name = "outside is some |sᵢ| > max(Kₛᵢ/βᵢ, ε)"
    spans = np.stack([time[outside], time[outside] + width], axis=1)
    band = Band(spans, "#F7DFB0", opacity=1.0, name=name)
    value = Curve(series["time"].values, series["lyapunov"].values, Style(BLACK))
    return [
        Chart(title="", x="", y="V of (12)", curves=[value], bands=[band]),
        Chart(title="", y="|dV/dt| of (13) [1/s]", curves=points, bands=[band], log_y="~e"),
    ]


def _gains(analysis: Analysis) -> list[Chart]:
    series, time, curves = analysis.series, analysis.series["time"].values, []
    if "scaled_sliding_variable" in series:
        x, y = _interval_maxima(time, series["scaled_sliding_variable"].values)
        name = "premise: max βᵢ · max |sᵢ|"
        curves.append(Curve(x, y, Style(PURPLE), width=0.9, name=name))
    for variable, label, color in (
        ("reaching_gain", "Kₛᵢ", VERMILION),
        ("switching_gain", "Gᵢ", BLUE),
    ):
        values = np.where(series[variable].values > 0.0, series[variable].values, np.nan)
        if np.isnan(values).all():
            continue
        for k, y in enumerate(values.T):
            name = "" if k else f"{label}, every coordinate"
            curves.append(Curve(time, y, Style(color), width=0.9, name=name))
    levels, label = _error_bounds(analysis, 0.05), "gain [1/s; rad/s², m/s²]"
    return [Chart(title="", y=label, curves=curves, levels=list(levels), log_y="~e")]


def _spectrum(analysis: Analysis) -> list[Chart]:
    series, group = analysis.series, analysis.series["group"].values
    numbers = analysis.finding("chattering").numbers
    # The zero frequency was removed with the trend.
    frequency, density = series["frequency"].values[1:], series["effort_spectrum"].values[1:]
    split = float(series.attrs["split_frequency"])
    return [
        Chart(
            title="", x="frequency [Hz]", y="power density [(N m)²/Hz, N²/Hz]",
            log_x="~e", log_y="~e",
            curves=[
                Curve(
                    frequency, density[:, group == key].sum(axis=1), GROUP_STYLES[key],
                    f"{GROUP_TITLES[key]}: {100.0 * float(numbers[f'share.{key}']):.3g} % of "
                    "its variance is shaded, "
                    f"{numbers[f'reversals_per_second.{key}']:.0f} reversals/s",
                )
                for key in _groups(analysis)
                if f"share.{key}" in numbers
            ],
            levels=[Level(split, f"from {split:g} Hz on", axis="x", style=_BOUND)],
            bands=[Band(np.array([[split, frequency[-1]]]), ORANGE, opacity=0.12)],
        )
    ]  # fmt: skip


_PANELS = (
    _Panel("TDE error and its bound N*", "tde_error", {"tde_error_bound": "N*"}, _tde_error),
    _Panel("Match of inertias", "eta", {"condition_8": "condition (8)"}, _match),
    _Panel(
        "Sliding variable",
        "sliding_variable",
        {"direct_bound": "bound from (7)", "ultimate_bound": "(16)"},
        _sliding_variable,
    ),
    _Panel(
        "Lyapunov function", "lyapunov", {"lyapunov_derivative": "dV/dt ≤ 0 outside"}, _lyapunov
    ),
    _Panel(
        "Gains against N*",
        "reaching_gain",
        {
            "lemma_1_premise": "β‖s‖ < N*",
            "lemma_1_conclusion": "Kₛ < N*",
            "switching_gain_bound": "G ≤ N*",
        },
        _gains,
    ),
    _Panel(
        "Spectrum of the control force", "effort_spectrum", {"chattering": "chattering"}, _spectrum
    ),
)


def _interval_maxima(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maxima of at most _INTERVALS intervals, at the intervals' first times; zero becomes NaN."""
    starts = np.unique(np.linspace(0, len(values), _INTERVALS, endpoint=False, dtype=int))
    most = np.maximum.reduceat(values, starts)
    return time[starts], np.where(most > 0.0, most, np.nan)


def _groups(analysis: Analysis) -> list[str]:
    """Return the driven groups that have coordinates."""
    driven = analysis.series["group"].values[analysis.series["driven"].values]
    return [name for name in GROUP_TITLES if name in driven]


def _largest(analysis: Analysis, name: str, time: str) -> list[Curve]:
    """Return the largest magnitude of every group's coordinates over time."""
    series, curves = analysis.series, []
    for key in _groups(analysis):
        sizes = np.abs(series[name].values[:, series["group"].values == key]).max(axis=1)
        x, y = _interval_maxima(series[time].values, sizes)
        few: dict[str, Any] = {"marker": "dot" if len(x) < 20 else "", "width": 1.1}
        curves.append(Curve(x, y, GROUP_STYLES[key], GROUP_TITLES[key], **few))
    return curves


def _bounds(analysis: Analysis, name: str, label: str) -> Iterator[Level]:
    """The largest bound of every group's coordinates, if there is one; in the legend in grey."""
    bounds, group = analysis.series[name].values, analysis.series["group"].values
    for key in _groups(analysis):
        value = float(bounds[group == key].max())
        if np.isfinite(value) and value > 0.0:
            if label:
                yield Level(value, name=label, style=Style(MUTE, "dash"))
            label = ""
            yield Level(value, style=Style(GROUP_STYLES[key].color, "dash"))


def _error_bounds(analysis: Analysis, near: float) -> Iterator[Level]:
    """N*, and N* without the start-up; from the share ``near`` of N* on, the text of the second is
    below its line.
    """
    series = analysis.series
    bound, late = (
        float(series[name].max()) for name in ("tde_error_bound", "tde_error_bound_late")
    )
    yield Level(bound, f"N* = {bound:.3g}", style=_BOUND)
    if np.isfinite(late):
        text = f"{late:.3g} without the first {series.attrs['start_up_time']:g} s"
        yield Level(late, text, style=_LATE, below=late > near * bound)
