"""Cases and controllers -> rows. This runs in the workers."""

import itertools
import os
import resource
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ffsm_drake.common.errors import BlockError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.campaign.cases import Case, scenario_of, with_controller
from ffsm_drake.plugins.campaign.prediction import predict_many
from ffsm_drake.plugins.campaign.rows import (
    DRAKE_DIFFERENCE,
    DRAKE_OUTCOME,
    ENGINE,
    NO_PREDICTION,
    Row,
    engine_columns,
    evaluate_run,
    failure_row,
    metrics_of,
    predictions_of,
    signals_of,
)
from ffsm_drake.plugins.campaign.spec import Spec, spec_from_json
from ffsm_drake.runs.batches import Kept, run_many
from ffsm_drake.runs.engine import DRAKE
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.record import software_versions
from ffsm_drake.systems.grasping import GRASPINGS
from ffsm_drake.systems.reference import timed

_COMPARED = 100  # one case in so many runs with Drake, too
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


def resident_memory() -> float:
    """Memory of this process that is in use, MiB; its peak where the system does not report it."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)
