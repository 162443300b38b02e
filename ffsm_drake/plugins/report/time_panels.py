"""The report's views of the runs themselves: motion, end effector, errors, forces, sliding variable
and gains.
"""

from collections.abc import Sequence

from ffsm_drake.runs.tracking import FRAME_COORDINATES, FRAME_UNITS
from ffsm_drake.show.chart import Chart, View
from ffsm_drake.show.results import Result, actuators_act
from ffsm_drake.show.run_charts import (
    attitude_charts,
    chart_of_runs,
    coordinate_charts,
    path_charts,
    position_charts,
    rms_charts,
)
from ffsm_drake.systems.controllers.controller import LAW_SIGNALS


def run_views(results: Sequence[Result]) -> dict[str, list[View]]:
    """Section -> views of the runs over time and in space; only what the records hold."""

    def each(variable: str, unit: str) -> list[Chart]:
        return coordinate_charts(results, variable, unit)

    errors = {
        "Error": each("error", "{unit}"),
        "rms of the error over 1 s, logarithmic": rms_charts(results),
    }
    if len(results) > 1:  # their errors differ by orders of magnitude
        errors = dict(reversed(errors.items()))
    applied = each("applied_force", "{effort}") if actuators_act(results) else []
    sections: dict[str, dict[str, list[Chart]]] = {
        "motion": {
            "Base attitude": attitude_charts(results),
            "Base position and joints": position_charts(results),
        },
        "end_effector": {"End effector": path_charts(results)},
        "error": {"Frame": _frame_charts(results), **errors},
        "force": {
            "Control": each("generalized_force", "{effort}"),
            "Applied by the actuators": applied,
            "Disturbance": each("disturbance_force", "{effort}"),
        },
        "sliding": {},
    }
    for signal in LAW_SIGNALS:
        heading, _, unit = (signal.heading or "").rstrip("]").partition(" [")
        if heading == "Sliding variable s":
            found = {_sliding_unit(result) for result in results} - {""}
            unit = " or ".join(sorted(found))
        if heading:
            sections["sliding"][heading] = each(signal.name, unit)
    views = {
        key: [View(label=label, charts=shown) for label, shown in section.items() if shown]
        for key, section in sections.items()
    }
    return {key: shown for key, shown in views.items() if shown}


def _sliding_unit(result: Result) -> str:
    """Unit of the sliding variable in a panel, which depends on the law; empty without one."""
    data = result.record.dataset
    if "sliding_variable" not in data:
        return ""
    return "{unit}/s" if data["sliding_variable"].attrs["units"].endswith("per s") else "{unit}"


def _frame_charts(results: Sequence[Result]) -> list[Chart]:
    """Return the pose error of the frame that has a reference."""
    having = {
        i: result.record.dataset["frame_error"].values
        for i, result in enumerate(results)
        if "frame_error" in result.record.dataset
    }
    return [
        chart_of_runs(results, name, unit, [(i, values[:, k]) for i, values in having.items()])
        for k, (name, unit) in enumerate(zip(FRAME_COORDINATES, FRAME_UNITS, strict=True))
        if having
    ]
