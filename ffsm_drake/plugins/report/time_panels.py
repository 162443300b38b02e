"""The report's views of the runs themselves: motion, end effector, errors, forces, sliding variable
and gains.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.show.chart import Chart
from ffsm_drake.show.panels import Panel, Thinning, Trace, View, escape, figure, panel, panels
from ffsm_drake.show.results import HELD, Result, actuators_act, values_of
from ffsm_drake.show.run_charts import (
    attitude_charts,
    coordinate_charts,
    frame_charts,
    position_charts,
    rms_charts,
    run_curve,
)
from ffsm_drake.show.style import NEUTRAL
from ffsm_drake.systems.controllers.sampled import OPTIONAL_OUTPUTS, SIGNALS

# Points that all curves of a page may have together, and bounds on those of one curve: enough for
# zooming in.
BUDGET = 800_000
FEWEST_POINTS, MOST_POINTS = 400, 4000
_VARIABLES = (
    "error",
    *HELD,
    "disturbance_force",
    *OPTIONAL_OUTPUTS,
    "position",
    "desired_position",
)


def points_per_curve(results: Sequence[Result]) -> int:
    """Largest number of points of each curve of these runs."""
    curves = sum(
        result.record.dataset.sizes.get("coordinate", 0)
        for result in results
        for name in _VARIABLES
        if name in result.record.dataset
    )
    return int(np.clip(BUDGET // max(curves, 1), FEWEST_POINTS, MOST_POINTS))


def run_views(results: Sequence[Result], thin: Thinning) -> dict[str, list[View]]:
    """Section -> views of the runs over time and in space; only what the records hold."""

    def each(variable: str, unit: str) -> list[Panel]:
        return panels(coordinate_charts(results, variable, unit), thin)

    errors = {
        "Error": each("error", "{unit}"),
        "rms of the error over 1 s, logarithmic": panels(rms_charts(results), thin),
    }
    if len(results) > 1:  # their errors differ by orders of magnitude
        errors = dict(reversed(errors.items()))
    applied = each("applied_force", "{effort}") if actuators_act(results) else []
    sections: dict[str, dict[str, list[Panel]]] = {
        "motion": {
            "Base attitude": panels(attitude_charts(results), thin),
            "Base position and joints": panels(position_charts(results), thin),
        },
        "end_effector": {"End effector": _end_effector_panels(results, thin)},
        "error": {"Frame": panels(frame_charts(results), thin), **errors},
        "force": {
            "Control": each("generalized_force", "{effort}"),
            "Applied by the actuators": applied,
            "Disturbance": each("disturbance_force", "{effort}"),
        },
        "sliding": {},
    }
    for signal in SIGNALS:
        heading, _, unit = (signal.heading or "").rstrip("]").partition(" [")
        if heading == "Sliding variable s":
            found = {_sliding_unit(result) for result in results} - {""}
            unit = " or ".join(sorted(found))
        if heading:
            sections["sliding"][heading] = each(signal.name, unit)
    views = {
        key: [View(label=label, panels=shown) for label, shown in section.items() if shown]
        for key, section in sections.items()
    }
    return {key: shown for key, shown in views.items() if shown}


def _sliding_unit(result: Result) -> str:
    """Unit of the sliding variable in a panel, which depends on the law; empty without one."""
    data = result.record.dataset
    if "sliding_variable" not in data:
        return ""
    return "{unit}/s" if data["sliding_variable"].attrs["units"].endswith("per s") else "{unit}"


def _end_effector_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    paths: list[Trace] = []
    distances, ends = [], None
    for i, result in enumerate(results):
        path, planned = (
            values_of(result.record, f"{kind}end_effector_position") for kind in ("", "desired_")
        )
        if path is None:
            continue
        line = {"color": result.style.color, "width": 5}
        paths.append(_path(path, result.label, legendgroup=f"run-{i}", line=line))
        if ends is None:
            ends = path[np.unique([0, len(path) - 1])]
            if planned is not None:
                line = {"color": NEUTRAL, "dash": "dash", "width": 3}
                paths.append(_path(planned, "reference", line=line))
        if planned is not None:
            distance = np.linalg.norm(path - planned, axis=1)
            distances.append(run_curve(results, i, np.where(distance > 0.0, distance, np.nan)))
    if ends is None:
        return []
    paths.append(
        _path(
            ends, "", mode="markers+text", text=["start", "end"], textposition="top center",
            textfont={"color": NEUTRAL},
            marker={"color": NEUTRAL, "size": 4, "symbol": ["circle", "diamond"]},
        )
    )  # fmt: skip
    camera = {"eye": {"x": 1.7, "y": -1.9, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.1}}
    space = figure(
        paths, x="", y="", scene={"aspectmode": "data", "camera": camera}, dragmode="turntable",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
    )  # fmt: skip
    shown = [Panel(title="Path in the world frame", figure=space, kind="space")]
    if distances:
        title = "Distance from the planned path"
        shown.append(panel(Chart(title=title, y="m", curves=distances, log_y="~e"), thin))
    return shown


def _path(points: np.ndarray, name: str, **look: Any) -> Trace:
    every = max(1, -(-len(points) // 600))
    x, y, z = (
        points[np.unique([*range(0, len(points), every), len(points) - 1])].astype(np.float32).T
    )
    place = "x %{x:.4~g} m<br>y %{y:.4~g} m<br>z %{z:.4~g} m"
    return {"type": "scatter3d", "x": x, "y": y, "z": z, "name": escape(name), "mode": "lines",
            "hovertemplate": place, **look}  # fmt: skip
