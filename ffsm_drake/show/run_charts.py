"""Charts of runs, overlaid: motion, errors, forces, sliding variable and gains. The report and the
figures draw them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.runs.table import driven_of
from ffsm_drake.show.chart import Chart, Curve
from ffsm_drake.show.curves import completed_range, moving_rms
from ffsm_drake.show.results import HELD, Result, values_of
from ffsm_drake.show.style import EFFORT_UNITS, GROUP_TITLES, NEUTRAL, Style

RMS_POINTS = 500  # number of points of a smooth curve
_REFERENCE = Style(NEUTRAL, "dot")
_STARTING_STEPS = 5  # steps in which the loop builds up the force from zero

Column = tuple[int, np.ndarray]  # which run, its values


def run_curve(
    results: Sequence[Result],
    i: int,
    y: np.ndarray,
    *,
    x: np.ndarray | None = None,
    name: str = "",
    style: Style | None = None,
    **look: Any,
) -> Curve:
    """Return a curve of run i in its style, over time unless x is given; ``look`` as of
    ``Curve``.
    """
    run = results[i]
    names = filter(None, (run.label if len(results) > 1 else "", name))
    return Curve(
        run.time if x is None else x, y, style or run.style,
        ", ".join(names) or run.label, run=i, **look,
    )  # fmt: skip


def coordinate_charts(results: Sequence[Result], variable: str, unit: str) -> list[Chart]:
    """Return a chart for each coordinate of any run; overlays the runs with the variable.

    In ``unit``, {unit} is the coordinate's own and {effort} the unit of its force or torque.
    """
    return [
        chart_of_runs(
            results, name, unit.format(unit=kind, effort=EFFORT_UNITS.get(kind, kind)), columns,
            group=group, steps=variable in HELD,
        )
        for (name, group, kind), columns in _by_coordinate(results, variable).items()
    ]  # fmt: skip


def rms_charts(results: Sequence[Result]) -> list[Chart]:
    """Return the rms of each coordinate's error over a second; of a run alone with the error's
    magnitude behind it.
    """
    charts = []
    for (name, group, unit), columns in _by_coordinate(results, "error").items():
        curves = [_rms(results, *column) for column in columns]
        extent = None
        if len(results) == 1:
            magnitude = np.abs(columns[0][1])
            low = curves[0].y[np.isfinite(curves[0].y)]
            # The magnitude's zero crossings reach far below anything of interest.
            if low.size:
                extent = float(low.min() / 10.0), float(1.5 * magnitude[: low.size].max())
            behind = np.where(magnitude == 0.0, np.nan, magnitude)
            curves.insert(0, run_curve(results, 0, behind, width=0.8, opacity=0.22))
        title, heading = name.replace("_", " "), GROUP_TITLES.get(group, group)
        charts.append(
            Chart(title=title, group=heading, y=unit, curves=curves, log_y="~e", range=extent)
        )
    return charts


def step_charts(results: Sequence[Result]) -> list[Chart]:
    """Return the rms over a second of the change of each force from one sample to the next."""
    return [
        Chart(
            title=name,
            curves=[
                _rms(results, i, np.diff(values)[_STARTING_STEPS:], late=_STARTING_STEPS + 1)
                for i, values in columns
            ],
            log_y="~e",
        )
        for (name, *_), columns in _by_coordinate(results, "generalized_force").items()
    ]


def _rms(results: Sequence[Result], i: int, values: np.ndarray, *, late: int = 0) -> Curve:
    """Return the moving rms of values that start ``late`` samples after the run."""
    size = moving_rms(values, results[i].record.scenario.sample_time)
    return run_curve(
        results, i, size, x=results[i].time[late:][: size.size], width=1.5,
        name="rms" if len(results) == 1 else "", points=RMS_POINTS,
    )  # fmt: skip


def path_charts(results: Sequence[Result]) -> list[Chart]:
    """Return the path of the end effector in space, with the first run's reference, and its
    distance from the reference.
    """
    paths, marks, distances = list[Curve](), list[Curve](), list[Curve]()
    for i, result in enumerate(results):
        path, planned = (
            values_of(result.record, f"{kind}end_effector_position") for kind in ("", "desired_")
        )
        if path is None:
            continue
        paths.append(_path(path, Style(result.style.color), result.label, width=5.0, run=i))
        if not marks:
            if planned is not None:
                marks.append(_path(planned, Style(NEUTRAL, "dash"), "reference", width=3.0))
            marks.append(
                _path(
                    path[[0, -1]], Style(NEUTRAL), line=False, marker="circle", size=4.0,
                    texts=("start", "end"),
                )
            )  # fmt: skip
        if planned is not None:
            distance = np.linalg.norm(path - planned, axis=1)
            distances.append(run_curve(results, i, np.where(distance > 0.0, distance, np.nan)))
    charts = [
        Chart(title="Path in the world frame", kind="space", curves=[*paths, *marks]),
        Chart(title="Distance from the planned path", y="m", curves=distances, log_y="~e"),
    ]
    return [chart for chart in charts if chart.curves]


def _path(points: np.ndarray, style: Style, name: str = "", **look: Any) -> Curve:
    x, y, z = points.T
    return Curve(x, y, style, name, z=z, **look)


def attitude_charts(results: Sequence[Result]) -> list[Chart]:
    """Return roll, pitch and yaw of the base, and their references."""
    return _tracked(results, "base_rpy", {"x": "Roll", "y": "Pitch", "z": "Yaw"})


def position_charts(results: Sequence[Result]) -> list[Chart]:
    """Position of the base and of every joint, and their references."""
    return _tracked(results, "position", {})


def _tracked(results: Sequence[Result], variable: str, angles: Mapping[str, str]) -> list[Chart]:
    """Components of a variable of any run, and their references, each once; ``angles`` names
    components that are no coordinates.
    """
    columns: dict[tuple[str, str], list[Column]] = {}
    references: dict[tuple[str, str], dict[bytes, Curve]] = {}
    for i, result in enumerate(results):
        values, desired = (
            values_of(result.record, f"{kind}{variable}") for kind in ("", "desired_")
        )
        if values is None:
            continue
        units = dict.fromkeys(angles, "rad") or result.units
        data = result.record.dataset[variable]
        for k, name in enumerate(data[data.dims[1]].values.astype(str).tolist()):
            if name not in units:  # of the quaternion
                continue
            is_angle = units[name] == "rad"
            factor = float(np.rad2deg(1.0)) if is_angle else 1.0
            key = (angles.get(name, name), "deg" if is_angle else units[name])
            columns.setdefault(key, []).append((i, factor * values[:, k]))
            if desired is not None:
                y = factor * desired[:, k]
                curve = Curve(result.time, y, _REFERENCE, "reference", width=1.2)
                references.setdefault(key, {}).setdefault(y.tobytes(), curve)
    return [
        chart_of_runs(
            results, *key, found, width=2.0, behind=list(references.get(key, {}).values())
        )
        for key, found in columns.items()
    ]  # fmt: skip


def chart_of_runs(
    results: Sequence[Result],
    title: str,
    unit: str,
    columns: Sequence[Column],
    *,
    group: str = "",
    behind: Sequence[Curve] = (),
    **look: Any,
) -> Chart:
    """Return a chart of the runs' values."""
    curves = [run_curve(results, i, values, **look) for i, values in columns]
    return Chart(
        title=title.replace("_", " "), group=GROUP_TITLES.get(group, group), y=unit,
        curves=[*curves, *behind],
        range=completed_range([(results[i].comparable, values) for i, values in columns]),
    )  # fmt: skip


def _by_coordinate(
    results: Sequence[Result], variable: str
) -> dict[tuple[str, str, str], list[Column]]:
    """(name, group, unit) of each coordinate of any run -> the runs' values, the roughest first."""
    found: dict[tuple[str, str, str], list[Column]] = {}
    for i in _roughest_first(results, variable):
        data = results[i].record.dataset
        names = zip(
            *(data[name].values.astype(str).tolist() for name in ("coordinate", "group", "unit")),
            strict=True,
        )
        # no force acts on undriven coordinates
        driven = driven_of(data) | (variable not in HELD)
        for key, values, shown in zip(names, data[variable].values.T, driven, strict=True):
            if shown:
                found.setdefault(key, []).append((i, values))
    return found


def _roughest_first(results: Sequence[Result], variable: str) -> list[int]:
    """Return the runs with a variable, the roughest first, so that none covers a smoother one."""
    rough = {}
    for i, result in enumerate(results):
        values = values_of(result.record, variable)
        if values is not None:
            steps = np.abs(np.diff(values, axis=0))
            finite = steps[np.isfinite(steps)]
            rough[i] = -float(np.median(finite)) if finite.size else 0.0
    return sorted(rough, key=rough.__getitem__)
