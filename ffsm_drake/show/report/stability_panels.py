"""The report's panels of the sampled loop's stability, as predicted without the run."""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.control_design.stability import Margins
from ffsm_drake.control_design.stability.linear_loop import LinearLoop
from ffsm_drake.control_design.stability.one_axis import largest_sample_time, largest_stable_k_s
from ffsm_drake.show.panels import Panel, Thinning, Trace, View, curve, figure, time_panel
from ffsm_drake.show.report.results import Result, values_of
from ffsm_drake.show.report.time_panels import run_curve
from ffsm_drake.show.style import GROUP_STYLES, NEUTRAL, Style

_MAP_ETA = (0.2, 1.4, 25)  # range and points: the curve is smooth
_BAND = "rgba(128, 136, 146, 0.2)"


def stability_views(
    results: Sequence[Result], margins: Sequence[Margins | None], thin: Thinning
) -> list[View]:
    """The panels of the runs that could be assessed; empty where there is none."""
    assessed = [(i, margin) for i, margin in enumerate(margins) if margin is not None]
    if not assessed:
        return []
    radius = []
    for i, margin in assessed:
        radius.append(run_curve(results, i, thin(*_radii(margin.loops)), name="starting gains"))
        if margin.loops_expected is not margin.loops:
            style = Style(results[i].style.color, "dash")
            expected = thin(*_radii(margin.loops_expected))
            radius.append(run_curve(results, i, expected, name="largest expected Kₛ", style=style))
    title = "Spectral radius of the loop as it is wired (dashed: at the largest expected Kₛ)"
    panels = [
        *_eta_panels(results, assessed, thin),
        time_panel(title, "1", radius, level=(1.0, "limit 1")),
    ]
    for i, margin in assessed:
        if margin.axes is None:
            continue
        if margin.axes.has_k_s:
            panels.append(_forecast_panel(results[i], margin, thin))
        panels.append(_map_panel(results, i, margin))
    return [View(label="Stability", panels=panels)]


def _radii(loops: Sequence[LinearLoop]) -> tuple[np.ndarray, np.ndarray]:
    """Times (m,) in s and spectral radii (m,)."""
    return np.array([loop.time for loop in loops]), np.array(
        [loop.spectral_radius for loop in loops]
    )


def _eta_panels(
    results: Sequence[Result], assessed: Sequence[tuple[int, Margins]], thin: Thinning
) -> list[Panel]:
    """The eigenvalues of H^-1 Hhat: one panel for runs that share them."""
    shared: dict[bytes, tuple[Margins, list[str]]] = {}
    for i, margin in assessed:
        shared.setdefault(margin.eta.tobytes(), (margin, []))[1].append(results[i].label)
    return [
        time_panel(
            "Inertia ratios η along the planned motion"
            + (f": {', '.join(labels)}" if len(shared) > 1 else ""),
            "1",
            [
                curve(thin(margin.times, column), Style(NEUTRAL), name=f"eigenvalue {k}", width=1.2)
                for k, column in enumerate(margin.eta.T, start=1)
            ],
            level=(1.0, "nominal = true"),
        )
        for margin, labels in shared.values()
    ]


def _forecast_panel(result: Result, margin: Margins, thin: Thinning) -> Panel:
    """Of each group, the coordinate whose K_s is expected to come highest: as expected and as
    recorded.
    """
    assert margin.axes is not None
    traces: list[Trace] = []
    recorded = values_of(result.record, "reaching_gain")
    names = result.record.dataset["coordinate"].values.astype(str).tolist()
    for group, part in margin.coordinates.groups.items():
        forecast = margin.axes.forecast_k_s[:, part]
        if not forecast.shape[1]:
            continue
        k = part.start + int(forecast.max(axis=0).argmax())
        name, color = margin.coordinates.names[k], GROUP_STYLES[group].color
        expected = thin(margin.axes.forecast_times, margin.axes.forecast_k_s[:, k])
        traces.append(curve(expected, Style(color, "dash"), name=f"{name}, expected"))
        if recorded is not None and name in names:
            measured = thin(result.record.dataset["time"].values, recorded[:, names.index(name)])
            traces.append(curve(measured, Style(color), name=f"{name}, recorded"))
    limit = float(np.nanmin(margin.axes.k_s_limit))
    highest = [float(margin.axes.forecast_k_s.max())]
    if recorded is not None and np.isfinite(recorded).any():
        highest.append(min(float(recorded[np.isfinite(recorded)].max()), 2.0 * limit))
    return time_panel(
        f"Kₛ, expected (dashed) and recorded: {result.label}",
        "1/s",
        traces,
        level=(limit, "limit"),
        legend=True,
        range=[0.0, 1.15 * max(limit, *highest)],
    )


def _map_panel(results: Sequence[Result], i: int, margin: Margins) -> Panel:
    """Where the coordinate with the least margin is stable: K_s, or without K_s the sample time,
    against eta.
    """
    eta = np.linspace(*_MAP_ETA)
    low, high = float(margin.eta.min()), float(margin.eta.max())
    axes = margin.axes
    assert axes is not None
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
    color = results[i].style.color
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    fill = {"fill": "tozeroy", "fillcolor": f"rgba({red}, {green}, {blue}, 0.11)"}
    traces: list[Trace] = [
        curve((eta, limit), Style(color), name="stability limit", width=2, **fill)
    ]
    for (name, value), symbol in zip(used.items(), ("circle", "diamond"), strict=False):
        place = {
            "x": [high],
            "y": [float(value)],
            "marker": {"color": color, "size": 11, "symbol": symbol},
        }
        traces.append({"type": "scatter", "name": name, "mode": "markers", **place})
    finite = limit[np.isfinite(limit)]
    tops = [
        *used.values(),
        np.interp(high, eta, np.nan_to_num(limit)),
        *([np.median(finite)] if finite.size else []),
    ]
    band = {
        "type": "rect",
        "yref": "paper",
        "y0": 0,
        "y1": 1,
        "x0": low,
        "x1": high,
        "layer": "below",
        "fillcolor": _BAND,
        "line": {"width": 0},
    }
    name = margin.coordinates.names[axis].replace("_", " ")
    axis_title, height = (
        "inertia ratio η; shaded: met along the motion",
        {"range": [0.0, 1.3 * float(max(tops))]},
    )
    shown = figure(traces, x=axis_title, y=unit, showlegend=True, shapes=[band], yaxis=height)
    return Panel(
        title=f"Stable below the curve, {what} of {name}: {results[i].label}",
        kind="map",
        figure=shown,
    )
