"""The one process pool: tasks on any ``concurrent.futures`` executor, with lost workers replaced
and tasks repeated.

``map_tasks`` is for a list of tasks on this machine; ``Runs`` takes tasks one by one, also on
a Dask cluster.

A dead process breaks its local pool: every task in flight is lost, and the culprit is not known. So
the lost tasks are repeated one at a time. If a worker dies with a single task, the task is split
into its parts, if it has any; after ``ATTEMPTS`` dead workers it is given up as WorkerLost.
"""

import contextlib
import dataclasses
import importlib
import json
import logging
import os
import re
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from pathlib import Path
from tempfile import gettempdir
from typing import Any, Generic, TypeVar

from ffsm_drake.common.errors import FfsmError, WorkersError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.common.interrupts import kill_below, spare, stopping

ATTEMPTS = 3
# Library threads per process: the workers fill the machine, and a manipulator's matrices are too
# small to split.
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
    ),
    "1",
)
# Lifetime of a cluster's workers: each ends after a time, and another begins with fresh memory.
_RENEWED = {"lifetime": "30m", "lifetime_stagger": "5m", "lifetime_restart": True}
_IDLE = "10m"  # after which a scheduler without tasks ends
_MAX_ADDRESS = 100_000  # bytes of the file that holds a scheduler's
_SILENCE = 5.0  # s of waiting, after which it is said
_POLL = 0.5  # s between checks for a request to stop
_LINGER = 4.0  # s for the tasks under way after that
_DROPPED = 0.2  # s for an executor to drop cancelled tasks

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost:
    """Replaces a result: the task's worker died every time."""


@dataclasses.dataclass(kw_only=True)
class Workers:
    """Source of executors for tasks.

    ``open`` gives an executor; one that was given before has shut down, is finishing its last
    tasks, or was left idle by ``close``.
    """

    open: Callable[[], Executor]
    in_flight: Callable[[], int]  # number of tasks to keep submitted
    renewable: bool  # a fresh executor has fresh processes
    kill: Callable[[], None] = lambda: None  # the processes, at a stop
    close: Callable[[Executor], None] = Executor.shutdown  # at the end of some tasks


@contextlib.contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Spawned processes on this machine, one library thread each; they end with this process, and
    serve one list of tasks after the other.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # inherited by the workers, read when NumPy loads
    idle, others = list[Executor](), active_children()
    _keep_tracker()

    def kill() -> None:
        for child in active_children():
            if child not in others and child.pid is not None:
                kill_below(child.pid, itself=True)  # and what user-supplied code has started

    def open_pool() -> Executor:
        if idle:
            return idle.pop()
        return ProcessPoolExecutor(
            count, mp_context=get_context("spawn"), initializer=_follow_parent
        )

    try:
        yield Workers(
            open=open_pool,
            in_flight=lambda: 2 * count,
            renewable=True,
            kill=kill,
            close=idle.append,
        )
    finally:
        for pool in idle:
            pool.shutdown()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def cluster_workers(address: str, *, patience: float = 60.0) -> Iterator[Workers]:
    """The workers of a running Dask cluster, by its scheduler's address (tcp://127.0.0.1:8786).

    Waits ``patience`` seconds for the scheduler and its first worker.

    Raises:
      WorkersError: ``distributed`` is not installed, or no scheduler or worker answers.
    """
    _check_address(address)
    try:
        distributed: Any = importlib.import_module("distributed")  # optional, and without types
    except ImportError:
        raise WorkersError(
            "a Dask cluster needs the extra 'cluster': pip install 'ffsm-drake[cluster]'"
        ) from None
    with _quiet_dask():
        try:
            client = distributed.Client(address, timeout=patience, set_as_default=False)
        except Exception as error:
            raise WorkersError(
                f"{address}: no Dask scheduler answers there: {one_line(error)}"
            ) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=patience)
            except TimeoutError:
                raise WorkersError(
                    f"{address}: no worker joined the cluster within {patience:g} s"
                ) from None
            yield Workers(
                # Not pure: Dask must not reuse the result of a task with equal arguments.
                open=lambda: client.get_executor(pure=False),
                in_flight=lambda: 2 * max(len(client.nthreads()), 1),
                renewable=False,
            )


