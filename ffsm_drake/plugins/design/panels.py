"""The report's section on the sampled loop's stability, as predicted without the run."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from ffsm_drake.common.numbers import NONE, number
from ffsm_drake.plugins.design.charts import (
    eta_chart,
    forecast_chart,
    map_chart,
    radii_of,
    radius_chart,
)
from ffsm_drake.plugins.design.stability import Margins, stability
from ffsm_drake.plugins.design.stability.linear_loop import radius_digits
from ffsm_drake.plugins.design.tables import margins_data
from ffsm_drake.show.chart import Chart, View
from ffsm_drake.show.page import Section, render
from ffsm_drake.show.results import Result, attempt
from ffsm_drake.show.run_charts import run_curve
from ffsm_drake.show.style import Style


def stability_section(results: Sequence[Result]) -> Section:
    """The margins of every run, or why there are none."""
    found = [attempt("stability", result, stability, result.record.mission) for result in results]
    views = _views(results, [margins for margins, _ in found])
    told = [_told(result, *margins) for result, margins in zip(results, found, strict=True)]
    content = {"stability": told, "shown": views}
    html = render("stability.html.j2", content, package="ffsm_drake.plugins.design")
    return Section(html=html, views=views)


def _views(results: Sequence[Result], margins: Sequence[Margins | None]) -> list[View]:
    """The charts of the runs that could be assessed; empty if there is none."""
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
    return [View(label="Stability", charts=charts)]


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


def _told(result: Result, margins: Margins | None, problem: str) -> dict[str, Any]:
    """The run's line of the stability table and its limits by coordinate, or why there are none."""
    if margins is None:
        excuse = f"{result.label}: the stability of the loop is not available: {problem}."
        return {"result": result, "excuse": excuse, "limits": {}}
    axes, data = margins.axes, margins_data(margins)
    adapts = axes is not None and axes.has_k_s
    items = data["coordinates"]
    limits = [item["k_s_limit"] for item in items.values() if math.isfinite(item["k_s_limit"])]
    highest = [item["k_s_expected"] for item in items.values()]
    period = f"{1e3 * margins.scenario.sample_time:.3g}"
    longest = NONE if axes is None else f"{1e3 * axes.sample_time_limit.min():.3g}"
    expected = max(loop.spectral_radius for loop in margins.loops_expected)
    return {
        "result": result,
        "excuse": "",
        "cells": [
            _span(*data["eta"]),
            radius_digits(data["spectral_radius"]),
            radius_digits(expected) if adapts else NONE,
            f"{max(highest):.3g} / {min(limits):.3g}" if adapts else NONE,
            f"{period} / {longest}",
        ],
        "tone": "bad"
        if not margins.is_stable
        else "good"
        if margins.verdict == "stable for small errors"
        else "warn",
        "verdict": margins.verdict,
        "limits": {
            name: [
                *(
                    number(item[f"k_s_{key}"]) if adapts else NONE
                    for key in ("start", "expected", "bound", "limit")
                ),
                number(1e3 * item["sample_time_limit"]),
                _span(*item["eta_tolerated"]),
            ]
            for name, item in items.items()
        },
    }


def _span(low: float, high: float) -> str:
    return f"{number(low, 3)} to {number(high, 3)}"
