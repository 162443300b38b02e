"""Work on many processes: any ``concurrent.futures`` executor, with lost workers replaced and what they did repeated.

Processes that die take every task in flight of a local pool with them, and none says whose fault it was. So the tasks
that were in flight are then run one at a time: a task that is alone when its worker dies, ``ATTEMPTS`` times, is given
up as WorkerLost.
"""

import contextlib
import dataclasses
import importlib
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from typing import Any, Generic, TypeVar

from ffsm_drake.campaign.errors import CampaignError
from ffsm_drake.common.errors import one_line

ATTEMPTS = 3
# Library threads per worker process: the workers themselves fill the machine.
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
_POLL = 0.5  # s, after which a request to stop is noticed at the latest

Task = TypeVar("Task")
Result = TypeVar("Result")


class WorkerLost:
    """In place of a result: the task's worker died every time."""


@dataclasses.dataclass(kw_only=True)
class Workers:
    """Where tasks are run.

    ``open`` gives a fresh executor; the one before, if any, is shut down by then or finishing its last tasks.
    """

    open: Callable[[], Executor]
    in_flight: Callable[[], int]  # how many tasks to keep submitted
    renewable: bool  # whether a fresh executor means fresh processes


@contextlib.contextmanager
def local_workers(count: int) -> Iterator[Workers]:
    """Spawned processes on this machine, one library thread each, that end when this process does."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(_ONE_THREAD)  # inherited by the workers, and read there when NumPy loads
    try:
        yield Workers(
            open=lambda: ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_follow_parent),
            in_flight=lambda: 2 * count,
            renewable=True,
        )
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def cluster_workers(address: str, *, patience: float = 60.0) -> Iterator[Workers]:
    """The workers of a Dask cluster that runs already.

    Args:
      address: the scheduler's, such as tcp://127.0.0.1:8786.
      patience: s to wait for the scheduler and its first worker.

    Raises:
      CampaignError: ``distributed`` is not installed, or no scheduler or worker answers.
    """
    try:
        distributed: Any = importlib.import_module("distributed")  # optional, and without types
    except ImportError:
        raise CampaignError("--scheduler needs the extra 'cluster': pip install 'ffsm-drake[cluster]'") from None
    try:
        client = distributed.Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise CampaignError(f"{address}: no Dask scheduler answers there: {one_line(error)}") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=patience)
        except TimeoutError:
            raise CampaignError(f"{address}: no worker joined the cluster within {patience:g} s") from None
        yield Workers(
            # Not pure: a task is what it is, not a value to be looked up by its arguments.
            open=lambda: client.get_executor(pure=False),
            in_flight=lambda: 2 * max(len(client.nthreads()), 1),
            renewable=False,
        )


def _follow_parent() -> None:
    """End this process as soon as the one that started it has ended, be it by force."""
    parent = parent_process()
    if parent is None:
        return

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, name="follow-parent", daemon=True).start()


class Stop:
    """Whether somebody asked to stop; ``set`` from a signal handler or another thread."""

    def __init__(self) -> None:
        self._event = threading.Event()

    def set(self) -> None:
        self._event.set()

    def __bool__(self) -> bool:
        return self._event.is_set()


@contextlib.contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Ctrl-C and SIGTERM ask to stop; a second one interrupts at once. Outside the main thread signals stay as is."""
    stop = Stop()

    def handle(number: int, frame: Any) -> None:
        if stop:
            raise KeyboardInterrupt
        stop.set()

    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_tasks(
    function: Callable[..., Result],
    tasks: Iterable[Task],
    *,
    arguments: Callable[[Task], tuple[Any, ...]],
    workers: Workers,
    stop: Stop,
    worn: Callable[[Result], bool] = lambda result: False,
) -> Generator[tuple[Task, Result | WorkerLost], None, None]:
    """Run ``function(*arguments(task))`` for every task; yield (task, result) as they come, in any order.

    Never more tasks are taken from ``tasks`` than are in flight. When ``stop`` is set, what runs is finished and
    yielded, and nothing more is started.

    Args:
      function: importable by its name in the workers; must not raise.
      worn: whether a result shows that its process should be replaced.

    Raises:
      CampaignError: the workers do not work: every task is lost, or a task cannot be given to them.
    """
    yield from _Runner(function, iter(tasks), arguments, workers, stop, worn).run()


