"""The report's panels of the runs themselves: motion, end effector, errors, forces, sliding
variable and gains.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.runs.table import driven_of
from ffsm_drake.runs.tracking import FRAME_COORDINATES, FRAME_UNITS
from ffsm_drake.show.curves import completed_range, moving_rms
from ffsm_drake.show.panels import Panel, Thinning, Trace, View, curve, escape, figure, time_panel
from ffsm_drake.show.report.results import HELD, Result, actuators_act, values_of
from ffsm_drake.show.style import EFFORT_UNITS, GROUP_TITLES, NEUTRAL, Style

# Points that all curves of a page may have together, and bounds on those of one curve: enough for
# zooming in.
BUDGET = 800_000
FEWEST_POINTS, MOST_POINTS = 400, 4000
RMS_POINTS = 500  # of a curve that smooth
_REFERENCE = Style(NEUTRAL, "dot")
_VARIABLES = (
    "error",
    *HELD,
    "disturbance_force",
    "sliding_variable",
    "reaching_gain",
    "switching_gain",
    "position",
    "desired_position",
)


def points_per_curve(results: Sequence[Result]) -> int:
    """How many points each curve of these runs may have."""
    curves = sum(
        result.record.dataset.sizes.get("coordinate", 0)
        for result in results
        for name in _VARIABLES
        if name in result.record.dataset
    )
    return int(np.clip(BUDGET // max(curves, 1), FEWEST_POINTS, MOST_POINTS))


def run_views(results: Sequence[Result], thin: Thinning) -> dict[str, list[View]]:
    """Section -> views of the runs over time and in space; only what the records hold."""

    def each(variable: str, label: str, unit: str, **rest: Any) -> View:
        return View(label=label, panels=_coordinate_panels(results, thin, variable, unit, **rest))

    errors = [
        each("error", "Error", "{unit}"),
        View(
            label="rms of the error over 1 s, logarithmic", panels=_error_size_panels(results, thin)
        ),
    ]
    if len(results) > 1:  # whose errors differ by orders of magnitude
        errors.reverse()
    errors.insert(0, View(label="Frame", panels=_frame_panels(results, thin)))
    sections = {
        "motion": [
            View(label="Base attitude", panels=_attitude_panels(results, thin)),
            View(label="Base position and joints", panels=_position_panels(results, thin)),
        ],
        "end_effector": [View(label="End effector", panels=_end_effector_panels(results, thin))],
        "error": errors,
        "force": [
            each("generalized_force", "Control", "{effort}"),
            *(
                [each("applied_force", "As the actuators apply it", "{effort}")]
                if actuators_act(results)
                else []
            ),
            each("disturbance_force", "Disturbance", "{effort}"),
        ],
        "sliding": [
            each("sliding_variable", "Sliding variable s", "{unit}/s"),
            each("reaching_gain", "Gain Kₛ", "1/s", smooth=True),
            each("switching_gain", "Gain G", "{unit}/s²", smooth=True),
        ],
    }
    kept = {key: [view for view in views if view.panels] for key, views in sections.items()}
    return {key: views for key, views in kept.items() if views}


def run_curve(
    results: Sequence[Result], i: int, xy: tuple[np.ndarray, np.ndarray], **rest: Any
) -> Trace:
    """A curve of run i, which the page's chips hide and show."""
    name = ", ".join(
        filter(None, (results[i].label if len(results) > 1 else "", rest.pop("name", "")))
    )
    style = rest.pop("style", Style(results[i].style.color))
    return curve(xy, style, name=name or results[i].label, legendgroup=f"run-{i}", **rest)


Column = tuple[int, np.ndarray]  # which run, its values


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
        driven = (
            driven_of(data) if variable in HELD else np.ones(data.sizes["coordinate"], dtype=bool)
        )
        for k, key in enumerate(names):
            if driven[k]:  # elsewhere no force acts
                found.setdefault(key, []).append((i, data[variable].values[:, k]))
    return found