@contextlib.contextmanager
def slurm_workers(*, patience: float = 60.0) -> Iterator[Workers]:
    """A Dask cluster of the tasks of this Slurm step: the first schedules, the second goes on here,
    the others work. All but the second end here, with the step. In the main thread.

    Raises:
      WorkersError: it is no Slurm step of three tasks or more, or as ``cluster_workers``.
    """
    number = {
        name: os.environ.get(f"SLURM_{name}", default)
        for name, default in {
            "NTASKS": "", "PROCID": "", "JOB_ID": "", "STEP_ID": "0", "RESTART_COUNT": "0",
        }.items()
    }  # fmt: skip
    if number["NTASKS"] in ("", "1", "2") or not (number["PROCID"] and number["JOB_ID"]):
        raise WorkersError(
            "--slurm: needs a step of at least three tasks; write srun --ntasks=9 ffsm campaign ..."
        )
    for name, text in number.items():
        if not re.fullmatch("[0-9]{1,10}", text):
            raise WorkersError(f"--slurm: SLURM_{name} must be a number, not {text!r:.80}")
    if not int(number["PROCID"]) < int(number["NTASKS"]) or int(number["NTASKS"]) < 3:
        raise WorkersError(
            f"--slurm: SLURM_PROCID must be below SLURM_NTASKS, 3 or more, not {number['PROCID']} "
            f"and {number['NTASKS']}"
        )
    try:  # it handles SIGINT; the runner ends its tasks by this signal
        jobqueue: Any = importlib.import_module("dask_jobqueue.slurm")
    except ImportError:
        raise WorkersError(
            "--slurm: needs the extra 'cluster': pip install 'ffsm-drake[cluster]'"
        ) from None
    # a job that was put back in the queue keeps its number
    file = f"scheduler-{'-'.join(number[n] for n in ('JOB_ID', 'STEP_ID', 'RESTART_COUNT'))}.json"
    if int(number["PROCID"]) > 0:
        _await_scheduler(Path(file), patience)
    os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "critical")  # for child processes
    with _quiet_dask():
        runner = jobqueue.SLURMRunner(
            scheduler_file=file,
            scheduler_options={"dashboard": False, "idle_timeout": _IDLE},
            worker_class="distributed.Nanny",
            worker_options={
                "nthreads": 1,
                "local_directory": gettempdir(),
                "death_timeout": patience,
                **_RENEWED,
            },
        )
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the runner has one of its own
    with runner, cluster_workers(runner.scheduler_address, patience=patience) as workers:
        yield workers


def _await_scheduler(file: Path, patience: float) -> None:
    """Wait until a step's scheduler has written its address. Raises WorkersError: it has not."""
    begun, is_told = time.monotonic(), False
    while True:
        try:
            check_regular(file, limit=_MAX_ADDRESS)
            if isinstance(json.loads(file.read_text())["address"], str):
                return
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            pass  # not there yet, or half written
        waited = time.monotonic() - begun
        if waited > patience:
            problem = f"task 0 of the step has not written {file} within {patience:g} s"
            raise WorkersError(f"--slurm: no scheduler: {problem}; are all tasks in one folder?")
        if waited > _SILENCE and not is_told:
            is_told = True
            print(
                f"waiting for the scheduler, task 0 of the step, to write {file}", file=sys.stderr
            )
        time.sleep(0.1)


@contextlib.contextmanager
def _quiet_dask() -> Iterator[None]:
    """Keep Dask's tracebacks off standard error: what they mean is raised as one line."""
    loggers = [
        logging.getLogger(f"distributed{part}") for part in ("", ".client", ".core", ".comm")
    ]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def _check_address(address: str) -> None:
    """Raise WorkersError for an impossible address, which Dask would try until it times out."""
    form = r"(?:(?:tcp|tls|wss?)://)?(\[[0-9a-fA-F:.]+(?:%\w+)?\]|[\w.-]+):(\d{1,5})"
    found = re.fullmatch(form, address, re.ASCII)
    if found is None or not 0 < int(found[2]) < 2**16:
        raise WorkersError(
            f"'{address}': is not an address such as tcp://127.0.0.1:8786, with tcp, tls, ws or wss"
        )
    try:
        socket.getaddrinfo(found[1].strip("[]"), int(found[2]))
    except (OSError, UnicodeError) as error:
        raise WorkersError(f"{address}: the host is not known: {one_line(error)}") from error


