"""One case and controller -> one row. This runs in the workers."""

import contextlib
import dataclasses
import itertools
import math
import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError, FfsmError, LimitError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.loop.blocks import is_rehearsed, parts_of
from ffsm_drake.plugins.campaign.cases import Case, scenario_of
from ffsm_drake.plugins.campaign.prediction import predict
from ffsm_drake.plugins.campaign.spec import Spec, spec_from_json
from ffsm_drake.runs.batches import Kept, batches_of, run_many
from ffsm_drake.runs.ending import GROWING, NOT_CAPTURED
from ffsm_drake.runs.limits import CLEARANCE, distances_in, limits_left
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.metrics import base_drift
from ffsm_drake.runs.record import software_versions
from ffsm_drake.runs.rollout import make_rollout
from ffsm_drake.runs.tracking import frame_metrics, frame_rows
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import GROUPS
from ffsm_drake.spacecraft.dynamics import DRAKE
from ffsm_drake.systems.part import Part
from ffsm_drake.systems.reference import timed
from ffsm_drake.systems.registry import section_parts

# refused: no motion keeps the limits
UNSETTLED = ("not_settled", "growing", *NOT_CAPTURED, "diverged")
COMPLETED = ("settled", "not_settled", "growing")  # runs that reached their end
OUTCOMES = ("settled", *UNSETTLED, "refused", "error")
_BY_GROUP = [
    (kind, group) for kind in ("peak_error", "final_error", "peak_effort") for group in GROUPS
]
METRICS = ("itae", "isv", *(f"{kind}_{group}" for kind, group in _BY_GROUP), "settled_time")
PREDICTIONS = ("predicted_radius_starting", "predicted_radius_expected")
# Further columns of a scenario with a capture; FIRST_LIMIT, which a run exceeds first, is text.
OF_CAPTURE = (
    "grasp_impulse",
    "grasp_angular_impulse",
    "first_limit_time",
    "closest_distance",
)
# Further columns of a frame with a reference: its errors, rad and m.
OF_FRAME = {
    part: (f"largest_frame_{part}", f"final_frame_{part}") for part in ("rotation", "position")
}
# Further columns of an undriven base: its final drift, rad and m.
OF_DRIFT = {"base_rotation": "final_drift_rotation", "base_position": "final_drift_position"}
LOAD, FIRST_LIMIT = "predicted_load", "first_limit"
# Further columns with other dynamics than Drake's: name of the dynamics; if the run was repeated
# with Drake, its outcome and the largest difference of the errors, rad and m.
DYNAMICS, DRAKE_OUTCOME, DRAKE_DIFFERENCE = "dynamics", "drake_outcome", "drake_difference"
_COMPARED = 100  # one case in so many runs with Drake, too
DIVERGENCE = "predicted_divergence"  # with parts that are rehearsed
NO_PREDICTION = "no prediction: "  # in the message of a run whose loop cannot be linearised


def texts_of(spec: Spec) -> tuple[str, ...]:
    """The columns of a campaign that hold text of a run's limits: those of a capture."""
    return (FIRST_LIMIT,) if spec.scenario.grasps else ()


def dynamics_columns(spec: Spec) -> tuple[str, ...]:
    """The columns of a campaign on the dynamics of its runs; none with Drake's."""
    return () if spec.dynamics == DRAKE else (DYNAMICS, DRAKE_OUTCOME, DRAKE_DIFFERENCE)


def metrics_of(spec: Spec) -> tuple[str, ...]:
    """The columns of a campaign that a run's metrics fill."""
    metrics = (metric for part in parts_of_campaign(spec) for metric in part.metrics())
    return (
        *METRICS,
        *(OF_CAPTURE if texts_of(spec) else ()),
        *(metric.column_name for metric in metrics if metric.column_name),
        *(name for part in frame_parts(spec) for name in OF_FRAME[part]),
        *(OF_DRIFT[group] for group in spec.scenario.undriven),
    )


def parts_of_campaign(spec: Spec) -> tuple[Part, ...]:
    """The parts of a campaign's scenario."""
    return (*section_parts(spec.scenario).values(), *parts_of(spec.scenario).values())


def frame_parts(spec: Spec) -> tuple[str, ...]:
    """Prescribed parts of a frame's pose: ``rotation``, ``position``, both or none."""
    frame = spec.scenario.reference.frame
    parts = {"pose": tuple(OF_FRAME), "attitude": ("rotation",), "position": ("position",)}
    return () if frame is None else parts.get(frame.task, ())


