"""The report's panels of the sampled loop's stability, as predicted without the run."""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.control_design.stability import Margins
from ffsm_drake.control_design.stability.margins import AxisMargins
from ffsm_drake.control_design.stability.one_axis import largest_sample_time, largest_stable_k_s
from ffsm_drake.show.chart import Band, Chart, Curve
from ffsm_drake.show.panels import Thinning, View, panels
from ffsm_drake.show.results import Result
from ffsm_drake.show.run_charts import run_curve
from ffsm_drake.show.stability_charts import eta_chart, forecast_chart, radii_of, radius_chart
from ffsm_drake.show.style import NEUTRAL, Style

_MAP_ETA = (0.2, 1.4, 25)  # range and points: the curve is smooth


def stability_views(
    results: Sequence[Result], margins: Sequence[Margins | None], thin: Thinning
) -> list[View]:
    """The panels of the runs that could be assessed; empty where there is none."""
    assessed = {i: margin for i, margin in enumerate(margins) if margin is not None}
    if not assessed:
        return []
    radii = [
        run_curve(
            results, i, y, x=x, name=name, style=Style(results[i].style.color, dash)
        )
        for i, margin in assessed.items()
        for (name, (x, y)), dash in zip(radii_of(margin).items(), ("solid", "dash"), strict=False)
    ]  # fmt: skip
    title = "Spectral radius of the loop as it is wired (dashed: at the largest expected Kₛ)"
    charts = [*_eta_charts(results, assessed), radius_chart(radii, title)]
    for i, margin in assessed.items():
        if margin.axes is not None:
            if margin.axes.has_k_s:
                title = f"Kₛ, expected (dashed) and recorded: {results[i].label}"
                charts.append(forecast_chart(margin, margin.axes, title, result=results[i]))
            charts.append(_map_chart(results[i], margin, margin.axes))
    return [View(label="Stability", panels=panels(charts, thin))]


def _eta_charts(results: Sequence[Result], assessed: dict[int, Margins]) -> list[Chart]:
    """The eigenvalues of H^-1 Hhat: one chart for runs that share them."""
    shared: dict[bytes, tuple[Margins, list[str]]] = {}
    for i, margin in assessed.items():
        shared.setdefault(margin.eta.tobytes(), (margin, []))[1].append(results[i].label)
    title = "Inertia ratios η along the planned motion"
    return [
        eta_chart(margin, f"{title}: {', '.join(labels)}" if len(shared) > 1 else title)
        for margin, labels in shared.values()
    ]


def _map_chart(result: Result, margin: Margins, axes: AxisMargins) -> Chart:
    """Where the coordinate with the least margin is stable: K_s, or without K_s the sample time,
    against eta.
    """
    eta = np.linspace(*_MAP_ETA)
    low, high = float(margin.eta.min()), float(margin.eta.max())
    if axes.has_k_s:
        axis = int(np.nanargmin(axes.k_s_limit / np.maximum(axes.forecast_k_s.max(axis=0), 1e-9)))
        limit = largest_stable_k_s(axes.law, axis, eta=eta, euler=axes.euler)
        used = {
            "Kₛ at the start": axes.k_s[axis],
            "largest expected Kₛ": axes.forecast_k_s[:, axis].max(),
        }
        unit, what = "Kₛ [1/s]", "Kₛ"
    else:
        axis = int(np.nanargmin(axes.sample_time_limit))
        limit = 1e3 * largest_sample_time(axes.law, axis, eta=eta, euler=axes.euler)
        used = {"sample time in use": 1e3 * margin.scenario.sample_time}
        unit, what = "L [ms]", "sample time"
    style, at = Style(result.style.color), np.array([high])
    points = [
        Curve(
            x=at, y=np.array([value]), name=name, style=style, line=False, marker=marker, size=11.0
        )
        for (name, value), marker in zip(used.items(), ("circle", "diamond"), strict=False)
    ]
    finite = limit[np.isfinite(limit)]
    tops = [*used.values(), np.interp(high, eta, np.nan_to_num(limit))]
    if finite.size:
        tops.append(np.median(finite))
    boundary = Curve(x=eta, y=limit, style=style, name="stability limit", width=2.0, filled=True)
    return Chart(
        title=f"Stable below the curve, {what} of "
        f"{margin.coordinates.names[axis].replace('_', ' ')}: {result.label}",
        x="inertia ratio η; shaded: met along the motion", y=unit, kind="map", legend=True,
        curves=[boundary, *points], bands=[Band(spans=np.array([[low, high]]), color=NEUTRAL)],
        range=(0.0, 1.3 * float(max(tops))),
    )  # fmt: skip
