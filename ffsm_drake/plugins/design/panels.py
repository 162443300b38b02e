"""The report's panels of the sampled loop's stability, as predicted without the run."""

import dataclasses
from collections.abc import Sequence

from ffsm_drake.plugins.design.charts import (
    eta_chart,
    forecast_chart,
    map_chart,
    radii_of,
    radius_chart,
)
from ffsm_drake.plugins.design.stability import Margins
from ffsm_drake.show.chart import Chart
from ffsm_drake.show.panels import Thinning, View, panels
from ffsm_drake.show.results import Result
from ffsm_drake.show.run_charts import run_curve
from ffsm_drake.show.style import Style


def stability_views(
    results: Sequence[Result], margins: Sequence[Margins | None], thin: Thinning
) -> list[View]:
    """The panels of the runs that could be assessed; empty if there is none."""
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
    title = "Spectral radius of the wired loop (dashed: at the largest expected Kₛ)"
    charts = [*_eta_charts(results, assessed), radius_chart(radii, title)]
    for i, margin in assessed.items():
        if margin.axes is not None:
            if margin.axes.has_k_s:
                title = f"Kₛ, expected (dashed) and recorded: {results[i].label}"
                charts.append(forecast_chart(margin, margin.axes, title, result=results[i]))
            chart = map_chart(margin, margin.axes, Style(results[i].style.color))
            charts.append(dataclasses.replace(chart, title=f"{chart.title}: {results[i].label}"))
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