@dataclasses.dataclass(frozen=True)
class _Flight(Generic[Task]):
    """A task that was handed to an executor."""

    task: Task
    executor: Executor
    strikes: int  # how many workers it has lost while it was alone


class _Runner(Generic[Task, Result]):
    def __init__(
        self,
        function: Callable[..., Result],
        tasks: Iterator[Task],
        arguments: Callable[[Task], tuple[Any, ...]],
        workers: Workers,
        stop: Stop,
        worn: Callable[[Result], bool],
    ) -> None:
        self._function, self._tasks, self._arguments = function, tasks, arguments
        self._workers, self._stop, self._worn = workers, stop, worn
        self._flying: dict[Future[Result], _Flight[Task]] = {}
        self._suspects: deque[tuple[Task, int]] = deque()  # with their strikes
        self._succeeded = False
        self._lost = 0

    def run(self) -> Iterator[tuple[Task, Result | WorkerLost]]:
        self._executor = self._workers.open()
        try:
            while True:
                if self._stop:
                    self._recall()
                else:
                    self._fill()
                if self._flying:
                    done, _ = wait(self._flying, timeout=_POLL, return_when=FIRST_COMPLETED)
                    yield from self._collect(done)
                elif self._stop or not self._suspects:
                    return
        finally:
            for future in self._flying:
                future.cancel()
            self._executor.shutdown(wait=True)

    def _fill(self) -> None:
        """Submit as much as may be in flight; a suspect flies alone."""
        if self._suspects:
            if not self._flying:
                self._submit(*self._suspects.popleft())
            return
        limit = self._workers.in_flight()
        while len(self._flying) < limit and not self._suspects:
            try:
                task = next(self._tasks)
            except StopIteration:
                return
            self._submit(task, 0)

    def _submit(self, task: Task, strikes: int) -> None:
        try:
            # A process that is started here is born deaf to Ctrl-C: only the driver decides when to stop.
            with _interrupts_blocked():
                future = self._executor.submit(self._function, *self._arguments(task))
        except BrokenExecutor:  # a worker died while idle
            self._suspects.append((task, strikes))
            if not self._flying:
                self._renew()
            return
        self._flying[future] = _Flight(task, self._executor, strikes)

    def _recall(self) -> None:
        """Take back what has not been started."""
        for future in [future for future in self._flying if future.cancel()]:
            del self._flying[future]

    def _collect(self, done: set[Future[Result]]) -> Iterator[tuple[Task, Result | WorkerLost]]:
        alone = len(self._flying) == 1
        if any(_broken(future) for future in done):
            # The pool is gone: every other future of it ends now too.
            done, _ = wait(self._flying)
        broken, worn = False, False
        for future in done:
            flight = self._flying.pop(future)
            if future.cancelled():
                raise CampaignError("the cluster cancelled a run: its scheduler is gone, or somebody cleared it")
            error = future.exception()
            if error is None:
                result = future.result()
                self._succeeded = True
                worn = worn or (flight.executor is self._executor and self._worn(result))
                yield flight.task, result
            elif isinstance(error, BrokenExecutor):
                broken = True
                strikes = flight.strikes + (1 if alone else 0)
                if strikes < ATTEMPTS:
                    self._suspects.append((flight.task, strikes))
                else:
                    yield self._give_up(flight.task)
            elif _killed(error):  # Dask has counted by itself
                yield self._give_up(flight.task)
            else:
                raise CampaignError(f"a worker cannot work: {type(error).__name__}: {one_line(error)}") from error
        if broken or (worn and self._workers.renewable):
            self._renew()

    def _give_up(self, task: Task) -> tuple[Task, WorkerLost]:
        self._lost += 1
        if not self._succeeded and self._lost >= ATTEMPTS:
            raise CampaignError("every worker dies with its first run; see what a single run says: 'campaign rerun'")
        return task, WorkerLost()

    def _renew(self) -> None:
        # The old processes finish what they have and end.
        self._executor.shutdown(wait=False)
        self._executor = self._workers.open()


def _broken(future: Future[Any]) -> bool:
    return not future.cancelled() and isinstance(future.exception(), BrokenExecutor)


def _killed(error: BaseException) -> bool:
    """Whether Dask gave the task up because its workers died; by name, as Dask may not be installed."""
    return type(error).__name__ == "KilledWorker"


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
