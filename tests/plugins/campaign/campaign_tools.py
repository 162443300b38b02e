"""What the campaign tests share: a small specification, tables to compare, a driver in a process of
its own.
"""

import contextlib
import sqlite3
import sys
import time
from pathlib import Path

import alone  # noqa: F401 (what processes have loaded)
import yaml
from children import PIPE, STDOUT, child, pool, processes
from click.testing import CliRunner

from ffsm_drake.plugins.campaign.command import campaign
from ffsm_drake.plugins.campaign.rows import CIRCUMSTANCES
from ffsm_drake.plugins.campaign.run import start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.campaign.store import open_store
from ffsm_drake.plugins.workers.pool import InThisProcess, Stop, Workers

SMALL = {
    "description": "a small campaign",
    "scenario": "postcapture",
    "overrides": {"duration": 0.3},
    "controllers": ["tdc", "asmc"],
    "cases": 8,
    "seed": 5,
    "parameters": {
        "payload.truth.mass": {"distribution": "uniform", "low": 20, "high": 300},
        "sensing.velocity_noise": {"distribution": "log_uniform", "low": "1e-7", "high": 1e-5},
    },
    "factors": {"nominal_error": {"distribution": "uniform", "low": -0.5, "high": 0.2}},
    "derive": {
        "payload.truth.inertia": {"rule": "solid_cube", "mass": "payload.truth.mass", "side": 1.0},
        "payload.nominal.mass": {
            "rule": "relative",
            "of": "payload.truth.mass",
            "error": "nominal_error",
        },
        "payload.nominal.inertia": {
            "rule": "relative",
            "of": "payload.truth.inertia",
            "error": "nominal_error",
        },
    },
    "settled": {"hold": 0.1},
}


def write_spec(path: Path, **changes) -> Path:
    path.write_text(yaml.safe_dump({**SMALL, **changes}, sort_keys=False), encoding="utf-8")
    return path


# This process, which has loaded everything; its own thread, since Drake ends a process in which
# another one collects a Meshcat that some test left.
HERE = Workers(open=InThisProcess, in_flight=lambda: 1, renewable=False)


def forked(count: int, *, in_flight: int) -> Workers:
    """Processes that start with everything loaded."""
    return Workers(
        open=lambda: pool(count),
        in_flight=lambda: in_flight,
        renewable=True,
    )


def run_here(spec_file: Path, database: Path, *, workers: Workers = HERE) -> Path:
    """Run a campaign from this process; by default in it."""
    start_campaign(load_spec(spec_file), database, workers=workers, stop=Stop())
    return database


def invoke(*words):
    """``ffsm campaign`` in this process."""
    return CliRunner().invoke(campaign, [str(word) for word in words])


def sql(database: Path, *statements: str) -> list[tuple]:
    """Execute statements, as another program would; the rows of the last one."""
    with contextlib.closing(sqlite3.connect(database, timeout=10)) as connection, connection:
        return [connection.execute(each).fetchall() for each in statements][-1]


def table(database: Path) -> list[dict]:
    """All that must be the same however a campaign was run: the runs without circumstances."""
    with open_store(database) as store:
        rows = store.query("SELECT * FROM runs ORDER BY case_index, controller")
        found = [dict(zip(store.columns, row, strict=True)) for row in rows]
    return [{name: row[name] for name in row if name not in CIRCUMSTANCES} for row in found]


def count(database: Path) -> int:
    """Stored runs; 0 before the database is there."""
    return sql(database, "SELECT count(*) FROM results")[0][0] if database.exists() else 0


def driver(*arguments: str):
    """``ffsm campaign`` in a process of its own."""
    command = [sys.executable, "-m", "ffsm_drake", "campaign", *arguments]
    return child(command, stdout=PIPE, stderr=STDOUT, text=True)


def worker_processes(pid: int) -> list[int]:
    """The processes that a driver, or a Dask nanny, has spawned to work."""
    found = []
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):
            for each in (thread / "children").read_text().split():
                if "spawn_main" in Path(f"/proc/{each}/cmdline").read_text():
                    found.append(int(each))
    return found


def wait_for_results(process, database: Path, number: int) -> list[int]:
    """Wait until a driver has stored so many results; its workers."""
    while count(database) < number:
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.01)
    return worker_processes(process.pid)


def wait_for_end(workers: list[int]) -> None:
    """No worker outlives its driver."""
    end = time.monotonic() + 10.0
    while left := {one.pid for one in processes()} & {*workers}:
        assert time.monotonic() < end, left
        time.sleep(0.05)
