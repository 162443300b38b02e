"""Figures of merit of a run, computed from its recorded time series.

Sums run over the control samples t_k = k L that begin a recorded period, with tau_k the value held
over [t_k, t_{k+1}).
"""

import functools
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ffsm_drake.common.numbers import usable
from ffsm_drake.runs.table import driven_of, held_force, with_role
from ffsm_drake.runs.tracking import tracked_of
from ffsm_drake.spacecraft.coordinates import (
    GROUPS,
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.signals import INTERNAL_TORQUE

if TYPE_CHECKING:
    from ffsm_drake.runs.table import Labelled


_Some = TypeVar("_Some", bound="Labelled")
# Twelve times the rate at the first and the second of five samples, per period, by all five.
_RATE = np.array([[-25.0, 48.0, -36.0, 16.0, -3.0], [-3.0, -10.0, 18.0, -6.0, 1.0]])
_IN_BALANCE = (
    "position",
    "velocity",
    "applied_force",
    "disturbance_force",
    "linear_momentum",
    "angular_momentum",
)


def compute_metrics(dataset: "Labelled") -> dict[str, Any]:
    """All metrics of a run's dataset (see RunRecord.dataset), as plain numbers.

    Keys: the keys of ``tracking_metrics``, and
      momentum_residual: largest norm, over the run or its phases, of the momentum's change minus
        the impulse of the external forces, ``linear`` (N s) and ``angular`` (N m s, about the
        world's origin): the integrator's error.
      phases: for a run with a capture, the metrics of
        ``tracking_metrics`` by phase, each over its own time.
      drift: for a run with undriven coordinates, the metrics of
        ``drift_metrics``.
      frame: for a run with a reference for the pose of a frame, the metrics of
        ``frame_figures``.
    """
    phases = phases_of(dataset)
    residuals = [momentum_residual(part) for part in phases.values() or [dataset]]
    sizes = {
        name: max(float(np.linalg.norm(residual[name], axis=1).max()) for residual in residuals)
        for name in residuals[0]
    }
    further = {
        "phases": {name: tracking_metrics(part) for name, part in phases.items()},
        "drift": drift_metrics(dataset),
        "frame": frame_figures(dataset),
    }
    found = {name: figures for name, figures in further.items() if figures}
    return tracking_metrics(dataset) | found | {"momentum_residual": sizes}


def frame_figures(dataset: "Labelled") -> dict[str, Any]:
    """``largest`` and ``final`` size of a frame's pose error, of the prescribed parts ``rotation``
    (angle, rad) and ``position`` (m), and its smallest singular value, if known; empty if no frame
    has a reference.
    """
    if "frame_error" not in dataset or not len(dataset["time"].values):
        return {}
    error, prescribed = dataset["frame_error"].values, dataset["frame_prescribed"].values
    parts = {"rotation": slice(0, 3), "position": slice(3, 6)}
    figures: dict[str, Any] = _largest_and_final({
        name: error[:, part] for name, part in parts.items() if prescribed[part].any()
    })  # fmt: skip
    if "smallest_singular_value" in dataset:
        figures["smallest_singular_value"] = float(dataset["smallest_singular_value"].values.min())
    return figures


def drift_metrics(dataset: "Labelled") -> dict[str, dict[str, float]]:
    """Drift of the base: ``largest`` and ``final`` distance from its start, for each undriven group
    an angle, rad, or a distance, m; empty if everything is driven.
    """
    undriven = {*dataset["group"].values[~driven_of(dataset)].astype(str).tolist()}
    if not undriven or "position" not in dataset or not len(dataset["time"].values):
        return {}
    base = dataset["position"].values[:, :NUM_BASE_POSITIONS]
    moved = position_errors(base, np.broadcast_to(base[0], base.shape))
    parts = {"base_rotation": moved[:, :3], "base_position": moved[:, 3:]}
    return _largest_and_final({name: part for name, part in parts.items() if name in undriven})


def _largest_and_final(parts: Mapping[str, np.ndarray]) -> dict[str, dict[str, float]]:
    """``largest`` and ``final`` norm of vectors (n, 3), by name."""
    sizes = {name: np.linalg.norm(part, axis=1) for name, part in parts.items()}
    return {
        "largest": {name: float(size.max()) for name, size in sizes.items()},
        "final": {name: float(size[-1]) for name, size in sizes.items()},
    }


def phases_of(dataset: _Some) -> dict[str, _Some]:
    """Return the parts of a run with a capture, by phase; empty for one without."""
    if "phase" not in dataset.coords:
        return {}
    phase = dataset["phase"].values.astype(str)
    names = map(str, dict.fromkeys(phase))
    parts: dict[str, Any] = {name: dataset.isel(time=phase == name) for name in names}
    return parts


# Largest or final size -> variable.
SIZES = {
    "peak_error": "error",
    "final_error": "error",
    "peak_effort": "generalized_force",
    "peak_applied": "applied_force",
}


def of_group(figure: str, group: str, data: "Labelled", unit: str = "") -> float | None:
    """Return the largest ``peak_error``, ``final_error``, ``peak_effort`` (commanded) or
    ``peak_applied`` of a group's coordinates, or of those with a unit; None if there are none.

    For an undriven group, and for joints controlled through a frame, the error is the distance from
    their motion with the nominal payload.
    """
    members = data["group"].values.astype(str) == group
    if unit:
        members &= data["unit"].values.astype(str) == unit
    sizes = np.abs(data[SIZES[figure]].values[:, members])
    sizes = sizes[-1] if figure == "final_error" else sizes
    return float(sizes.max()) if members.any() else None


def _of_unit(figure: str, unit: str, data: "Labelled") -> float:
    """Return the largest tracked error in a unit; NaN if there is none."""
    tracked = tracked_of(data)
    error = np.abs(tracked.error[:, [each == unit for each in tracked.units]])
    error = error[-1] if figure == "final_error" else error
    return float(error.max()) if error.size else math.nan


def itae_of(data: "Labelled") -> float:
    """Return ``itae`` of the tracked errors of a run's time series."""
    time = data["time"].values
    error = tracked_of(data).error
    return itae(time[:-1] - time[0], error[:-1], float(data.attrs["sample_time"]))


# Figure -> headings on a campaign's page, with units, by group.
_HEADINGS = {
    "peak_error": ("peak attitude error [rad]", "", "peak joint error [rad or m]"),
    "final_error": ("", "", ""),
    "peak_effort": (
        "peak base torque [N m]",
        "peak base force [N]",
        "peak joint effort [N m or N]",
    ),
}
_in_table = functools.partial(Metric, key="", column="")
# Figures of merit of every run: those with a key in ``metrics.json``, with a label in tables, with
# a column in campaigns. Their functions read the variables of ``RunLog.table``, of at least one
# sample.
METRICS = (
    Metric(
        key="itae", unit="1", label="ITAE", heading="ITAE", ranked=True,
        of=itae_of,
    ),
    Metric(
        key="isv", unit="1", label="ISV", heading="ISV", ranked=True,
        of=lambda data: isv(
            data["generalized_force"].values[:-1], float(data.attrs["sample_time"])
        ),
    ),
    *(
        Metric(
            key=f"{figure}.{group}", unit="", heading=heading,
            of=functools.partial(of_group, figure, group),
        )
        for figure, headings in _HEADINGS.items()
        for group, heading in zip(GROUPS, headings, strict=True)
    ),
    *(
        _in_table(
            label=figure.replace("_", " "), unit=unit, of=functools.partial(_of_unit, figure, unit)
        )
        for figure in ("peak_error", "final_error")
        for unit in ("rad", "m")
    ),
    *(
        _in_table(
            label=label, unit=shown,
            of=functools.partial(of_group, "peak_effort", group, unit=unit),
        )
        for label, shown, group, unit in (
            ("peak force", "base, N", "base_position", "m"),
            ("peak torque", "base, N m", "base_rotation", "rad"),
            ("peak torque", "joints, N m", "joints", "rad"),
            ("peak force", "joints, N", "joints", "m"),
        )
    ),
)  # fmt: skip


def tracking_metrics(data: "Labelled") -> dict[str, Any]:
    """Accuracy and effort of a run's time series, or of a part of them, as plain numbers: its
    METRICS by key.

    Keys:
      itae: sum of t |e|_1 L (equation (22)), with the tracked errors e.
      isv: sum of |tau|_2^2 L (equation (23)).
      peak_error, final_error, peak_effort: by group, the largest |e| of the run, the largest |e| of
        the last sample (rad or m), the largest |tau| (N m or N), each over the group's coordinates.
    """
    found: dict[str, Any] = {}
    for metric in METRICS:
        name, _, group = metric.key.partition(".")
        if group and (value := metric.of(data)) is not None:
            found.setdefault(name, {})[group] = value
        elif name and not group:
            found[name] = metric.of(data)
    return found


def itae(time: np.ndarray, error: np.ndarray, period: float) -> float:
    """Integral of t |e|_1 over the samples (equation (22)); time (n,), error (n, nv)."""
    return float(np.sum(time * np.abs(error).sum(axis=1)) * period)


def isv(effort: np.ndarray, period: float) -> float:
    """Integral of |tau|_2^2 over the samples (equation (23)); effort (n, nv)."""
    return float(np.sum(effort * effort) * period)


def momentum_residual(dataset: "Labelled") -> dict[str, np.ndarray]:
    """Change of ``linear`` and ``angular`` momentum minus the impulse of the external forces, each
    (n, 3), world frame.

    Only the base's force and torque are external; joint torques act between bodies. The control
    force is constant over each period, the disturbance smooth over all of them, and the base's path
    is a cubic through recorded positions and velocities; for an exact integrator the residual is
    then small against every force's impulse. It ends before the first sample that is not finite
    (the last one of some diverged runs).
    """
    dataset = usable_start(dataset, _IN_BALANCE)
    linear, angular = (dataset[f"{name}_momentum"].values for name in ("linear", "angular"))
    change = {"linear": linear - linear[0], "angular": angular - angular[0]}
    period = np.diff(dataset["time"].values)[:, None]
    if not period.size:
        return change
    position = dataset["position"].values[:, 4:NUM_BASE_POSITIONS]
    velocity = dataset["velocity"].values[:, 3:NUM_BASE_VELOCITIES]
    (held_torque, held), (smooth_torque, smooth) = (
        np.split(force[:, :NUM_BASE_VELOCITIES], 2, axis=1)
        for force in (held_force(dataset)[:-1], dataset["disturbance_force"].values)
    )
    for name in with_role(dataset, INTERNAL_TORQUE):  # which is not external
        held_torque = held_torque - dataset[name].values[:-1]
    path = _integrals(position, velocity, period)
    return {
        "linear": change["linear"] - _impulse(held * period, smooth, period),
        "angular": change["angular"]
        - _impulse(
            held_torque * period + np.cross(path, held),
            smooth_torque + np.cross(position, smooth),
            period,
        ),
    }


def usable_start(dataset: Any, names: Iterable[Any], *, least: int = 1) -> Any:
    """Return the samples of a run before the first where one of some variables is not ``usable``,
    which ends the record of a diverged run; at least so many.
    """
    good = np.logical_and.reduce([usable(dataset[name].values) for name in names])
    count = good.size if good.all() else max(least, int(np.argmin(good)))
    return dataset.isel(time=slice(0, count))


def _impulse(held: np.ndarray, smooth: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Impulse since the start (n, 3), of impulses in each period (n - 1, 3) and smooth forces
    (n, 3).
    """
    each = held + _integrals(smooth, _rates(smooth, period), period)
    return np.vstack([np.zeros(3), np.cumsum(each, axis=0)])


def _integrals(values: np.ndarray, rates: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Integrals (n - 1, 3) from each sample to the next, of the cubic through values and rates (n,
    3).
    """
    mean = 0.5 * (values[:-1] + values[1:])
    return period * (mean + period / 12.0 * (rates[:-1] - rates[1:]))


def _rates(values: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Rates (n, 3) of values at equal periods (n - 1, 1), to fourth order if n permits."""
    if len(values) < len(_RATE[0]):
        return np.asarray(np.gradient(values, period[0, 0], axis=0))
    rates = np.empty_like(values)
    rates[2:-2] = values[:-4] - 8.0 * values[1:-3] + 8.0 * values[3:-1] - values[4:]
    for i, weights in enumerate(_RATE):
        rates[i], rates[-1 - i] = weights @ values[:5], -(weights @ values[:-6:-1])
    return rates / (12.0 * period.mean())
