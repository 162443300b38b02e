"""One case and controller -> one row. This runs in the workers."""

import dataclasses
import functools
import itertools
import math
import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError, LimitError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import number
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.loop.blocks import is_rehearsed, parts_of
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.campaign.cases import Case, scenario_of, with_controller
from ffsm_drake.plugins.campaign.prediction import predict_many
from ffsm_drake.plugins.campaign.spec import OLD_ENGINE, Spec, spec_from_json
from ffsm_drake.runs.batches import Kept, run_many
from ffsm_drake.runs.ending import GROWING, NOT_CAPTURED
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.exceeded_limits import CLEARANCE, distances_in, limits_left, not_measured
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.metrics import METRICS, drift_metrics, frame_figures
from ffsm_drake.runs.record import software_versions
from ffsm_drake.spacecraft.clearance import in_words
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.reference import timed
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
_COMPARED = 100  # one case in so many runs with Drake, too
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
Foreseen = tuple[float, ...] | Exception  # predictions of a run, or why there are none


Batch = tuple[tuple[Case, str], ...]  # runs that a worker computes together: case, controller


def batches(tasks: Iterator[tuple[Case, str]], *, size: Callable[[], int]) -> Iterator[Batch]:
    """Runs in their order, at most ``size()`` in a batch."""
    while some := tuple(itertools.islice(tasks, size())):
        yield some


def alone(batch: Batch) -> tuple[Batch, ...]:
    """Return a batch for each run."""
    return tuple((run,) for run in batch)


# A cluster's worker may have several threads; a simulator and the building of one serve one.
_ONE_AT_A_TIME = threading.Lock()


def evaluate(campaign: str, batch: Batch) -> list[Row]:
    """Run the runs of a batch; errors become part of the rows, one row for each run.

    Takes ``Spec.to_json()``, which a process reads once. A row has the columns ``outcome``,
    ``outcome_time``, ``message``, those of ``metrics_of`` and ``predictions_of``, CIRCUMSTANCES;
    with a capture FIRST_LIMIT. It does not depend on the others in the batch.
    """
    with _ONE_AT_A_TIME:
        return _evaluator(campaign).evaluate_batch(batch)


@memoized(maxsize=1)
def _evaluator(campaign: str) -> "Evaluator":
    return Evaluator(spec_from_json(campaign))


class Evaluator:
    """Evaluates the cases of one campaign, keeping what it built for the next."""

    def __init__(self, spec: Spec) -> None:
        self._spec = spec
        self._predictions = predictions_of(spec)
        self._columns = (*metrics_of(spec), *self._predictions, *engine_columns(spec))
        self._signals = signals_of(spec)
        self._kept = Kept()
        self._last: tuple[int, Mission] | None = None  # of a case, and its index
        self._software = " ".join(
            f"{name} {version}" for name, version in software_versions().items()
        )

    def evaluate(self, case: Case, controller: str) -> Row:
        """Return the row of one case."""
        (row,) = self.evaluate_batch(((case, controller),))
        return row

    def evaluate_batch(self, batch: Batch) -> list[Row]:
        """Return the rows of a batch, as the function ``evaluate`` returns them."""
        start, count = time.perf_counter(), len(batch)
        if count > 1 and self._spec.engine == DRAKE:
            return self._one_by_one(batch)
        try:
            with guarded, time_limit(self._spec.time_limit * count):
                rows = self._rows(batch)
        except (Exception, TimeLimit) as error:
            self._kept.drop()  # a rollout may be half done
            if count > 1:  # alone each has its own limit, and reports an error
                return self._one_by_one(batch)
            rows = [failure_row(error)]
        circumstances = {
            "wall_time": (time.perf_counter() - start) / count,
            "worker": f"{socket.gethostname()}:{os.getpid()}",
            "rss_mib": resident_memory(),
            "software": self._software,
        }
        return [dict.fromkeys(self._columns) | row | circumstances for row in rows]

    def _one_by_one(self, batch: Batch) -> list[Row]:
        return [row for run in alone(batch) for row in self.evaluate_batch(run)]

    def _rows(self, batch: Batch) -> list[Row]:
        results = self._results(batch)
        logs = {place: found for place, found in results.items() if isinstance(found, RunLog)}
        foreseen = dict[int, Foreseen]()
        if self._spec.predictions:
            predictions = predict_many([log.mission for log in logs.values()])
            foreseen = dict(zip(logs, predictions, strict=True))
        rows = []
        for place, (case, _) in enumerate(batch):
            try:
                if isinstance(found := results[place], Exception):
                    raise found
                row = evaluate_run(self._spec, found) | self._engine_of(found, case)
                if place in foreseen:
                    row |= self._predicted(foreseen[place], row["message"])
            except Exception as error:
                row = failure_row(error)
            rows.append(row)
        return rows

    def _results(self, batch: Batch) -> dict[int, RunLog | Exception]:
        """Return the logs of the runs by their place in the batch, or why there is none.

        The scenarios of a case share all but the controller.
        """
        missions, results = dict[int, Mission](), dict[int, RunLog | Exception]()
        for place, (case, controller) in enumerate(batch):
            try:
                mission = self._mission_of(case, controller)
                missions[place] = mission.of(with_controller(mission.scenario, controller))
            except Exception as error:
                results[place] = error
        places = list(missions)
        found = run_many(
            list(missions.values()),
            engine=self._spec.engine,
            signals=self._signals,
            kept=self._kept,
        )
        return results | {places[at]: result for at, result in found}

    def _mission_of(self, case: Case, controller: str) -> Mission:
        """Return the mission of a case, with any of its controllers."""
        if self._last is None or self._last[0] != case.index:
            mission = timed(make_mission(scenario_of(self._spec, case, controller)))
            if mission.scenario.approach is not None:  # one that is refused would stop all
                GRASPINGS.only("capture.approach").approach(mission)
            self._last = case.index, mission
        return self._last[1]

    def _predicted(self, found: Foreseen, message: str) -> Row:
        """Return the predictions; if there are none, the message gives the reason."""
        if isinstance(found, BlockError):
            why = f"{NO_PREDICTION}{one_line(found)}"
            return {"message": "; ".join(filter(None, (message, why)))}
        if isinstance(found, Exception):
            raise found
        return dict(zip(self._predictions, found, strict=False))

    def _engine_of(self, log: RunLog, case: Case) -> Row:
        """Return the columns ``engine_columns`` of a run."""
        if self._spec.engine == DRAKE:
            return {}
        row: Row = {ENGINE: log.engine}
        if case.index % _COMPARED == 0 and not log.engine.startswith(DRAKE):
            other = self._kept.rollout(log.mission).run(log.mission)
            count = min(log.time.size, other.time.size)
            difference = np.abs(log.error[:count] - other.error[:count]).max()
            outcome = evaluate_run(self._spec, other)["outcome"]
            row |= {DRAKE_OUTCOME: outcome, DRAKE_DIFFERENCE: float(difference)}
        return row


def evaluate_run(spec: Spec, log: RunLog) -> Row:
    """Outcome and metrics of a run."""
    if log.outcome.status == "interrupted":
        raise RuntimeError("the run was interrupted")
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


def resident_memory() -> float:
    """Memory of this process that is in use, MiB; its peak where the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)


def differing_columns(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    """Columns with differences, among those to be reproduced bit for bit by a repeated run."""
    compared = {*first} & {*second} - {*CIRCUMSTANCES, *PREDICTIONS, LOAD, DIVERGENCE}
    return [name for name in first if name in compared and first[name] != second[name]]