class InThisProcess(Executor):
    """Runs each task on submission."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except FfsmError as error:
            future.set_exception(error)
        return future


def _keep_tracker() -> None:
    """Start the process that frees what a killed one has left, which shall do that in silence."""
    sys.warnoptions.append("ignore:resource_tracker")
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.pop()
    spare(getattr(resource_tracker, "_resource_tracker")._pid)  # noqa: B009


def _follow_parent() -> None:
    """End this process as soon as its parent process has ended, for any reason."""
    parent = parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="follow-parent", daemon=True).start()


class Stop(threading.Event):
    """A request to stop, true once set; ``set`` may be called from a signal handler or another
    thread.
    """

    def __bool__(self) -> bool:
        return self.is_set()


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Make Ctrl-C, SIGTERM and SIGHUP request a stop; a second one interrupts at once.

    Outside the main thread this changes nothing.
    """
    stop, is_main = Stop(), threading.current_thread() is threading.main_thread()
    with stopping(stop.set) if is_main else contextlib.nullcontext():
        yield stop


def map_tasks(
    function: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Result]:
    """``function(task)`` for every task, in order; the results do not depend on the workers.

    Args:
      function: importable by its name.
      tasks: its arguments.
      workers: number of processes. One is this process; more are spawned, so a script must call
        this under ``if __name__ == "__main__":``.
      progress: called after every task with (tasks done, tasks in all, the task as text).

    Raises:
      FfsmError: what ``function`` raised.
      WorkersError: a task's worker died every time.
      KeyboardInterrupt: Ctrl-C or SIGTERM; the tasks under way were finished.
    """
    here = Workers(open=InThisProcess, in_flight=lambda: 1, renewable=False)
    results: dict[int, Result] = {}
    with (
        stop_on_signals() as stop,
        local_workers(workers) if workers > 1 else contextlib.nullcontext(here) as crew,
    ):
        done = Runs(function, range(len(tasks)), lambda k: (tasks[k],), crew, stop).results()
        with contextlib.closing(done):
            for k, result in done:
                if isinstance(result, WorkerLost):
                    raise WorkersError(f"{tasks[k]}: the worker process died at every attempt")
                results[k] = result
                if progress is not None:
                    progress(len(results), len(tasks), str(tasks[k]))
    if len(results) < len(tasks):
        raise KeyboardInterrupt
    return [results[k] for k in range(len(tasks))]


@dataclasses.dataclass(frozen=True)
class _Flight(Generic[Task]):
    """A task that was handed to an executor."""

    task: Task
    executor: Executor
    strikes: int  # workers that died while it ran alone


