"""The report's plots as plain data: what each panel shows. The page's script draws them with plotly.js.

A plot is a grid of panels. Several views of one grid (the error, its magnitude) share their places on the page.
"""

import base64
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ffsm_drake.control_design.stability import Margins
from ffsm_drake.control_design.stability.sampled_loop import largest_sample_time, largest_stable_k_s
from ffsm_drake.show.report.results import EFFORT_UNITS, GROUP_TITLES, Result, values_of

# Numbers that all curves of a page may hold together, and bounds on those of one curve: enough for zooming in.
BUDGET = 800_000
FEWEST_POINTS, MOST_POINTS = 400, 4000
RMS_WINDOW = 1.0  # s
RMS_POINTS = 500  # of a curve that smooth
GROUP_COLORS = dict(zip(GROUP_TITLES, ("#D55E00", "#0072B2", "#009E73"), strict=True))
# A map's range of eta, and its points: the curve is smooth.
_MAP_ETA = (0.2, 1.4, 25)

Json = dict[str, Any]


@dataclasses.dataclass
class Curves:
    """Collects the numbers of all curves, each array once, thinned to ``points``."""

    points: int
    arrays: list[str] = dataclasses.field(default_factory=list)
    longest: int = 0  # samples of the longest curve before thinning
    _known: dict[bytes, int] = dataclasses.field(default_factory=dict)

    def add(self, values: np.ndarray) -> int:
        """The place of an array; little-endian single precision as base64."""
        with np.errstate(over="ignore"):
            data = np.ascontiguousarray(values, dtype="<f4").tobytes()
        if data not in self._known:
            self._known[data] = len(self.arrays)
            self.arrays.append(base64.b64encode(data).decode("ascii"))
        return self._known[data]

    def curve(self, x: np.ndarray, y: np.ndarray, *, points: int = MOST_POINTS) -> Json:
        """A curve, thinned to ``points`` where that is less than the page allows."""
        self.longest = max(self.longest, x.size)
        kept = thinned(y, min(points, self.points))
        return {"x": self.add(x[kept]), "y": self.add(y[kept])}


