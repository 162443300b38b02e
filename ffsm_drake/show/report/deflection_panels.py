"""The report's panels of hidden coordinates: how far each is deflected, and the energy of their
springs.
"""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.show.panels import Panel, Thinning, Trace, View, time_panel
from ffsm_drake.show.report.results import Result
from ffsm_drake.show.report.time_panels import run_curve


def deflection_views(results: Sequence[Result], thin: Thinning) -> list[View]:
    """Views of the hidden coordinates of the runs; none for runs without."""
    having = [i for i, result in enumerate(results) if "hidden_position" in result.record.dataset]
    if not having:
        return []
    units: dict[str, str] = {}
    for i in having:
        hidden = results[i].record.dataset["hidden_coordinate"]
        units |= dict(
            zip(
                hidden.values.astype(str).tolist(),
                hidden["hidden_unit"].values.astype(str).tolist(),
                strict=True,
            )
        )
    views = []
    for variable, label, suffix in (
        ("hidden_position", "Deflection", ""),
        ("hidden_velocity", "Rate", "/s"),
    ):
        panels = [
            _panel(results, having, thin, variable, name, f"{unit}{suffix}")
            for name, unit in units.items()
        ]
        views.append(View(label=label, panels=panels))
    energies = [
        _curve(results, i, thin, results[i].record.dataset["elastic_energy"].values) for i in having
    ]
    energy = time_panel("Energy of the springs", "J", energies)
    return [*views, View(label="Energy", panels=[energy])]


def _panel(
    results: Sequence[Result],
    having: Sequence[int],
    thin: Thinning,
    variable: str,
    name: str,
    unit: str,
) -> Panel:
    traces = []
    for i in having:
        data = results[i].record.dataset[variable]
        if name in data["hidden_coordinate"].values:
            traces.append(_curve(results, i, thin, data.sel(hidden_coordinate=name).values))
    return time_panel(name.replace("_", " "), unit, traces)


def _curve(results: Sequence[Result], i: int, thin: Thinning, values: np.ndarray) -> Trace:
    return run_curve(results, i, thin(results[i].record.dataset["time"].values, values))
