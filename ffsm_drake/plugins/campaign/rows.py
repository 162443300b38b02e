"""The row of a run in a campaign: its columns, and what a run's log gives for them."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import LimitError, one_line
from ffsm_drake.common.numbers import number
from ffsm_drake.loop.blocks import is_rehearsed, parts_of
from ffsm_drake.plugins.campaign.spec import OLD_ENGINE, Spec
from ffsm_drake.plugins.design.limits_left import CLEARANCE, distances_in, limits_left
from ffsm_drake.runs.ending import GROWING, NOT_CAPTURED
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.exceeded_limits import not_measured
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.metrics import METRICS, drift_metrics, frame_figures
from ffsm_drake.spacecraft.clearance import in_words
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.registry import section_parts

# refused: no motion keeps the limits
UNSETTLED = ("not_settled", "growing", *NOT_CAPTURED, "diverged")
COMPLETED = ("settled", "not_settled", "growing")  # runs that reached their end
OUTCOMES = ("settled", *UNSETTLED, "refused", "error")
PREDICTIONS = ("predicted_radius_starting", "predicted_radius_expected")
# FIRST_LIMIT, which a run with a capture exceeds first, is text.
LOAD, FIRST_LIMIT = "predicted_load", "first_limit"
# Further columns with another engine than Drake: the engine of the run; if the run was repeated
# with Drake, its outcome and the largest difference of the errors, rad and m.
ENGINE, DRAKE_OUTCOME, DRAKE_DIFFERENCE = "engine", "drake_outcome", "drake_difference"
DIVERGENCE = "predicted_divergence"  # with parts that are rehearsed
NO_PREDICTION = "no prediction: "  # in the message of a run whose loop cannot be linearised


def texts_of(spec: Spec) -> tuple[str, ...]:
    """Return the columns of a campaign that hold text of a run's limits: those of a capture."""
    return (FIRST_LIMIT,) if spec.base_scenario.grasps else ()


def engine_columns(spec: Spec) -> tuple[str, ...]:
    """Return the columns of a campaign on the engine of its runs; none with Drake."""
    name = OLD_ENGINE if OLD_ENGINE in spec.data else ENGINE
    return () if spec.engine == DRAKE else (name, DRAKE_OUTCOME, DRAKE_DIFFERENCE)


@dataclasses.dataclass(frozen=True, eq=False)
class Judged:
    """A run, as a campaign's own metrics read it."""

    spec: Spec
    log: RunLog

    @functools.cached_property
    def settled_time(self) -> float | None:
        """s; None: not settled."""
        log = self.log
        if not log.outcome.completed or log.ending.gave_up:
            return None
        velocity = log.series["state"][:, len(log.coordinates.position_names) :]
        driven = velocity[:, log.coordinates.driven]
        return self.spec.settled.time(log.time, log.tracked, velocity=driven)

    @property
    def unsettled(self) -> str:
        """Which error is farthest beyond its bound over the last ``hold`` s, or what moves."""
        tracked, settled = self.log.tracked, self.spec.settled
        last = self.log.time >= self.log.time[-1] - settled.hold - 5e-10
        bound = np.array([settled.tolerance[group] for group in tracked.groups])
        largest = np.abs(tracked.error[last]).max(axis=0, initial=0.0)
        k = int(np.argmax(largest / np.maximum(bound, 1e-300)))
        if largest[k] <= bound[k]:
            return f"within the tolerance, but moving faster than {settled.rest} rad/s or m/s"
        return (
            f"{tracked.names[k]}: up to {number(largest[k], 3)} {tracked.units[k]} in the last "
            f"{settled.hold:g} s, tolerance {number(bound[k], 3)}"
        )

    @functools.cached_property
    def _near(self) -> Any:
        return distances_in(self.log)

    @functools.cached_property
    def left(self) -> dict[str, float]:
        """Limits that it exceeds, and since when, s."""
        return limits_left(self.log, self._near)

    @property
    def first(self) -> str:
        """The limit that it exceeds first; empty: none."""
        return min(self.left, key=lambda name: self.left[name], default="")

    @property
    def failed(self) -> str:
        """What a component of a part does first beyond a limit, if this is no success; empty:
        nothing.
        """
        parts = [placed.part for placed in self.log.parts.values()]
        limits = [each for part in parts for each in part.limits(self.log.coordinates)]
        found = [
            (self.left[limit.told(i)], f"{name} {limit.fails}")
            for limit in limits
            for i, name in enumerate(limit.names)
            if limit.fails and limit.told(i) in self.left
        ]
        return "{1} at t = {0:.2f} s".format(*min(found)) if found else ""

    @property
    def closest(self) -> float | None:
        """Least distance of two bodies, m; below 0 they overlap."""
        closest = float(self._near[1].min(initial=np.inf))
        return closest if math.isfinite(closest) else None

    def impulse(self, rows: slice) -> float | None:
        """Size of the grasp's impulse, angular (rows 0 to 2) or linear."""
        contact = None if self.log.grasp is None else self.log.grasp.contact
        return None if contact is None else float(np.linalg.norm(contact.impulse[rows]))

    def frame(self, moment: str, part: str) -> float | None:
        """``largest`` or ``final`` error of the frame."""
        return frame_figures(self.log.table).get(moment, {}).get(part)

    def drift(self, group: str) -> float:
        """Final drift of the undriven base."""
        return drift_metrics(self.log.table)["final"][group]