def thinned(values: np.ndarray, points: int) -> np.ndarray:
    """Indices of at most ``points`` values (n,) that keep the first, the last and every interval's extremes."""
    if values.size <= points:
        return np.arange(values.size)
    width = -(-values.size // ((points - 2) // 2))
    intervals = -(-values.size // width)
    padded = np.full(intervals * width, np.nan)
    padded[: values.size] = values
    rows = padded.reshape(intervals, width)
    start = np.arange(intervals) * width
    low = start + np.where(np.isfinite(rows), rows, np.inf).argmin(axis=1)
    high = start + np.where(np.isfinite(rows), rows, -np.inf).argmax(axis=1)
    return np.unique(np.concatenate([[0], low, high, [values.size - 1]]))


def points_per_curve(results: Sequence[Result]) -> int:
    """How many points each curve of these runs may have."""
    variables = ("error", "generalized_force", "applied_force", "disturbance_force", "sliding_variable",
                 "reaching_gain", "switching_gain", "position", "desired_position")  # fmt: skip
    curves = sum(
        result.record.dataset.sizes.get("coordinate", 0)
        for result in results
        for name in variables
        if name in result.record.dataset
    )
    return int(np.clip(BUDGET // max(curves, 1), FEWEST_POINTS, MOST_POINTS))


def time_plots(results: Sequence[Result], curves: Curves) -> dict[str, Json]:
    """Plots of the runs over time and in space, by the section they belong to; only what the records hold."""
    plots: dict[str, Json] = {}
    _put(plots, "error", [
        _coordinate_view(results, curves, "error", "Error", axis="{unit}"),
        _coordinate_view(results, curves, "error", "|Error| with rms over 1 s, logarithmic", axis="{unit}", log=True),
    ])  # fmt: skip
    _put(plots, "force", [
        _coordinate_view(results, curves, "generalized_force", "Control", axis="{effort}"),
        _coordinate_view(results, curves, "applied_force", "As the actuators apply it", axis="{effort}")
        if _differ(results, "applied_force", "generalized_force") else None,
        _coordinate_view(results, curves, "disturbance_force", "Disturbance", axis="{effort}"),
    ])  # fmt: skip
    _put(plots, "sliding", [
        _coordinate_view(results, curves, "sliding_variable", "Sliding variable s", axis="{unit}/s"),
        _coordinate_view(results, curves, "reaching_gain", "Gain Kₛ", axis="1/s", smooth=True),
        _coordinate_view(results, curves, "switching_gain", "Gain G", axis="{unit}/s²", smooth=True),
    ])  # fmt: skip
    _put(plots, "motion", [_attitude_view(results, curves), _position_view(results, curves)])
    _put(plots, "end_effector", [_end_effector_view(results, curves)])
    return plots


def stability_plots(results: Sequence[Result], margins: Sequence[Margins | None], curves: Curves) -> Json | None:
    """The stability plots of the runs that could be assessed; None where there is none."""
    assessed = [(i, result, margin) for i, (result, margin) in enumerate(zip(results, margins, strict=True)) if margin]
    if not assessed:
        return None
    panels = _eta_panels(assessed, curves)
    radius = []
    for i, _, margin in assessed:
        start = curves.curve(margin.times, margin.spectral_radius)
        radius.append({**start, "run": i, "name": "starting gains"})
        if np.isfinite(margin.k_s_limit).any():
            expected = curves.curve(margin.times, margin.spectral_radius_expected)
            radius.append({**expected, "run": i, "name": "largest expected Kₛ", "dash": "dash"})
    panels.append(
        _panel(
            "Spectral radius of the coupled loop (dashed: at the largest expected Kₛ)",
            "1",
            radius,
            lines=[{"y": 1.0, "text": "limit 1"}],
        )
    )
    for i, result, margin in assessed:
        if np.isfinite(margin.k_s_limit).any():
            panels.append(_forecast_panel(result, margin, curves))
        panels.append(_map_panel(i, result, margin, curves))
    return {"views": [{"label": "Stability", "panels": panels}]}


def _put(plots: dict[str, Json], key: str, views: list[Json | None]) -> None:
    kept = [view for view in views if view is not None]
    if kept:
        plots[key] = {"views": kept}


def _panel(title: str, axis: str, traces: list[Json], **rest: Any) -> Json:
    return {"title": title, "axis": axis, "kind": "time", "traces": traces, **rest}


def _differ(results: Sequence[Result], one: str, other: str) -> bool:
    """Whether two variables differ by more than the sample that a delay or limit would change; NaN equals NaN."""
    pairs = [(values_of(result.record, one), values_of(result.record, other)) for result in results]
    return any(a is not None and b is not None and not np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _coordinate_view(
    results: Sequence[Result],
    curves: Curves,
    variable: str,
    label: str,
    *,
    axis: str,
    log: bool = False,
    smooth: bool = False,
) -> Json | None:
    """A panel for each coordinate of any run, the runs that have it overlaid."""
    columns: dict[str, list[tuple[int, np.ndarray]]] = {}
    kinds: dict[str, tuple[str, str]] = {}
    for i in _roughest_first(results, variable):
        dataset = results[i].record.dataset
        values = dataset[variable].values
        for k, name in enumerate(dataset["coordinate"].values.astype(str).tolist()):
            columns.setdefault(name, []).append((i, values[:, k]))
            kinds.setdefault(name, (str(dataset["group"].values[k]), str(dataset["unit"].values[k])))
    panels = []
    for name, members in columns.items():
        group, unit = kinds[name]
        bounds: Json = {}
        traces = [
            {
                **curves.curve(results[i].record.dataset["time"].values, values),
                "run": i,
                "dash": results[i].dash if smooth else "solid",
                # Held from one sample to the next.
                **({"step": True} if variable in ("generalized_force", "applied_force") else {}),
            }
            for i, values in members
        ]
        if log:
            # The magnitude of noise is a thicket: what tells the runs apart is its rms.
            smooth_ones = [(i, *_moving_rms(results[i], values)) for i, values in members]
            traces = [{**trace, "faint": True, "width": 0.8} for trace in traces] + [
                {**curves.curve(time, rms, points=RMS_POINTS), "run": i, "name": "rms", "width": 1.8}
                for i, time, rms in smooth_ones
            ]
            bounds = _log_range([values for _, values in members], [rms for _, _, rms in smooth_ones])
        panels.append(
            _panel(
                name.replace("_", " "),
                axis.format(unit=unit, effort=EFFORT_UNITS.get(unit, unit)),
                traces,
                group=GROUP_TITLES.get(group, group),
                **({"log": True, **bounds} if log else _completed_range(results, members)),
            )
        )
    return {"label": label, "panels": panels} if panels else None


def _moving_rms(result: Result, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and root of the mean square over one second around it, before the first value that is not finite."""
    from scipy.ndimage import uniform_filter1d

    finite = np.isfinite(values)
    part = values[: values.size if finite.all() else int(np.argmin(finite))]
    window = max(round(RMS_WINDOW / result.record.scenario.sample_time), 1)
    with np.errstate(over="ignore"):
        mean_square = uniform_filter1d(np.square(part), window, mode="nearest") if part.size else part
    time = result.record.dataset["time"].values[: part.size]
    return time, np.sqrt(np.maximum(mean_square, 0.0))


def _log_range(values: Sequence[np.ndarray], rms: Sequence[np.ndarray]) -> Json:
    """Decades that show the rms well: the magnitude's zero crossings reach far below anything of interest."""
    low, high = np.abs(np.concatenate(rms)), np.abs(np.concatenate(values))
    low, high = low[np.isfinite(low) & (low > 0.0)], high[np.isfinite(high) & (high > 0.0)]
    if not low.size or not high.size:
        return {}
    return {"range": [float(np.log10(low.min() / 10.0)), float(np.log10(high.max() * 1.5))]}


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


def _completed_range(results: Sequence[Result], members: Sequence[tuple[int, np.ndarray]]) -> Json:
    """The range of the completed runs where others diverged and would flatten them."""
    completed = [values for i, values in members if results[i].comparable]
    if not completed or len(completed) == len(members):
        return {}
    low = min(float(np.nanmin(values)) for values in completed)
    high = max(float(np.nanmax(values)) for values in completed)
    margin = 0.08 * (high - low)
    return {"range": [low - margin, high + margin]} if high > low else {}


def _attitude_view(results: Sequence[Result], curves: Curves) -> Json | None:
    panels = []
    for k, title in enumerate(("Roll", "Pitch", "Yaw")):
        columns = _columns(results, "base_rpy", "desired_base_rpy", [k] * len(results))
        panels.append(_tracked_panel(title, "deg", results, columns, curves, factor=float(np.rad2deg(1.0))))
    return _view("Base attitude", panels)


def _position_view(results: Sequence[Result], curves: Curves) -> Json | None:
    names: dict[str, str] = {}
    for result in results:
        dataset = result.record.dataset
        units = dict(zip(dataset["coordinate"].values.astype(str), dataset["unit"].values.astype(str), strict=True))
        for name in dataset["position_name"].values.astype(str).tolist() if "position_name" in dataset else ():
            if name in units:  # not the quaternion
                names.setdefault(name, units[name])
    panels = []
    for name, unit in names.items():
        places = [
            int(np.flatnonzero(found)[0])
            if (found := result.record.dataset["position_name"].values == name).any()
            else None
            for result in results
        ]
        columns = _columns(results, "position", "desired_position", places)
        factor, shown = (float(np.rad2deg(1.0)), "deg") if unit == "rad" else (1.0, unit)
        panels.append(_tracked_panel(name.replace("_", " "), shown, results, columns, curves, factor=factor))
    return _view("Base position and joints", panels)


def _view(label: str, panels: Sequence[Json | None]) -> Json | None:
    kept = [panel for panel in panels if panel is not None]
    return {"label": label, "panels": kept} if kept else None


def _columns(
    results: Sequence[Result], actual: str, desired: str, places: Sequence[int | None]
) -> list[tuple[np.ndarray | None, np.ndarray | None]]:
    """Per run one column of a variable and of its reference."""
    columns = []
    for result, place in zip(results, places, strict=True):
        pair = (values_of(result.record, actual), values_of(result.record, desired))
        one, other = (None if values is None or place is None else values[:, place] for values in pair)
        columns.append((one, other))
    return columns


def _tracked_panel(
    title: str,
    axis: str,
    results: Sequence[Result],
    columns: Sequence[tuple[np.ndarray | None, np.ndarray | None]],
    curves: Curves,
    *,
    factor: float,
) -> Json | None:
    traces: list[Json] = []
    seen: set[tuple[int, int]] = set()
    for i, (actual, _) in enumerate(columns):
        if actual is not None:
            time = results[i].record.dataset["time"].values
            traces.append({**curves.curve(time, factor * actual), "run": i, "dash": results[i].dash, "width": 2})
    for i, (_, desired) in enumerate(columns):
        if desired is not None:
            curve = curves.curve(results[i].record.dataset["time"].values, factor * desired)
            if (curve["x"], curve["y"]) not in seen:
                seen.add((curve["x"], curve["y"]))
                traces.append({**curve, "name": "reference", "dash": "dot", "ink": True, "width": 1})
    if not any("run" in trace for trace in traces):
        return None
    members = [(i, factor * actual) for i, (actual, _) in enumerate(columns) if actual is not None]
    return _panel(title, axis, traces, **_completed_range(results, members))


def _end_effector_view(results: Sequence[Result], curves: Curves) -> Json | None:
    paths: list[Json] = []
    distances: list[Json] = []
    for i, result in enumerate(results):
        actual = values_of(result.record, "end_effector_position")
        desired = values_of(result.record, "desired_end_effector_position")
        if actual is None:
            continue
        paths.append({**_path(actual, curves), "run": i})
        if desired is not None:
            if not any("ink" in path for path in paths):
                paths.append({**_path(desired, curves), "name": "reference", "ink": True})
            distance = np.linalg.norm(actual - desired, axis=1)
            distances.append({**curves.curve(result.record.dataset["time"].values, distance), "run": i})
    if not paths:
        return None
    first = values_of(results[paths[0]["run"]].record, "end_effector_position")
    if first is not None:
        ends = first[np.unique([0, len(first) - 1])]
        paths.append({**{axis: curves.add(ends[:, k]) for k, axis in enumerate("xyz")}, "ends": True, "name": ""})
    panels: list[Json] = [{"title": "Path in the world frame", "axis": "m", "kind": "space", "traces": paths}]
    if distances:
        panels.append(_panel("Distance from the planned path", "m", distances, log=True))
    return {"label": "End effector", "panels": panels}


def _path(points: np.ndarray, curves: Curves) -> Json:
    every = max(1, -(-len(points) // 600))
    kept = np.unique([*range(0, len(points), every), len(points) - 1])
    return {axis: curves.add(points[kept, k]) for k, axis in enumerate("xyz")}


def _eta_panels(assessed: Sequence[tuple[int, Result, Margins]], curves: Curves) -> list[Json]:
    """The eigenvalues of H^-1 Hhat: one panel for runs that share them."""
    shared: dict[tuple[int, ...], tuple[list[str], list[Json]]] = {}
    for _, result, margin in assessed:
        columns = [curves.curve(margin.times, column) for column in margin.eta.T]
        traces = [
            {**curve, "name": f"eigenvalue {k}", "ink": True, "width": 1.2} for k, curve in enumerate(columns, start=1)
        ]
        shared.setdefault(tuple(curve["y"] for curve in columns), ([], traces))[0].append(result.label)
    return [
        _panel(
            "Inertia ratios η along the planned motion" + ("" if len(shared) == 1 else f": {', '.join(labels)}"),
            "1",
            traces,
            lines=[{"y": 1.0, "text": "believed = true"}],
        )
        for labels, traces in shared.values()
    ]


def _forecast_panel(result: Result, margin: Margins, curves: Curves) -> Json:
    """Of each group, the coordinate whose K_s is expected to come highest: as expected and as recorded."""
    traces: list[Json] = []
    recorded = values_of(result.record, "reaching_gain")
    names = result.record.dataset["coordinate"].values.astype(str).tolist()
    for group, part in margin.coordinates.groups.items():
        forecast = margin.forecast_k_s[:, part]
        if not forecast.shape[1]:
            continue
        k = part.start + int(forecast.max(axis=0).argmax())
        name = margin.coordinates.names[k]
        color = GROUP_COLORS[group]
        expected = curves.curve(margin.forecast_times, margin.forecast_k_s[:, k])
        traces.append({**expected, "name": f"{name}, expected", "color": color, "dash": "dash"})
        if recorded is not None and name in names:
            curve = curves.curve(result.record.dataset["time"].values, recorded[:, names.index(name)])
            traces.append({**curve, "name": f"{name}, recorded", "color": color})
    limit = float(np.nanmin(margin.k_s_limit))
    highest = [float(margin.forecast_k_s.max())]
    if recorded is not None and np.isfinite(recorded).any():
        highest.append(min(float(recorded[np.isfinite(recorded)].max()), 2.0 * limit))
    return _panel(
        f"Kₛ, expected (dashed) and recorded: {result.label}",
        "1/s",
        traces,
        lines=[{"y": limit, "text": "limit"}],
        legend=True,
        range=[0.0, 1.15 * max(limit, *highest)],
    )


def _map_panel(i: int, result: Result, margin: Margins, curves: Curves) -> Json:
    """Where the coordinate with the least margin is stable: K_s, or without K_s the sample time, against eta."""
    eta = np.linspace(*_MAP_ETA)
    band = [float(margin.eta.min()), float(margin.eta.max())]
    if np.isfinite(margin.k_s_limit).any():
        axis = int(np.nanargmin(margin.k_s_limit / np.maximum(margin.forecast_k_s.max(axis=0), 1e-9)))
        limit = np.array([largest_stable_k_s(margin.law, axis, eta=x, sampling=margin.sampling) for x in eta])
        used = np.array([margin.law.k_s[axis], margin.forecast_k_s[:, axis].max()])
        names = ["Kₛ at the start", "largest expected Kₛ"]
        unit, what = "Kₛ [1/s]", "Kₛ"
    else:
        axis = int(np.nanargmin(margin.sample_time_limit))
        limit = 1e3 * np.array([largest_sample_time(margin.law, axis, eta=x, sampling=margin.sampling) for x in eta])
        used = np.array([1e3 * margin.scenario.sample_time])
        names = ["sample time in use"]
        unit, what = "L [ms]", "sample time"
    traces: list[Json] = [
        {"x": curves.add(eta), "y": curves.add(limit), "name": "stability limit", "run": i, "below": True, "width": 2}
    ]
    for name, value, symbol in zip(names, used, ("circle", "diamond"), strict=False):
        point = {"x": curves.add(np.array([margin.eta.max()])), "y": curves.add(np.array([value]))}
        traces.append({**point, "name": name, "marker": symbol, "run": i})
    finite = limit[np.isfinite(limit)]
    top = 1.3 * max([float(used.max()), float(np.interp(band[1], eta, np.nan_to_num(limit)))] + (
        [float(np.median(finite))] if finite.size else []
    ))  # fmt: skip
    name = margin.coordinates.names[axis].replace("_", " ")
    return {
        "title": f"Stable below the curve, {what} of {name}: {result.label}",
        "axis": unit,
        "kind": "map",
        "x_title": "inertia ratio η; shaded: met along the motion",
        "traces": traces,
        "band": band,
        "legend": True,
        "range": [0.0, top],
    }