def _roughest_first(results: Sequence[Result], variable: str) -> list[int]:
    """The runs that have a variable, in an order in which none covers a smoother one."""
    rough = {}
    for i, result in enumerate(results):
        values = values_of(result.record, variable)
        if values is not None:
            steps = np.abs(np.diff(values, axis=0))
            finite = steps[np.isfinite(steps)]
            rough[i] = -float(np.median(finite)) if finite.size else 0.0
    return sorted(rough, key=rough.__getitem__)


def _coordinate_panels(
    results: Sequence[Result], thin: Thinning, variable: str, unit: str, *, smooth: bool = False
) -> list[Panel]:
    """A panel for each coordinate of any run, the runs that have it overlaid."""
    panels = []
    for (name, group, kind), columns in _by_coordinate(results, variable).items():
        traces = [
            run_curve(
                results,
                i,
                thin(_time(results[i]), values),
                shape="hv" if variable in HELD else "linear",
                style=results[i].style if smooth else Style(results[i].style.color),
            )
            for i, values in columns
        ]
        text = unit.format(unit=kind, effort=EFFORT_UNITS.get(kind, kind))
        panels.append(
            _panel(results, name, text, traces, columns, group=GROUP_TITLES.get(group, group))
        )
    return panels


def _frame_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    """The pose error of the frame that has a reference."""
    having = [i for i, result in enumerate(results) if "frame_error" in result.record.dataset]
    panels = []
    for k, (name, unit) in enumerate(zip(FRAME_COORDINATES, FRAME_UNITS, strict=True)):
        columns = [(i, results[i].record.dataset["frame_error"].values[:, k]) for i in having]
        traces = [run_curve(results, i, thin(_time(results[i]), values)) for i, values in columns]
        panels += [_panel(results, name, unit, traces, columns)] if traces else []
    return panels


def _error_size_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    """The rms of each coordinate's error over a second; of a run alone with the error's magnitude
    behind it.
    """
    panels = []
    smoother = Thinning(RMS_POINTS)
    for (name, group, unit), columns in _by_coordinate(results, "error").items():
        traces, sizes = [], []
        for i, values in columns:
            size = moving_rms(values, results[i].record.scenario.sample_time)
            sizes.append(size)
            if len(results) == 1:
                magnitude = thin(_time(results[i]), np.where(values == 0.0, np.nan, np.abs(values)))
                traces.append(
                    run_curve(results, i, magnitude, width=0.8, opacity=0.22, hoverinfo="skip")
                )
            rms = smoother(_time(results[i])[: size.size], size)
            traces.append(
                run_curve(
                    results,
                    i,
                    rms,
                    name="rms" if len(results) == 1 else "",
                    width=1.8,
                    style=results[i].style,
                )
            )
        # The magnitude's zero crossings reach far below anything of interest.
        low = np.concatenate(sizes)
        low = low[np.isfinite(low)]
        bounds = None
        if low.size and len(results) == 1:
            top = float(np.nanmax(np.abs(columns[0][1][: low.size])))
            bounds = [float(np.log10(low.min() / 10.0)), float(np.log10(top * 1.5))]
        title, heading = name.replace("_", " "), GROUP_TITLES.get(group, group)
        panels.append(time_panel(title, unit, traces, group=heading, log=True, range=bounds))
    return panels


def _panel(
    results: Sequence[Result],
    title: str,
    unit: str,
    traces: list[Trace],
    columns: Sequence[Column],
    *,
    group: str = "",
) -> Panel:
    shown = completed_range([(results[i].comparable, values) for i, values in columns])
    return time_panel(title.replace("_", " "), unit, traces, group=group, range=shown)


def _time(result: Result) -> np.ndarray:
    values: np.ndarray = result.record.dataset["time"].values
    return values


def _attitude_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    return [
        panel
        for k, title in enumerate(("Roll", "Pitch", "Yaw"))
        for panel in _tracked_panel(results, thin, title, "rad", "base_rpy", [k] * len(results))
    ]


