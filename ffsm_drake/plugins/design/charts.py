"""Charts of a sampled loop's stability, as predicted without a run. The report and the figure of
``ffsm stability`` draw them.
"""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop
from ffsm_drake.plugins.design.stability.margins import AxisMargins, Margins
from ffsm_drake.plugins.design.stability.one_axis import largest_sample_time, largest_stable_k_s
from ffsm_drake.show.chart import DASHES, Band, Chart, Curve, Level
from ffsm_drake.show.results import Result, values_of
from ffsm_drake.show.style import GROUP_STYLES, GROUP_TITLES, NEUTRAL, Style

_MAP_ETA = (0.2, 1.4)  # least range; a larger eta met widens it


def eta_chart(margins: Margins, title: str) -> Chart:
    """The eigenvalues of H^-1 Hhat along the motion."""
    return Chart(
        title=title, y="1", levels=[Level(1.0, "nominal = true")],
        curves=[
            Curve(
                margins.times, column, Style(NEUTRAL), f"eigenvalue {k}", width=1.2
            )
            for k, column in enumerate(margins.eta.T, start=1)
        ],
    )  # fmt: skip


def radius_chart(curves: Sequence[Curve], title: str) -> Chart:
    """Spectral radii of the loop, below 1 where it is stable."""
    largest = max(float(curve.y.max()) for curve in curves)
    return Chart(
        title=title, y="1", curves=curves, levels=[Level(1.0, "limit 1")],
        range=None if largest < 2.0 else (0.0, 2.0),
    )  # fmt: skip


def radii_of(margins: Margins) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Times (m,) in s and spectral radii (m,), by the gains at which the loop is linearized."""
    loops = {"starting gains": margins.loops}
    if margins.loops_expected is not margins.loops:
        loops["largest expected Kₛ"] = margins.loops_expected
    return {name: _radii(each) for name, each in loops.items()}


def _radii(loops: Sequence[LinearLoop]) -> tuple[np.ndarray, np.ndarray]:
    times, radii = zip(*((loop.time, loop.spectral_radius) for loop in loops), strict=True)
    return np.array(times), np.array(radii)


def forecast_chart(
    margins: Margins, axes: AxisMargins, title: str, *, result: Result | None = None
) -> Chart:
    """Expected K_s of every coordinate; or for each group K_s of the coordinate with the highest
    one, with the values recorded in a run.
    """
    recorded = None if result is None else values_of(result.record, "reaching_gain")
    names = [] if result is None else list(result.units)
    forecast, curves = axes.forecast_k_s, []
    for group, part in margins.coordinates.groups.items():
        members, color = list(range(*part.indices(forecast.shape[1]))), GROUP_STYLES[group].color
        if result is not None and members:
            members = [max(members, key=lambda k: forecast[:, k].max())]
        for place, k in enumerate(members):
            name, dash = margins.coordinates.names[k], DASHES[place % len(DASHES)]
            if result is None:
                label = "" if place else GROUP_TITLES[group]
            else:
                label, dash = f"{name}, expected", "dash"
            curves.append(Curve(axes.forecast_times, forecast[:, k], Style(color, dash), label))
            if result is not None and recorded is not None and name in names:
                values = recorded[:, names.index(name)]
                curves.append(Curve(result.time, values, Style(color), f"{name}, recorded"))
    limit, bound = float(np.nanmin(axes.k_s_limit)), float(axes.k_s_max.max())
    highest = [limit, float(forecast.max())]
    if recorded is not None and np.isfinite(recorded).any():
        highest.append(min(float(recorded[np.isfinite(recorded)].max()), 2.0 * limit))
    top, levels = 1.15 * max(highest), [Level(limit, "limit")]
    if (axes.k_s_max > axes.k_s).any() and bound < top:
        levels.append(Level(bound, "k_s_max", style=Style(NEUTRAL, "dash")))
    return Chart(
        title=title, y="1/s", curves=curves, levels=levels, legend="inside", range=(0.0, top)
    )


def weakest(axes: AxisMargins) -> int:
    """The coordinate with the least margin."""
    if not axes.has_k_s:
        return int(np.argmin(axes.sample_time_limit))
    return int(np.nanargmin(axes.k_s_limit / np.maximum(axes.forecast_k_s.max(axis=0), 1e-9)))


def map_chart(margins: Margins, axes: AxisMargins, style: Style) -> Chart:
    """Stable region of the coordinate with the least margin: K_s, or without K_s the sample time,
    against eta.
    """
    low, high = float(margins.eta.min()), float(margins.eta.max())
    axis = weakest(axes)
    eta = np.linspace(_MAP_ETA[0], max(_MAP_ETA[1], 1.1 * high), 25)  # the curve is smooth
    if axes.has_k_s:
        limit = largest_stable_k_s(axes.law, axis, eta=eta, euler=axes.euler)
        used = {
            "Kₛ at the start": axes.k_s[axis],
            "largest expected Kₛ": axes.forecast_k_s[:, axis].max(),
        }
        unit, what = "Kₛ [1/s]", "Kₛ"
    else:
        limit = 1e3 * largest_sample_time(axes.law, axis, eta=eta, euler=axes.euler)
        used = {"sample time in use": 1e3 * margins.scenario.sample_time}
        unit, what = "sample time L [ms]", "sample time"
    at = np.array([high])
    points = [
        Curve(at, np.array([value]), name=name, style=style, line=False, marker=marker, size=11.0)
        for (name, value), marker in zip(used.items(), ("circle", "diamond"), strict=False)
    ]
    finite = limit[np.isfinite(limit)]
    tops = [*used.values(), np.interp(high, eta, np.nan_to_num(limit))]
    if finite.size:
        tops.append(np.median(finite))
    boundary = Curve(eta, limit, style, "stability limit", width=2.0, filled="tozeroy")
    return Chart(
        title=f"Stable below the curve, {what} of "
        f"{margins.coordinates.names[axis].replace('_', ' ')}",
        x="inertia ratio η; shaded: met along the motion", y=unit, kind="map", legend="inside",
        curves=[boundary, *points], bands=[Band(np.array([[low, high]]), NEUTRAL)],
        range=(0.0, 1.3 * float(max(tops))),
    )  # fmt: skip
