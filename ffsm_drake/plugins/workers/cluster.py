"""Workers of a Dask cluster: of one that runs, or of the tasks of a Slurm step."""

import contextlib
import importlib
import json
import logging
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from ffsm_drake.common.errors import WorkersError, one_line
from ffsm_drake.common.files import check_regular
from ffsm_drake.plugins.workers.pool import Workers

# Lifetime of a cluster's workers: each ends after a time, and another begins with fresh memory.
_RENEWED = {"lifetime": "30m", "lifetime_stagger": "5m", "lifetime_restart": True}
_IDLE = "10m"  # after which a scheduler without tasks ends
_MAX_ADDRESS = 100_000  # bytes of the file that holds a scheduler's
_SILENCE = 5.0  # s of waiting, after which it is said


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