def _position_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    kinds: dict[str, str] = {}
    columns: list[dict[str, int]] = []  # of each run, name -> place
    for result in results:
        data = result.record.dataset
        units = dict(
            zip(data["coordinate"].values.astype(str), data["unit"].values.astype(str), strict=True)
        )
        names = data["position_name"].values.astype(str).tolist() if "position_name" in data else []
        # not the quaternion
        columns.append({name: k for k, name in enumerate(names) if name in units})
        kinds = {name: units[name] for name in columns[-1]} | kinds
    return [
        panel
        for name, unit in kinds.items()
        for panel in _tracked_panel(
            results, thin, name, unit, "position", [places.get(name) for places in columns]
        )
    ]


def _tracked_panel(
    results: Sequence[Result],
    thin: Thinning,
    title: str,
    unit: str,
    variable: str,
    places: Sequence[int | None],
) -> list[Panel]:
    """A variable's column (its place by run) of every run that has it, and their references; no
    panel for none.
    """
    unit, factor = ("deg", float(np.rad2deg(1.0))) if unit == "rad" else (unit, 1.0)
    columns: list[Column] = []
    traces, references, seen = [], [], set()
    for i, (result, k) in enumerate(zip(results, places, strict=True)):
        values, reference = (
            values_of(result.record, f"{prefix}{variable}") for prefix in ("", "desired_")
        )
        if k is None or values is None:
            continue
        columns.append((i, factor * values[:, k]))
        traces.append(
            run_curve(results, i, thin(_time(result), columns[-1][1]), width=2, style=result.style)
        )
        if reference is not None and (data := (factor * reference[:, k]).tobytes()) not in seen:
            seen.add(data)
            xy = thin(_time(result), factor * reference[:, k])
            references.append(curve(xy, _REFERENCE, name="reference", width=1.2))
    return [_panel(results, title, unit, traces + references, columns)] if traces else []


def _end_effector_panels(results: Sequence[Result], thin: Thinning) -> list[Panel]:
    paths: list[Trace] = []
    distances: list[Trace] = []
    ends: np.ndarray | None = None
    for i, result in enumerate(results):
        path, planned = (
            values_of(result.record, f"{kind}end_effector_position") for kind in ("", "desired_")
        )
        if path is None:
            continue
        paths.append(
            _path(
                path,
                result.label,
                legendgroup=f"run-{i}",
                line={"color": result.style.color, "width": 5},
            )
        )
        if ends is None:
            ends = path[np.unique([0, len(path) - 1])]
            if planned is not None:
                paths.append(
                    _path(planned, "reference", line={"color": NEUTRAL, "dash": "dash", "width": 3})
                )
        if planned is not None:
            distance = np.linalg.norm(path - planned, axis=1)
            distances.append(
                run_curve(
                    results, i, thin(_time(result), np.where(distance > 0.0, distance, np.nan))
                )
            )
    if ends is None:
        return []
    marker = {"color": NEUTRAL, "size": 4, "symbol": ["circle", "diamond"]}
    paths.append(
        _path(
            ends,
            "",
            mode="markers+text",
            text=["start", "end"],
            textposition="top center",
            textfont={"color": NEUTRAL},
            marker=marker,
        )
    )
    camera = {"eye": {"x": 1.7, "y": -1.9, "z": 1.0}, "center": {"x": 0.0, "y": 0.0, "z": -0.1}}
    space = figure(
        paths,
        x="",
        y="",
        scene={"aspectmode": "data", "camera": camera},
        dragmode="turntable",
        margin={"l": 0, "r": 0, "t": 0, "b": 0},
    )
    panels = [Panel(title="Path in the world frame", figure=space, kind="space")]
    if distances:
        panels.append(time_panel("Distance from the planned path", "m", distances, log=True))
    return panels


def _path(points: np.ndarray, name: str, **look: Any) -> Trace:
    every = max(1, -(-len(points) // 600))
    x, y, z = (
        points[np.unique([*range(0, len(points), every), len(points) - 1])].astype(np.float32).T
    )
    place = "x %{x:.4~g} m<br>y %{y:.4~g} m<br>z %{z:.4~g} m"
    return {"type": "scatter3d", "x": x, "y": y, "z": z, "name": escape(name), "mode": "lines",
            "hovertemplate": place, **look}  # fmt: skip