def predictions_of(spec: Spec) -> tuple[str, ...]:
    """The columns of a campaign's predictions; all below 1: the run is predicted to settle."""
    load = (LOAD,) if texts_of(spec) else ()
    return (*PREDICTIONS, *load, *((DIVERGENCE,) if is_rehearsed(spec.scenario) else ()))


# Columns that differ between repetitions.
CIRCUMSTANCES = ("wall_time", "worker", "rss_mib", "software")

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Batch:
    """Cases that a worker runs together, with one controller."""

    cases: tuple[Case, ...]
    controller: str

    @property
    def parts(self) -> "tuple[Batch, ...]":
        """One batch for each case."""
        return tuple(dataclasses.replace(self, cases=(case,)) for case in self.cases)


def batches(
    tasks: Iterator[tuple[Case, str]], *, size: int, controllers: Sequence[str]
) -> Iterator[Batch]:
    """Tasks (case, controller) as batches of at most ``size`` cases, nearly in order; as many tasks
    are held as ``size`` cases have.
    """
    while some := list(itertools.islice(tasks, size * len(controllers))):
        for name in controllers:
            cases = tuple(case for case, controller in some if controller == name)
            for first in range(0, len(cases), size):
                yield Batch(cases[first : first + size], name)


# A cluster's worker may have several threads; a simulator and the building of one serve one.
_ONE_AT_A_TIME = threading.Lock()