@dataclasses.dataclass
class Runs(Generic[Task, Result]):
    """The runs of ``function(*arguments(task))`` for every task, in any order.

    No task is taken from ``tasks`` before it can be submitted. When ``stop`` is set, no further
    task is started; those that end within _LINGER are yielded, then their workers are killed.
    """

    # importable by its name in the workers; only its FfsmErrors are passed on unchanged
    function: Callable[..., Result]
    tasks: Iterable[Task]
    arguments: Callable[[Task], tuple[Any, ...]]
    workers: Workers
    stop: Stop
    # predicate on a result: True if its process should be replaced
    should_renew: Callable[[Result], bool] = lambda result: False
    # the parts of a task; they replace a task after the death of its worker, when run alone
    split: Callable[[Task], Sequence[Task]] = lambda task: (task,)
    flying: dict[Future[Result], _Flight[Task]] = dataclasses.field(default_factory=dict)
    # with their strikes
    suspects: deque[tuple[Task, int]] = dataclasses.field(default_factory=deque)
    succeeded: bool = False
    lost: int = 0
    end: float = 0.0  # by ``time.monotonic``, s; 0: no stop yet

    def results(self) -> Generator[tuple[Task, Result | WorkerLost], None, None]:
        """Each task with its result, as they come.

        Raises:
          FfsmError: what ``function`` raised.
          WorkersError: the workers do not work: every task is lost, or a task cannot be given to
            them.
        """
        self._waiting = iter(self.tasks)
        self.executor = self.workers.open()
        try:
            while True:
                if self.stop:
                    self.end = self.end or time.monotonic() + _LINGER
                    if time.monotonic() > self.end:
                        self._abandon()
                        return
                    # tasks not started yet
                    for future in [future for future in self.flying if future.cancel()]:
                        del self.flying[future]
                else:
                    self._fill()
                if self.flying:
                    done, _ = wait(self.flying, timeout=_POLL, return_when=FIRST_COMPLETED)
                    yield from self._collect(done)
                elif self.stop or not self.suspects:
                    return
        finally:
            for future in self.flying:
                future.cancel()
            if self.flying:  # an error, or nobody takes the rest
                self.executor.shutdown(wait=self.workers.renewable or not self.stop)
            else:
                self.workers.close(self.executor)

    def _abandon(self) -> None:
        """Kill the workers, once the executor has dropped its cancelled tasks."""
        if self.workers.renewable:
            threading.Timer(_DROPPED, self.workers.kill).start()
            self.executor.shutdown(wait=True, cancel_futures=True)

    def _fill(self) -> None:
        """Submit as many tasks as may be in flight; a suspect runs alone."""
        if self.suspects:
            if not self.flying:
                self._submit(*self.suspects.popleft())
            return
        limit = self.workers.in_flight()
        while len(self.flying) < limit and not self.suspects:
            try:
                task = next(self._waiting)
            except StopIteration:
                return
            self._submit(task, 0)

    def _submit(self, task: Task, strikes: int) -> None:
        try:
            # A process started here ignores Ctrl-C and the terminal's end: only the main process
            # decides when to stop.
            with _interrupts_blocked():
                future = self.executor.submit(self.function, *self.arguments(task))
        except BrokenExecutor:  # a worker died while idle
            self.suspects.append((task, strikes))
            if not self.flying:
                self._renew()
            return
        self.flying[future] = _Flight(task, self.executor, strikes)

    def _collect(self, done: set[Future[Result]]) -> Iterator[tuple[Task, Result | WorkerLost]]:
        alone = len(self.flying) == 1
        if any(
            not future.cancelled() and isinstance(future.exception(), BrokenExecutor)
            for future in done
        ):
            # The pool is broken: its other futures end now too.
            done, _ = wait(self.flying)
        broken, should_renew = False, False
        for future in done:
            flight = self.flying.pop(future)
            if future.cancelled():
                raise WorkersError(
                    "the cluster cancelled a task: its scheduler ended or was cleared"
                )
            error = future.exception()
            if error is None:
                result = future.result()
                self.succeeded = True
                should_renew = should_renew or (
                    flight.executor is self.executor and self.should_renew(result)
                )
                yield flight.task, result
            elif isinstance(error, BrokenExecutor):
                broken = True
                strikes = flight.strikes + (1 if alone else 0)
                yield from self._strike(flight.task, strikes)
            elif type(error).__name__ == "KilledWorker":
                # an error of Dask, which may not be installed; Dask counts the attempts
                yield from self._strike(flight.task, ATTEMPTS)
            elif isinstance(error, FfsmError):
                raise error
            else:
                raise WorkersError(
                    f"a worker cannot work: {type(error).__name__}: {one_line(error)}"
                ) from error
        if broken or (should_renew and self.workers.renewable):
            self._renew()

    def _strike(self, task: Task, strikes: int) -> Iterator[tuple[Task, WorkerLost]]:
        """Repeat a task, or its parts, or give it up, depending on the number of workers lost with
        it alone.
        """
        parts = self.split(task)
        if strikes and len(parts) > 1:
            self.suspects += ((part, 0) for part in parts)
        elif strikes < ATTEMPTS:
            self.suspects.append((task, strikes))
        else:
            self.lost += 1
            if not self.succeeded and self.lost >= ATTEMPTS:
                raise WorkersError(
                    "every worker dies with its first task; run one alone to see why"
                )
            yield task, WorkerLost()

    def _renew(self) -> None:
        # The old processes finish their tasks and end.
        self.executor.shutdown(wait=False)
        self.executor = self.workers.open()


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
