"""The process pool: lost, worn and failing workers; stopping; results that do not depend on who
computed them.
"""

import os
import signal
import sys
import time
from concurrent.futures import Executor, Future
from concurrent.futures.process import BrokenProcessPool

import pytest
from children import PIPE, STDOUT, child

from ffsm_drake.common.errors import ScenarioError, WorkersError
from ffsm_drake.plugins.workers.pool import (
    Runs,
    Stop,
    WorkerLost,
    Workers,
    local_workers,
    map_tasks,
)


def run(function, tasks, workers, **settings):
    return list(Runs(function, tasks, lambda task: (task,), workers, Stop(), **settings).results())


class Fragile(Executor):
    """Runs tasks at once, and breaks like a pool of processes when a task is one of the deadly."""

    def __init__(self, deadly):
        self.deadly, self.broken = deadly, False

    def submit(self, function, task):
        if self.broken:
            raise BrokenProcessPool
        future = Future()
        self.broken = task in self.deadly
        if self.broken:
            future.set_exception(BrokenProcessPool())
        else:
            future.set_result(function(task))
        return future


def fragile_workers(deadly):
    return Workers(open=lambda: Fragile(deadly), in_flight=lambda: 3, renewable=True)


def test_a_task_that_kills_its_worker_is_given_up():
    results = dict(run(lambda task: 10 * task, range(6), fragile_workers({3})))
    assert isinstance(results.pop(3), WorkerLost)
    assert results == {task: 10 * task for task in (0, 1, 2, 4, 5)}


def test_of_a_task_with_parts_only_the_part_that_kills_its_worker_is_given_up():
    tasks = [(0, 1, 2), (3, 4, 5), (6,)]
    results = dict(
        run(
            sum,
            tasks,
            fragile_workers({(3, 4, 5), (4,)}),
            split=lambda task: [(each,) for each in task],
        )
    )
    assert isinstance(results.pop((4,)), WorkerLost)
    assert results == {(0, 1, 2): 3, (6,): 6, (3,): 3, (5,): 5}


def test_workers_that_all_die_end_the_work():
    with pytest.raises(WorkersError, match="every worker dies"):
        run(abs, range(9), fragile_workers(set(range(9))))


def test_worn_processes_are_replaced():
    with local_workers(1) as workers:
        results = run(process_of, range(4), workers, should_renew=lambda result: True)
    assert sorted(task for task, _ in results) == [0, 1, 2, 3]
    assert len({pid for _, pid in results}) >= 2


def process_of(task):
    assert os.environ["OMP_NUM_THREADS"] == "1"
    return os.getpid()


def die_once(mark):
    """Kill the process of a task whose file is not there yet; its name otherwise."""
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return mark.name


@pytest.mark.slow
def test_processes_serve_one_list_of_tasks_after_the_other():
    with local_workers(1) as workers:
        first, second = (run(process_of, range(1), workers) for _ in range(2))
    assert first == second


@pytest.mark.long
def test_a_killed_worker_is_replaced_and_its_task_repeated(tmp_path):
    marks = [tmp_path / str(k) for k in range(4)]
    for mark in marks[2:]:
        mark.touch()
    assert map_tasks(die_once, marks, workers=2) == ["0", "1", "2", "3"]


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    told = []
    results = map_tasks(
        nap, [0.2, 0.0, 0.1], workers=workers, progress=lambda *call: told.append(call)
    )
    assert results == ["0.2", "0.0", "0.1"]
    assert [call[:2] for call in told] == [(1, 3), (2, 3), (3, 3)]
    assert {call[2] for call in told} == set(results)


def nap(seconds):
    time.sleep(seconds)
    return str(seconds)


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.smoke
def test_an_error_of_a_task_is_passed_on(workers):
    with pytest.raises(ScenarioError, match=r"^task: is odd$") as caught:
        map_tasks(fail_if_odd, [2, 4, 3, 6], workers=workers)
    assert caught.value.key == "task"


def fail_if_odd(task):
    if task % 2:
        raise ScenarioError("task", "is odd")
    return task


INTERRUPTED = """
import sys, time
from ffsm_drake.common.interrupts import exit_code, handle_signals
from ffsm_drake.plugins.workers.pool import map_tasks
if __name__ == "__main__":
    handle_signals()
    try:
        map_tasks(time.sleep, [0.1] * 600, workers=int(sys.argv[1]),
                  progress=lambda *call: print(call[0], flush=True))
    except KeyboardInterrupt:
        print("interrupted")
        sys.exit(exit_code())
"""


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("workers", ["1", "2"])
def test_signals_stop_after_the_tasks_under_way(tmp_path, workers, sent):
    script = tmp_path / "script.py"
    script.write_text(INTERRUPTED)
    command = [sys.executable, script, workers]
    with child(command, stdout=PIPE, stderr=STDOUT, text=True) as process:
        assert process.stdout.readline() == "1\n"
        os.killpg(process.pid, sent)  # the workers get it too, as from a terminal
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + sent, output
    assert output.splitlines()[-1] == "interrupted"
    assert len(output.splitlines()) < 20
    assert "Traceback" not in output