def evaluate(campaign: str, batch: Batch) -> list[Row]:
    """Run cases with one controller; errors become part of the rows, one row for each case.

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
        self._metrics, self._predictions = metrics_of(spec), predictions_of(spec)
        self._rollouts: dict[str, Kept] = {}  # by controller
        self._software = " ".join(
            f"{name} {version}" for name, version in software_versions().items()
        )

    def evaluate_batch(self, batch: Batch) -> list[Row]:
        """The rows of a batch, as the function ``evaluate`` returns them."""
        start = time.perf_counter()
        logs = self._side_by_side(batch)
        share = (time.perf_counter() - start) / max(len(logs), 1)
        rows = []
        for case in batch.cases:
            rows.append(self.evaluate(case, batch.controller, log=logs.get(case.index)))
            rows[-1]["wall_time"] += share if case.index in logs else 0.0
        return rows

    def _side_by_side(self, batch: Batch) -> dict[int, RunLog]:
        """The logs of those cases that can run side by side, by their number."""
        scenarios: dict[int, Scenario] = {}
        for case in batch.cases if len(batch.cases) > 1 else ():
            with contextlib.suppress(Exception):  # the row reports the error
                scenarios[case.index] = timed(scenario_of(self._spec, case, batch.controller))
        numbers = list(scenarios)
        groups = batches_of(list(scenarios.values()), len(numbers))
        chosen = [numbers[place] for group in groups if len(group) > 1 for place in group]
        limit, logs = self._spec.time_limit * max(len(chosen), 1), dict[int, RunLog]()
        # alone each has its own, and reports an error
        with contextlib.suppress(TimeLimit, FfsmError), time_limit(limit):
            given = [scenarios[number] for number in chosen]
            for place, result in run_many(given, dynamics=self._spec.dynamics):
                if isinstance(result, RunLog):
                    logs[chosen[place]] = result
        return logs

    def evaluate(self, case: Case, controller: str, *, log: RunLog | None = None) -> Row:
        """The row of one case; ``log`` is that of its run, if it has run."""
        start = time.perf_counter()
        own = dynamics_columns(self._spec)
        row: Row = dict.fromkeys((*self._metrics, *self._predictions, *own))
        try:
            with guarded, time_limit(self._spec.time_limit):
                if log is None:
                    log = self._run(timed(scenario_of(self._spec, case, controller)))
                row |= evaluate_run(self._spec, log) | self._dynamics_of(log, case)
                if self._spec.predictions:
                    row |= self._predicted(log.scenario, row["message"])
        except LimitError as error:  # no motion keeps the limits
            refused = {"outcome": "refused", FIRST_LIMIT: error.limit}
            row = dict.fromkeys(row) | error_row(str(error)) | refused
        except (Exception, TimeLimit) as error:
            if isinstance(error, TimeLimit):
                self._rollouts.pop(controller, None)  # it may be half done
            row = dict.fromkeys(row) | error_row(described(error))
        return row | {
            "wall_time": time.perf_counter() - start,
            "worker": f"{socket.gethostname()}:{os.getpid()}",
            "rss_mib": resident_memory(),
            "software": self._software,
        }

    def _predicted(self, scenario: Scenario, message: str) -> Row:
        """The predictions; if there are none, the message gives the reason."""
        try:
            return dict(zip(self._predictions, predict(scenario), strict=False))
        except BlockError as error:
            why = f"{NO_PREDICTION}{one_line(error)}"
            return {"message": "; ".join(filter(None, (message, why)))}

    def _dynamics_of(self, log: RunLog, case: Case) -> Row:
        """The columns ``dynamics_columns`` of a run."""
        if self._spec.dynamics == DRAKE:
            return {}
        row: Row = {DYNAMICS: log.dynamics}
        if case.index % _COMPARED == 0 and not log.dynamics.startswith(DRAKE):
            other = self._run_with_drake(log.scenario)
            count = min(log.time.size, other.time.size)
            difference = np.abs(log.error[:count] - other.error[:count]).max()
            outcome = evaluate_run(self._spec, other)["outcome"]
            row |= {DRAKE_OUTCOME: outcome, DRAKE_DIFFERENCE: float(difference)}
        return row

    def _run(self, scenario: Scenario) -> RunLog:
        if self._spec.dynamics == DRAKE:
            return self._run_with_drake(scenario)
        ((_, result),) = run_many([scenario], dynamics=self._spec.dynamics)
        if isinstance(result, Exception):
            raise result
        return result

    def _run_with_drake(self, scenario: Scenario) -> RunLog:
        kept = self._rollouts.setdefault(scenario.controller, Kept(make_rollout))
        log: RunLog = kept.rollout(scenario, scenario).run(scenario)
        return log


def evaluate_run(spec: Spec, log: RunLog) -> Row:
    """Outcome and metrics of a run."""
    if log.outcome.status == "interrupted":
        raise RuntimeError("the run was interrupted")
    settled_time, outcome, message = None, log.outcome.status, log.outcome.message
    if log.outcome.completed:
        velocity = log.series["state"][:, len(log.coordinates.position_names) :][
            :, log.coordinates.driven
        ]
        settled_time = spec.settled.time(log.time, log.tracked, velocity=velocity)
        if log.ending.gave_up:
            settled_time = None
        outcome, message = "not_settled" if settled_time is None else "settled", ""
        if log.ending.status == GROWING:
            outcome, message = "growing", log.ending.sentence
    metrics = log.metrics
    values = {"itae": metrics["itae"], "isv": metrics["isv"], "settled_time": settled_time}
    values |= {f"{kind}_{group}": metrics[kind][group] for kind, group in _BY_GROUP}
    text = {"outcome": outcome, "message": message}
    if texts_of(spec):
        near = distances_in(log)
        left, closest = limits_left(log, near), float(near[1].min(initial=np.inf))
        values["closest_distance"] = closest if math.isfinite(closest) else None
        first = min(left, key=lambda name: left[name], default="")
        text[FIRST_LIMIT], values["first_limit_time"] = first, left.get(first)
        if outcome == "settled" and CLEARANCE in left:
            text |= {
                "outcome": "not_settled",
                "message": f"parts come too near at t = {left[CLEARANCE]:.2f} s, and within "
                f"{closest:.3g} m of each other (below 0 they overlap)",
            }
        if log.grasp is not None and log.grasp.contact is not None:
            angular, linear = np.split(log.grasp.contact.impulse, 2)
            values["grasp_angular_impulse"] = float(np.linalg.norm(angular))
            values["grasp_impulse"] = float(np.linalg.norm(linear))
    if log.frame_error is not None:
        sizes = frame_metrics(log.frame_error, frame_rows(log.scenario))
        for part in frame_parts(spec):
            for column, moment in zip(OF_FRAME[part], ("largest", "final"), strict=True):
                values[column] = sizes[moment][part]
    if undriven := spec.scenario.undriven:
        drift = base_drift(log.series["state"], undriven)["final"]
        values |= {OF_DRIFT[group]: size for group, size in drift.items()}
    values |= {each.column_name: each.value for each in log.figures if each.column_name}
    # The database knows no NaN.
    row = {
        name: None if value is None or math.isnan(value) else float(value)
        for name, value in values.items()
    }
    return {**text, "outcome_time": log.outcome.time, **row}


def described(error: BaseException) -> str:
    """An exception on one line, its type in front."""
    text, kind = one_line(error), type(error).__name__
    return text if text.startswith(kind) else f"{kind}: {text}"


def error_row(message: str) -> Row:
    """The results in the row of a run that failed."""
    return {"outcome": "error", "outcome_time": None, "message": message, FIRST_LIMIT: None}


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
