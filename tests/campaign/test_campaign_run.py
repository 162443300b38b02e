"""Running campaigns: the same table whoever computes it when, whatever is killed; faults of databases."""

import contextlib
import csv
import fcntl
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import pytest
from campaign_tools import (
    alive,
    count,
    run_here,
    run_with_kills,
    start_driver,
    table,
    worker_processes,
    write_spec,
)
from click.testing import CliRunner

from ffsm_drake import RunRecord
from ffsm_drake.campaign.run import start_campaign
from ffsm_drake.campaign.spec import load_spec
from ffsm_drake.campaign.store import open_store
from ffsm_drake.cli.campaign import campaign
from ffsm_drake.common.errors import CampaignError
from ffsm_drake.common.workers import Stop, local_workers

linux = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write_spec(tmp_path_factory.mktemp("spec") / "small.yaml")


@pytest.fixture(scope="module")
def database(spec, tmp_path_factory):
    """The campaign, undisturbed, with one worker. Not to be written to."""
    return run_here(spec, tmp_path_factory.mktemp("database") / "one.db")


def invoke(*arguments):
    return CliRunner().invoke(campaign, [str(argument) for argument in arguments])


def one_line_error(result, said):
    assert result.exit_code == 2, result.output
    assert said in result.output
    assert result.output.count("\n") == 1


def test_two_workers_give_the_table_of_one(spec, database, tmp_path):
    assert table(run_here(spec, tmp_path / "two.db", workers=2)) == table(database)
    assert len(table(database)) == 16


@linux
def test_kills_change_nothing(tmp_path):
    spec = write_spec(tmp_path / "s.yaml", controllers=["tdc"], cases=24)
    events = run_with_kills(spec, tmp_path / "killed.db", kills=3, seed=2, mean_delay=0.05)
    assert len(events) == 3  # else it was over too soon
    assert table(tmp_path / "killed.db") == table(run_here(spec, tmp_path / "undisturbed.db"))


@linux
def test_an_interrupted_campaign_is_resumed(tmp_path):
    spec = write_spec(tmp_path / "long.yaml", cases=16)  # so that it is not over before the signal arrives
    path = tmp_path / "interrupted.db"
    driver = start_driver("run", str(spec), "--database", str(path), "--workers", "1")
    while count(path) < 2 and driver.poll() is None:
        time.sleep(0.02)
    workers = worker_processes(driver.pid)
    os.killpg(driver.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    output, _ = driver.communicate(timeout=60)
    assert driver.returncode == 130, output
    assert f"interrupted with {count(path)} of 32 runs stored" in output
    assert "Traceback" not in output
    assert not any(alive(worker) for worker in workers)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT count(*) FROM results WHERE outcome = 'error'").fetchone() == (0,)
    result = invoke("resume", path, "--workers", "1")
    assert result.exit_code == 0, result.output
    assert table(path) == table(run_here(spec, tmp_path / "whole.db"))


def test_a_failing_case_is_a_row(tmp_path):
    masses = {"distribution": "list", "values": [100.0, -1.0]}
    spec = write_spec(
        tmp_path / "s.yaml",
        parameters={"payload.truth.mass": masses},
        factors={},
        derive={},
        cases=2,
        controllers="tdc",
    )
    path = run_here(spec, tmp_path / "x.db")
    with open_store(path) as store:
        assert store.counts() == {"tdc": {"settled": 1, "not_settled": 0, "diverged": 0, "error": 1}}
        assert store.result(1, "tdc")["message"] == "ScenarioError: payload.truth.mass: must be > 0 kg, not -1.0"
    result = invoke("rerun", path, "--case", "1")
    assert result.exit_code == 0, result.output
    assert "all values equal the stored ones, bit for bit" in result.output


@pytest.mark.skipif(sys.platform != "linux", reason="finds processes in /proc")
def test_a_dask_cluster_gives_the_same_table(spec, database, tmp_path):
    pytest.importorskip("distributed")
    log = (tmp_path / "cluster.log").open("w")
    running = []

    def start(command, *arguments):
        line = [sys.executable, "-m", f"distributed.cli.dask_{command}", *arguments, "--no-dashboard"]
        running.append(subprocess.Popen(line, stdout=log, stderr=subprocess.STDOUT))
        return running[-1]

    file = tmp_path / "scheduler.json"
    try:
        start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
        address = wait_for(lambda: json.loads(file.read_text())["address"])
        workers = [
            start(
                "worker", address, "--nthreads", "1", "--host", "127.0.0.1",
                "--local-directory", str(tmp_path / f"worker{k}"),
            )
            for k in range(2)
        ]  # fmt: skip
        path = tmp_path / "cluster.db"
        driver = start_driver("run", str(spec), "--database", str(path), "--scheduler", address)
        while count(path) < 2 and driver.poll() is None:
            time.sleep(0.02)
        for victim in worker_processes(workers[0].pid):
            os.kill(victim, signal.SIGKILL)
        output, _ = driver.communicate(timeout=120)
        assert driver.returncode == 0, output
        assert table(path) == table(database)
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=30)
        log.close()


