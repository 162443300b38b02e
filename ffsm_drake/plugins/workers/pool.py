"""Processes on this machine; tasks on any ``concurrent.futures`` executor, with lost workers
replaced and tasks repeated.

``map_tasks`` is for a list of tasks on this machine; ``Runs`` takes tasks one by one, also on
a Dask cluster.

A dead process breaks its local pool: every task in flight is lost, and the culprit is not known. So
the lost tasks are repeated one at a time. If a worker dies with a single task, the task is split
into its parts, if it has any; after ``ATTEMPTS`` dead workers it is given up as WorkerLost.
"""

import contextlib
import dataclasses
import os
import signal
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
from typing import Any, Generic, TypeVar

from ffsm_drake.common.errors import FfsmError, WorkersError, one_line
from ffsm_drake.common.interrupts import spare, stopping
from ffsm_drake.common.processes import kill_below
from ffsm_drake.common.threads import ONE_THREAD

ATTEMPTS = 3
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
