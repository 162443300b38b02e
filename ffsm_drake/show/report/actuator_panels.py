"""The report's panels of actuators: a timeline of firings, each wheel's momentum and torque, each
drive's friction.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.runs.actuators import pulses_of
from ffsm_drake.show.panels import Panel, Thinning, View, escape, time_panel
from ffsm_drake.show.report.results import Result
from ffsm_drake.show.report.time_panels import run_curve
from ffsm_drake.show.tables import actuator_lines, number

_MOST_PULSES = 20_000  # of one run that are drawn one by one
_BOX = (-0.2, 0.2, 0.2, -0.2, -0.2)  # of a row's height


def actuator_views(results: Sequence[Result], thin: Thinning) -> list[View]:
    """Views of what the runs' thrusters, wheels and drives did; none for runs without."""
    views = []
    if any("thruster_open" in result.record.dataset for result in results):
        views.append(View(label="Firings", panels=_firings(results)))
    if any("wheel_momentum" in result.record.dataset for result in results):
        for name, label, unit, shape in (
            ("wheel_momentum", "Wheels: momentum", "N m s", "linear"),
            ("wheel_torque", "Wheels: torque of the motors", "N m", "hv"),
        ):
            views.append(View(label=label, panels=_by_wheel(results, thin, name, unit, shape)))
    for name, label in (
        ("friction_force", "Drives: friction"),
        ("rate_share", "Drives: share of the rate limit"),
    ):
        if any(name in result.record.dataset for result in results):
            views.append(View(label=label, panels=_by_joint(results, thin, name)))
    return views


def actuator_text(results: Sequence[Result]) -> str:
    """What the runs took out of their actuators, in sentences."""
    lines = []
    for result in results:
        name = f"{result.label}: " if len(results) > 1 else ""
        lines += [
            f"{name}{line[:1].upper()}{line[1:]}." for line in actuator_lines(result.record.metrics)
        ]
    return " ".join(lines)


def actuator_tables(results: Sequence[Result]) -> list[dict[str, Any]]:
    """What each thruster and each wheel of the runs did, a row each."""
    found = []
    for result in results:
        data, fired, turned = result.record.dataset, result.thrusters, result.wheels
        thrusters = [
            [
                name,
                number(fired["impulse"][name]),
                fired["pulses"][name],
                number(fired["on_time"][name]),
            ]
            for name in fired.get("impulse", {})
        ]
        wheels = []
        for i, name in enumerate(turned.get("peak_momentum", {})):
            speed, torque = (turned[f"peak_{kind}"][name] for kind in ("speed", "torque"))
            limits = [float(data[f"{kind}_limit"].values[i]) for kind in ("speed", "torque")]
            figures = (turned["peak_momentum"][name], speed, limits[0], torque, limits[1])
            wheels.append([name, *map(number, figures)])
        if thrusters or wheels:
            found.append({"result": result, "thrusters": thrusters, "wheels": wheels})
    return found


def _firings(results: Sequence[Result]) -> list[Panel]:
    """A panel per run: a row for each thruster, a box for each pulse."""
    panels = []
    for i, result in enumerate(results):
        data = result.record.dataset
        if "thruster_open" not in data:
            continue
        names, opened = data["thruster"].values.astype(str).tolist(), data["thruster_open"].values
        time, period = data["time"].values, result.record.scenario.sample_time
        traces = []
        for row, column in enumerate(opened.T):
            first, lengths = pulses_of(column, period)
            starts, ends = time[first], time[first] + lengths
            # none is seen alone: those that are near become one
            if starts.size > _MOST_PULSES // len(names):
                gap = 2.0 * (time[-1] - time[0]) * len(names) / _MOST_PULSES
                apart = np.flatnonzero(starts[1:] - ends[:-1] > gap)
                starts, ends = starts[np.r_[0, apart + 1]], ends[np.r_[apart, ends.size - 1]]
            # A box of each pulse: its outline is seen where it is narrower than a pixel.
            x = np.stack([starts, starts, ends, ends, starts, np.full(starts.size, np.nan)], axis=1)
            y = np.tile(row + np.array([*_BOX, np.nan]), starts.size)
            look = {
                "name": names[row],
                "width": 1.0,
                "hovertemplate": "%{x:.2f} s",
                "connectgaps": False,
                "fill": "toself",
                "hoveron": "points",
            }
            traces.append(
                run_curve(results, i, (x.ravel().astype(np.float32), y), **look) | {"mode": "lines"}
            )
        title = result.label if len(results) > 1 else "Open valves"
        panel = time_panel(title, "", traces)
        panel.figure.update_layout(hovermode="closest")
        panel.figure.update_xaxes(range=[float(time[0]), float(time[-1]) + period])
        panel.figure.update_yaxes(
            tickvals=list(range(len(names))), ticktext=[escape(name) for name in names],
            range=[len(names) - 0.4, -0.6], showgrid=False, zeroline=False,
        )  # fmt: skip
        panels.append(
            Panel(title=panel.title, figure=panel.figure, kind="chart", height=90 + 20 * len(names))
        )
    return panels


def _by_wheel(
    results: Sequence[Result], thin: Thinning, variable: str, unit: str, shape: str
) -> list[Panel]:
    """A panel for each wheel of any run, the runs that have it overlaid."""
    names = dict.fromkeys(
        name
        for result in results
        if variable in result.record.dataset
        for name in result.record.dataset["wheel"].values.astype(str).tolist()
    )
    panels = []
    for name in names:
        traces = []
        for i, result in enumerate(results):
            data = result.record.dataset
            if variable in data and name in data["wheel"].values:
                curve = thin(data["time"].values, data[variable].sel(wheel=name).values)
                traces.append(run_curve(results, i, curve, shape=shape))
        panels.append(time_panel(name.replace("_", " "), unit, traces))
    return panels


def _by_joint(results: Sequence[Result], thin: Thinning, variable: str) -> list[Panel]:
    """A panel for each joint of any run, the runs that have the variable overlaid."""
    units = {
        str(name): {"rad": "N m", "m": "N"}[str(unit)] if variable == "friction_force" else ""
        for data in (result.record.dataset for result in results)
        for name, group, unit in zip(
            *(data[key].values for key in ("coordinate", "group", "unit")), strict=True
        )
        if variable in data and str(group) == "joints"
    }
    panels = []
    for name, unit in units.items():
        traces = []
        for i, result in enumerate(results):
            data = result.record.dataset
            if variable in data and name in data["coordinate"].values:
                values = data[variable].sel(coordinate=name).values
                if values.any():
                    traces.append(run_curve(results, i, thin(data["time"].values, values)))
        if traces:
            panels.append(time_panel(name.replace("_", " "), unit, traces))
    return panels
