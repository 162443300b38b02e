"""The driver: cases to workers, rows to the database; stops, resumes, repeats a single run."""

import contextlib
import copy
import dataclasses
import itertools
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ffsm_drake.common.errors import (
    CampaignError,
    FfsmError,
    InterruptedCampaign,
    WorkersError,
)
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.interrupts import go_on_by
from ffsm_drake.common.numbers import counted
from ffsm_drake.common.steps import step
from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.campaign.cases import Case, make_cases, scenario_of
from ffsm_drake.plugins.campaign.evaluate import alone, batches, evaluate
from ffsm_drake.plugins.campaign.rows import (
    CIRCUMSTANCES,
    UNSETTLED,
    Row,
    differing_columns,
    evaluate_run,
    failure_row,
)
from ffsm_drake.plugins.campaign.spec import Spec, check_engine, load_spec
from ffsm_drake.plugins.campaign.store import Shard, Store, check_columns, create_store, open_store
from ffsm_drake.plugins.workers.pool import Runs, Stop, WorkerLost, Workers, local_workers
from ffsm_drake.runs.batches import run_many, usual_batch
from ffsm_drake.runs.engine import find_engine
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.simulate import make_record
from ffsm_drake.systems.reference import timed

# Memory at which a process is replaced: Drake keeps every diagram with a Python system alive, some
# 4 MiB for each closed loop that is built.
MEMORY_LIMIT = 700.0  # MiB
_TRIED = 20
_BATCHES_EACH = 4  # least number for each task in flight
LONGEST = 30.0  # s for a batch: what an interruption may lose, and the silence before its rows
_LOST = {
    **dict.fromkeys(CIRCUMSTANCES),
    "outcome": "error",
    "message": "WorkerLost: the worker process died each time it ran this, or exceeded time_limit",
    "software": "unknown",
}


@dataclasses.dataclass(kw_only=True)
class Progress:
    """Progress of a campaign."""

    before: int  # runs stored by earlier sessions
    total: int
    start: float = dataclasses.field(default_factory=time.perf_counter)
    elapsed: float = 0.0  # s of this session
    session: int = 0  # runs of this session
    failed: int = 0  # runs of this session that ended in an error
    unsettled: int = 0  # runs of this session that ended without settling
    computing: float = 0.0  # s of wall time of this session's runs, in all workers

    def add(self, rows: Sequence[Row]) -> None:
        """Count stored runs."""
        outcomes = [row["outcome"] for row in rows]
        self.elapsed = time.perf_counter() - self.start
        self.session += len(outcomes)
        self.failed += outcomes.count("error")
        self.unsettled += sum(map(outcomes.count, UNSETTLED))
        self.computing += sum(row["wall_time"] or 0.0 for row in rows)

    @property
    def done(self) -> int:
        """Runs stored, those of earlier sessions included."""
        return self.before + self.session

    @property
    def remaining(self) -> float | None:
        """Expected s to the end; None before there is a rate."""
        return (self.total - self.done) * self.elapsed / self.session if self.session else None

    def next_batch(self, most: int) -> int:
        """Number of runs in the next batch: one until runs have shown their time, then as many as
        take LONGEST, as the runs of a batch end together.
        """
        return max(1, min(most, int(LONGEST * self.session / max(self.computing, 1e-9))))

    def __str__(self) -> str:
        """Such as: 120 of 10000 runs (1.2 %), 5.1/s, 32 min left, 3 not settled, 1 error."""
        share = 100.0 * self.done / max(self.total, 1)
        parts = [f"{self.done} of {counted(self.total, 'run')} ({share:.1f} %)"]
        if self.remaining is not None and self.done < self.total:
            parts += [
                f"{self.session / self.elapsed:.2g}/s",
                f"{duration_text(self.remaining)} left",
            ]
        if self.unsettled:
            parts.append(f"{self.unsettled} not settled")
        if self.failed:
            parts.append(counted(self.failed, "error"))
        return ", ".join(parts)


def duration_text(seconds: float) -> str:
    """Return a duration in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def check_cases(spec: Spec) -> None:
    """Build a case of every controller, so that a wrong key is found before anything is run.

    One case may have an impossible value and become an error row; if each of the first few has one,
    the specification is wrong.

    Raises:
      CampaignError, ModelError, ScenarioError: every run would fail.
    """
    check_columns(spec)
    check_engine(spec)
    for controller in spec.controllers:
        problem: Exception | None = None
        for case in itertools.islice(make_cases(spec), _TRIED):
            try:
                name = f"building case {case.index} with {controller}"
                with step(name), guarded, time_limit(spec.time_limit):
                    make_rollout(scenario_of(spec, case, controller)).release()
                break
            except TimeLimit as error:
                raise CampaignError(
                    f"controllers: building the loop with '{controller}' {error}"
                ) from None
            except FfsmError as error:
                problem = problem or error
        else:
            assert problem is not None
            raise problem


def run_campaign(
    spec: Spec | str | Path,
    database: str | Path,
    *,
    workers: int | None = None,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Path:
    """Run a campaign on this machine into a new database.

    Args:
      spec: name of a shipped campaign, path of a file, or a specification from ``load_spec``.
      database: path of the new database.
      workers: number of processes; default: one per processor.
      batch: largest number of runs that a worker gets at once; default: ``usual_batch``. Results do
        not depend on it.
      progress: function that is called after every batch of results.

    Returns: the database, for ``open_store`` and ``ffsm campaign report``.

    Raises:
      CampaignError, ScenarioError, ModelError, BlockError: a value cannot be used, or the database
        cannot be made.

    Example:
      >>> from pathlib import Path
      >>> from ffsm_drake import run_campaign
      >>> from ffsm_drake.plugins.campaign import open_store
      >>> _ = Path("spec.yaml").write_text('''
      ... scenario: postcapture
      ... controllers: [tdc]
      ... cases: 2
      ... overrides: {duration: 0.1}
      ... settled: {hold: 0.1}
      ... parameters: {payload.truth.mass: {distribution: uniform, low: 80, high: 120}}
      ... ''')
      >>> with open_store(run_campaign("spec.yaml", "runs.db", workers=1)) as store:
      ...     list(store.query("SELECT count(*) FROM runs"))
      [(2,)]
    """
    loaded = spec if isinstance(spec, Spec) else load_spec(spec)
    with local_workers(workers or os.cpu_count() or 1) as crew:
        start_campaign(loaded, Path(database), workers=crew, batch=batch, progress=progress)
    return Path(database)


def start_campaign(
    spec: Spec,
    path: Path,
    *,
    workers: Workers,
    shard: Shard | None = None,
    stop: Stop | None = None,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Run a campaign, or only the cases of a ``shard``, into a new database; ``stop`` ends it
    early, ``progress`` is called after every batch of results; ``batch``: see ``run_campaign``.

    Raises:
      CampaignError, RecordError: a value cannot be used, or the database cannot be made.
      WorkersError: the workers do not work.
      InterruptedCampaign: ``stop`` was set; ``resume_campaign`` finishes.
    """
    check_cases(spec)
    with create_store(path, spec, make_cases(spec), shard=shard) as store:
        go_on_by("campaign", "resume", str(path))
        _drive(store, workers, stop, batch, progress)