_SETTLED = Metric(
    key="settled_time", unit="s", label="settled after", of=lambda run: run.settled_time
)
_OF_CAPTURE = (
    Metric(
        key="grasp_impulse", unit="N s", label="impulse of the grasp",
        of=lambda run: run.impulse(slice(3, 6)),
    ),
    Metric(
        key="grasp_angular_impulse", unit="N m s", label="angular",
        of=lambda run: run.impulse(slice(0, 3)),
    ),
    Metric(
        key="first_limit_time", unit="s", heading="",
        of=lambda run: run.left.get(run.first),
    ),
    Metric(key="closest_distance", unit="m", heading="", of=lambda run: run.closest),
)  # fmt: skip
_OF_FRAME = {
    part: tuple(
        Metric(
            key=f"{moment}_frame_{part}", unit=unit, heading=heading,
            of=functools.partial(Judged.frame, moment=moment, part=part),
        )
        for moment, heading in (("largest", ""), ("final", f"frame's final {word} error [{unit}]"))
    )
    for part, word, unit in (("rotation", "attitude", "rad"), ("position", "position", "m"))
}  # fmt: skip
_OF_DRIFT = {
    group: Metric(
        key=f"final_drift_{part}", unit=unit, label=f"base {moved} by",
        of=functools.partial(Judged.drift, group=group),
    )
    for group, part, unit, moved in (
        ("base_rotation", "rotation", "rad", "turned"),
        ("base_position", "position", "m", "moved"),
    )
}  # fmt: skip


def metric_tables(spec: Spec) -> list[tuple[Metric, ...]]:
    """Return the metrics of a campaign's runs, by table of its page."""
    of_capture, *others = _judged(spec)
    of_parts = (tuple(part.metrics()) for part in parts_of_campaign(spec))
    return [(*METRICS, _SETTLED), of_capture, *of_parts, *others]


def _judged(spec: Spec) -> list[tuple[Metric, ...]]:
    """Return the metrics beside _SETTLED that read a ``Judged`` run."""
    return [
        _OF_CAPTURE if texts_of(spec) else (),
        *(_OF_FRAME[part] for part in _frame_parts(spec)),
        tuple(_OF_DRIFT[group] for group in spec.base_scenario.undriven),
    ]


def metrics_of(spec: Spec) -> tuple[str, ...]:
    """Return the columns of a campaign that a run's metrics fill."""
    metrics = itertools.chain(*metric_tables(spec))
    return tuple(metric.column_name for metric in metrics if metric.column_name)