def wait_for(function, *, patience=60.0):
    end = time.monotonic() + patience
    while True:
        try:
            return function()
        except (OSError, ValueError):
            assert time.monotonic() < end
            time.sleep(0.1)


def test_rerun_reproduces_a_row_with_its_record(database, tmp_path):
    result = invoke("rerun", database, "--case", "3", "--controller", "asmc", "--out", tmp_path, "--no-recording")
    assert result.exit_code == 0, result.output
    assert "all values equal the stored ones, bit for bit" in result.output
    record = RunRecord.load(tmp_path / "asmc")
    with open_store(database) as store:
        row = store.result(3, "asmc")
    assert record.metrics["itae"] == row["itae"]
    assert record.scenario.random_seed == row["random_seed"]


def test_rerun_notices_another_result(database, tmp_path):
    path = tmp_path / "altered.db"
    path.write_bytes(database.read_bytes())
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("UPDATE results SET isv = isv * (1 + 1e-15) WHERE case_index = 0")
    result = invoke("rerun", path, "--case", "0", "--controller", "tdc", "--out", tmp_path, "--no-recording")
    assert result.exit_code == 3
    assert "NOT as stored: isv" in result.output


def test_status_and_export(database, tmp_path):
    result = invoke("status", database)
    assert result.exit_code == 0
    assert "16 of 16 runs (100.0 %)" in result.output
    assert "memory of a worker" in result.output
    with open_store(database) as store:
        store.export(tmp_path / "runs.csv")
        columns = store.columns
    rows = list(csv.DictReader((tmp_path / "runs.csv").open()))
    assert tuple(rows[0]) == columns
    wanted = table(database)
    assert [float(row["payload.truth.mass"]) for row in rows] == [row[6] for row in wanted]
    pq = pytest.importorskip("pyarrow.parquet")
    with open_store(database) as store:
        store.export(tmp_path / "runs.parquet")
        with pytest.raises(CampaignError, match=r"must end in \.csv or \.parquet"):
            store.export(tmp_path / "runs.xlsx")
    frame = pq.read_table(tmp_path / "runs.parquet").to_pydict()
    assert frame["payload.truth.mass"] == [row[6] for row in wanted]
    assert frame["outcome"] == [row[3] for row in wanted]
    assert json.loads(frame["payload.nominal.inertia"][0])[0] > 0


def test_databases_that_cannot_be_used(spec, database, tmp_path):
    one_line_error(invoke("run", spec, "--database", database), "exists; finish it with 'ffsm campaign resume")
    other = write_spec(tmp_path / "other.yaml", seed=6)
    one_line_error(invoke("run", other, "--database", database), "holds another campaign")
    one_line_error(invoke("resume", other, "--database", database), "holds another campaign")
    one_line_error(invoke("status", tmp_path / "nothing.db"), "no such database")
    (tmp_path / "noise.db").write_bytes(os.urandom(8192))
    one_line_error(invoke("resume", tmp_path / "noise.db"), "is damaged or not a campaign's database")
    with contextlib.closing(sqlite3.connect(tmp_path / "foreign.db")) as connection, connection:
        connection.execute("CREATE TABLE t (x)")
    one_line_error(invoke("status", tmp_path / "foreign.db"), "is not a campaign's database")
    half = bytearray(database.read_bytes())
    half[4096 * 2 :] = os.urandom(len(half) - 4096 * 2)
    (tmp_path / "half.db").write_bytes(half)
    one_line_error(invoke("resume", tmp_path / "half.db"), "damaged")
    (tmp_path / "file").write_text("")
    one_line_error(invoke("run", spec, "--database", tmp_path / "file" / "x.db"), "cannot be written")
    one_line_error(invoke("rerun", database, "--case", "8"), "has no case 8; there are 0 to 7")
    one_line_error(invoke("rerun", database, "--case", "1", "--controller", "aismc"), "'aismc' is not in it")
    one_line_error(invoke("run", spec, "--workers", "1", "--scheduler", "tcp://127.0.0.1:1"), "leave one of them out")


def test_a_database_in_use(database, tmp_path, monkeypatch):
    path = tmp_path / "used.db"
    path.write_bytes(database.read_bytes())
    with (tmp_path / ".used.db.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        one_line_error(invoke("resume", path), "is in use; another campaign is writing to it")
    monkeypatch.setattr("ffsm_drake.campaign.store.PATIENCE", 0.1)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        one_line_error(invoke("resume", path), "database is locked")


def test_stopping_before_the_start_leaves_all_to_resume(spec, database, tmp_path):
    from ffsm_drake.campaign.run import resume_campaign
    from ffsm_drake.common.errors import InterruptedCampaign

    stop = Stop()
    stop.set()
    with local_workers(1) as workers:
        with pytest.raises(InterruptedCampaign, match="0 of 16"):
            start_campaign(load_spec(spec), tmp_path / "x.db", workers=workers, stop=stop)
        seen = []
        resume_campaign(tmp_path / "x.db", workers=workers, stop=Stop(), progress=seen.append)
    assert [progress.done for progress in seen] == list(range(17))
    assert seen[-1].remaining == 0.0
    assert table(tmp_path / "x.db") == table(database)