def resume_campaign(
    path: Path,
    *,
    workers: Workers,
    stop: Stop | None = None,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Run the remaining cases of a database. Arguments and errors: see ``start_campaign``."""
    with open_store(path, writing=True) as store:
        _drive(store, workers, stop, batch, progress)


def merge_campaigns(databases: Sequence[Path], out: Path) -> None:
    """Join databases of one campaign, such as its shards, into a new one, equal to that of a single
    run. ``resume_campaign`` then runs the cases missing in all of them.

    Raises:
      CampaignError: they are not of one campaign, two hold the same run, or ``out`` exists.
    """
    with open_store(databases[0]) as first:
        cases = (first.case(index) for index in range(first.spec.cases))
        name = f"joining {counted(len(databases), 'database')}"
        with step(name), create_store(out, first.spec, cases) as merged:
            merged.add_results_of(databases)


def _drive(
    store: Store,
    workers: Workers,
    stop: Stop | None,
    batch: int | None,
    progress: Callable[[Progress], None] | None,
) -> None:
    check_engine(store.spec)
    campaign, total = store.spec.to_json(), store.runs
    counts = Progress(before=store.num_results(), total=total)

    def report() -> None:
        if progress is not None:
            progress(copy.copy(counts))

    report()
    # so small that the workers end at about the same time
    share = (total - counts.done) // (_BATCHES_EACH * workers.in_flight())
    samples = store.spec.base_scenario.num_control_periods
    usual = usual_batch(find_engine(store.spec.engine), samples=samples)
    most = min(batch or usual, share)
    results = Runs(
        evaluate,
        batches(store.pending(), size=lambda: counts.next_batch(most)),
        arguments=lambda some: (campaign, some),
        workers=workers,
        stop=Stop() if stop is None else stop,  # a stop that is not set counts as false
        should_renew=lambda rows: any(row["rss_mib"] > MEMORY_LIMIT for row in rows),
        split=alone,
    ).results()
    try:
        runs = counted(total, "run")
        with contextlib.closing(results), step(lambda: f"{counts.done} of {runs}"):
            for some, result in results:
                rows = [_LOST] * len(some) if isinstance(result, WorkerLost) else result
                store.add(some, rows)
                counts.add(rows)
                report()
    except (CampaignError, WorkersError) as error:
        if counts.done:
            raise type(error)(f"{error}; {_stored(counts.done, store)}") from error
        raise
    if counts.done < total:
        raise InterruptedCampaign(counts.done, total)
    if (done := store.num_results()) < total:
        raise CampaignError(
            f"{store.path}: another program removed results while it ran; {_stored(done, store)}"
        )


def _stored(done: int, store: Store) -> str:
    """Description of the unfinished part of a stopped campaign."""
    return (
        f"{done} of {counted(store.runs, 'run')} stored, 'ffsm campaign resume {store.path}' "
        "runs the others"
    )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Repeated:
    """A repeated run, compared with the stored row."""

    record: RunRecord | None  # None: the run failed again
    stored: Row
    repeated: Row
    differences: list[str]  # columns that differ


def repeat_run(store: Store, case: Case, controller: str) -> Repeated:
    """Run one case again, with the full record.

    Raises:
      CampaignError: the database holds no such run.
    """
    check_engine(store.spec)
    stored = store.result(case.index, controller)
    start, log = time.perf_counter(), None
    try:
        name = f"case {case.index} with {controller}"
        with step(name), guarded, time_limit(store.spec.time_limit):
            mission = timed(Mission(scenario_of(store.spec, case, controller)))
            ((_, found),) = run_many([mission], engine=store.spec.engine)
        if isinstance(found, Exception):
            raise found
        log = found
        repeated = evaluate_run(store.spec, log)
    except (Exception, TimeLimit) as error:
        log = getattr(error, "log", None)  # up to where user-supplied code failed
        repeated = failure_row(error)
    record = None if log is None else make_record(log, start=start)
    return Repeated(
        record=record,
        stored=stored,
        repeated=repeated,
        differences=differing_columns(stored, repeated),
    )