def parts_of_campaign(spec: Spec) -> tuple[Part, ...]:
    """Return the parts of a campaign's scenario."""
    return (*section_parts(spec.base_scenario).values(), *parts_of(spec.base_scenario).values())


def signals_of(spec: Spec) -> tuple[str, ...] | None:
    """Return the signals that the metrics of a campaign's runs read; None: any."""
    if texts_of(spec) or any(part.metrics() for part in parts_of_campaign(spec)):
        return None
    return ("state", "hidden_state", "generalized_force", "desired_state", "desired_frame")


def _frame_parts(spec: Spec) -> tuple[str, ...]:
    """Prescribed parts of a frame's pose: ``rotation``, ``position``, both or none."""
    frame = spec.base_scenario.reference.frame
    parts = {"pose": tuple(_OF_FRAME), "attitude": ("rotation",), "position": ("position",)}
    return () if frame is None else parts.get(frame.task, ())


def predictions_of(spec: Spec) -> tuple[str, ...]:
    """Return the columns of a campaign's predictions; all below 1: the run is predicted to
    settle.
    """
    load = (LOAD,) if texts_of(spec) else ()
    return (*PREDICTIONS, *load, *((DIVERGENCE,) if is_rehearsed(spec.base_scenario) else ()))


# Columns that differ between repetitions.
CIRCUMSTANCES = ("wall_time", "worker", "rss_mib", "software")

Row = dict[str, Any]


def evaluate_run(spec: Spec, log: RunLog) -> Row:
    """Outcome and metrics of a run."""
    if log.outcome.status == "interrupted":
        raise KeyboardInterrupt
    run, outcome, message = Judged(spec, log), log.outcome.status, log.outcome.message
    if log.outcome.completed:
        outcome, message = "settled", ""
        if run.settled_time is None:
            outcome, message = "not_settled", run.unsettled
        if log.ending.status == GROWING:
            outcome, message = "growing", log.ending.sentence
    values = {each.column_name: each.of(log.table) for each in METRICS if each.column_name}
    for metric in (_SETTLED, *itertools.chain(*_judged(spec))):
        values[metric.column_name] = metric.of(run)
    text = {"outcome": outcome, "message": message}
    if texts_of(spec):
        text[FIRST_LIMIT] = run.first
        if outcome == "settled" and CLEARANCE in run.left:
            told, closest = next(not_measured(log.scenario), ""), run.closest
            if not told and closest is not None:
                told = (
                    f"parts come too near at t = {run.left[CLEARANCE]:.2f} s, and "
                    f"{in_words(closest, 'as near as {}')}"
                )
            text |= {"outcome": "not_settled", "message": told}
    if text["outcome"] == "settled" and run.failed:
        text |= {"outcome": "not_settled", "message": run.failed}
    values |= {each.column_name: each.value for each in log.figures if each.column_name}
    # The database knows no NaN.
    row = {
        name: None if value is None or math.isnan(value) else float(value)
        for name, value in values.items()
    }
    return {**text, "outcome_time": log.outcome.time, **row}


def failure_row(error: BaseException) -> Row:
    """Return the results in the row of a run that failed, or is refused: no motion keeps the
    limits.
    """
    text, kind = one_line(error), type(error).__name__
    row = {"outcome": "error", "outcome_time": None, "message": text, FIRST_LIMIT: None}
    if isinstance(error, LimitError):
        return row | {"outcome": "refused", FIRST_LIMIT: error.limit}
    return row if text.startswith(kind) else row | {"message": f"{kind}: {text}"}


def differing_columns(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Columns with differences, among those to be reproduced bit for bit by a repeated run."""
    compared = {*first} & {*second} - {*CIRCUMSTANCES, *PREDICTIONS, LOAD, DIVERGENCE}
    return [name for name in first if name in compared and first[name] != second[name]]
