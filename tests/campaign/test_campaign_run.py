"""Running campaigns: the same table whoever computes it when, whatever is killed; faults of databases."""

import contextlib
import csv
import fcntl
import json
import os
import signal
import sqlite3
import threading
import time
from pathlib import Path

import pytest
from campaign_tools import (
    HERE,
    count,
    run_here,
    start_driver,
    table,
    wait_for_end,
    wait_for_results,
    write_spec,
)
from click.testing import CliRunner

from ffsm_drake import RunRecord
from ffsm_drake.campaign.run import resume_campaign, start_campaign
from ffsm_drake.campaign.spec import load_spec
from ffsm_drake.campaign.store import open_store
from ffsm_drake.cli.campaign import campaign
from ffsm_drake.common.errors import CampaignError, InterruptedCampaign
from ffsm_drake.common.workers import Stop

linux = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write_spec(tmp_path_factory.mktemp("spec") / "small.yaml", cases=16)


@pytest.fixture(scope="module")
def database(spec, tmp_path_factory):
    """The campaign, undisturbed, in this process. Not to be written to."""
    return run_here(spec, tmp_path_factory.mktemp("database") / "one.db")


def invoke(*arguments):
    return CliRunner().invoke(campaign, [str(argument) for argument in arguments])


def one_line_error(result, said):
    assert result.exit_code == 2, result.output
    assert said in result.output
    assert result.output.count("\n") == 1


@linux
def test_kills_and_an_interruption_change_nothing(spec, database, tmp_path):
    """One of two workers is killed, then the driver; Ctrl-C interrupts what resumes; what resumes that finishes."""
    path = tmp_path / "disturbed.db"
    driver = start_driver("run", str(spec), "--database", str(path), "--workers", "2")
    workers = wait_for_results(driver, path, 2)
    os.kill(workers[0], signal.SIGKILL)
    workers += wait_for_results(driver, path, count(path) + 2)
    assert driver.poll() is None, "over before it could be killed"
    driver.kill()
    driver.communicate()
    wait_for_end(workers)
    driver = start_driver("resume", str(path), "--workers", "1")
    workers = wait_for_results(driver, path, count(path) + 2)
    os.killpg(driver.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    output, _ = driver.communicate(timeout=60)
    assert driver.returncode == 130, output
    assert f"interrupted with {count(path)} of 32 runs stored" in output
    assert "Traceback" not in output
    wait_for_end(workers)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT count(*) FROM results WHERE outcome = 'error'").fetchone() == (0,)
    result = invoke("resume", path, "--workers", "1")
    assert result.exit_code == 0, result.output
    assert table(path) == table(database)
    assert len(table(path)) == 32


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


def test_a_dask_cluster_gives_the_same_table(spec, database, tmp_path):
    distributed = pytest.importorskip("distributed")
    path = tmp_path / "cluster.db"

    def kill_a_worker():
        while count(path) < 2:
            time.sleep(0.02)
        os.kill(cluster.workers[0].pid, signal.SIGKILL)  # Dask starts another

    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, host="127.0.0.1", dashboard_address=":0", local_directory=str(tmp_path)
    ) as cluster:
        killer = threading.Thread(target=kill_a_worker, daemon=True)
        killer.start()
        result = invoke("run", spec, "--database", path, "--scheduler", cluster.scheduler_address)
        assert result.exit_code == 0, result.output
        killer.join(timeout=10)
    assert table(path) == table(database)
    with open_store(path) as store:
        assert len({store.result(case, "tdc")["worker"] for case in range(16)}) == 2  # another did the rest


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
    assert "32 of 32 runs (100.0 %)" in result.output
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
    one_line_error(invoke("rerun", database, "--case", "16"), "has no case 16; there are 0 to 15")
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
    stop = Stop()
    stop.set()
    with pytest.raises(InterruptedCampaign, match="0 of 32"):
        start_campaign(load_spec(spec), tmp_path / "x.db", workers=HERE, stop=stop)
    seen = []
    resume_campaign(tmp_path / "x.db", workers=HERE, stop=Stop(), progress=seen.append)
    assert [progress.done for progress in seen] == list(range(33))
    assert seen[-1].remaining == 0.0
    assert table(tmp_path / "x.db") == table(database)
