"""Running campaigns: the same table whoever computes it when, whatever is killed; faults of
databases.
"""

import contextlib
import csv
import fcntl
import importlib.util
import json
import os
import re
import signal
import socket
import sqlite3
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from campaign_tools import (
    HERE,
    count,
    driver,
    invoke,
    run_here,
    sql,
    table,
    wait_for_end,
    wait_for_results,
    worker_processes,
    write_spec,
)
from children import DEVNULL, PIPE, STDOUT, call, child

from ffsm_drake import RunRecord
from ffsm_drake.common.errors import CampaignError
from ffsm_drake.common.time_limit import time_limit
from ffsm_drake.plugins.campaign.cases import make_cases
from ffsm_drake.plugins.campaign.evaluate import Evaluator
from ffsm_drake.plugins.campaign.run import resume_campaign, start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.campaign.store import Shard, create_store, open_store
from ffsm_drake.plugins.workers.pool import Stop

linux = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write_spec(tmp_path_factory.mktemp("spec") / "small.yaml", cases=16)


@pytest.fixture(scope="module")
def database(spec, tmp_path_factory):
    """The campaign, undisturbed, in this process. Not to be written to."""
    return run_here(spec, tmp_path_factory.mktemp("database") / "one.db")


def one_line_error(result, said):
    assert result.exit_code == 2, result.output
    assert said in result.output
    assert result.output.count("\n") == 1


@pytest.mark.long
def test_rows_that_another_program_removes_are_missed(tmp_path):
    """Rows removed at any moment of a campaign: it says so, with what to type; that restores
    them.
    """
    spec = write_spec(tmp_path / "few.yaml", cases=3)
    for moment in (1, 3, 5):
        path = tmp_path / f"{moment}.db"

        removed = []

        def remove(progress, path=path, moment=moment, removed=removed):
            if progress.done >= moment and not removed:
                rows = sql(path, "DELETE FROM results WHERE case_index = 0 RETURNING 1")
                removed.append(len(rows))

        with pytest.raises(CampaignError, match="another program removed results") as error:
            start_campaign(load_spec(spec), path, workers=HERE, progress=remove)
        stored = f"{6 - removed[0]} of 6 runs stored, 'ffsm campaign resume {path}'"
        assert stored in str(error.value)
        resume_campaign(path, workers=HERE)
        with open_store(path) as store:
            assert store.num_results() == 6


@pytest.mark.parametrize(
    "alone",
    [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.long)],
)
def test_runs_on_drake_are_kept_one_by_one(alone, tmp_path):
    """What an interruption ends is only the run under way. Compiled runs end together."""
    spec, seen = write_spec(tmp_path / "few.yaml", cases=8), list[int]()
    data = yaml.safe_load(spec.read_text())
    data["engine"] = "drake" if alone else "compiled"
    spec.write_text(yaml.safe_dump(data, sort_keys=False))
    start_campaign(
        load_spec(spec), tmp_path / "few.db", workers=HERE,
        progress=lambda progress: seen.append(progress.done),
    )  # fmt: skip
    sizes = np.diff(seen)
    assert sizes.sum() == seen[-1]
    assert (sizes.max() == 1) == alone


@contextlib.contextmanager
def dask_cluster(folder, *, threads):
    """The address of a Dask cluster, its scheduler, and the nanny of its one worker."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    quiet = {"stdout": DEVNULL, "stderr": DEVNULL, "cwd": folder}
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard"]
    with child([*dask, "--port", port], **quiet) as scheduler:
        dask[2:] = ["distributed.cli.dask_worker", "--no-dashboard", "--nthreads", str(threads)]
        address = f"tcp://127.0.0.1:{port}"
        with child([*dask, address], **quiet) as nanny:
            yield address, scheduler, nanny


@pytest.mark.long
def test_a_dask_scheduler_that_is_killed(tmp_path):
    """One line with what to type, and no traceback of the library's."""
    pytest.importorskip("distributed")
    spec = write_spec(tmp_path / "long.yaml", cases=400, overrides={"duration": 3.0})
    path = tmp_path / "x.db"
    with (
        dask_cluster(tmp_path, threads=1) as (address, scheduler, _),
        driver("run", str(spec), "--database", str(path), "--scheduler", address) as process,
    ):
        wait_for_results(process, path, 2)
        scheduler.kill()
        said, _ = process.communicate(timeout=90)
    errors = [line for line in said.splitlines() if " of 800 runs (" not in line]
    assert process.returncode == 2
    assert len(errors) == 1, said
    assert f"are stored, 'ffsm campaign resume {path}' runs the others" in errors[0]


@pytest.mark.long
@linux
def test_kills_and_an_interruption_change_nothing(spec, database, tmp_path):
    """One of two workers is killed, then the driver; SIGTERM interrupts what resumes; what resumes
    that finishes.
    """
    path = tmp_path / "disturbed.db"
    with driver("run", str(spec), "--database", str(path), "--workers", "2") as process:
        workers = wait_for_results(process, path, 2)
        os.kill(workers[0], signal.SIGKILL)
        workers += wait_for_results(process, path, count(path) + 2)
        assert process.poll() is None, "over before it could be killed"
        process.kill()
        process.communicate()
        wait_for_end(workers)
    with driver("resume", str(path), "--workers", "1") as process:
        workers = wait_for_results(process, path, count(path) + 2)
        process.terminate()
        output, _ = process.communicate(timeout=60)
        wait_for_end(workers)
    assert process.returncode == 143, output
    assert f"interrupted after run {count(path)} of 32" in output
    assert "Traceback" not in output
    assert sql(path, "SELECT count(*) FROM results WHERE outcome = 'error'") == [(0,)]
    # Not WAL, which cannot be read where nothing may be written.
    assert sql(path, "PRAGMA journal_mode") == [("delete",)]
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    resume_campaign(path, workers=HERE, stop=Stop())
    assert table(path) == table(database)
    assert len(table(path)) == 32


@pytest.mark.long
def test_a_dask_cluster_gives_the_same_table(spec, database, tmp_path):
    pytest.importorskip("distributed")
    path = tmp_path / "cluster.db"

    def kill_a_worker():
        while count(path) < 2:
            time.sleep(0.02)
        os.kill(worker_processes(nanny.pid)[0], signal.SIGKILL)  # Dask starts another

    with dask_cluster(tmp_path, threads=2) as (address, _, nanny):
        killer = threading.Thread(target=kill_a_worker, daemon=True)
        killer.start()
        result = invoke("run", spec, "--database", path, "--scheduler", address)
        assert result.exit_code == 0, result.output
        killer.join(timeout=10)
    assert table(path) == table(database)
    with open_store(path) as store:
        # another did the rest
        assert len({store.result(case, "tdc")["worker"] for case in range(16)}) == 2


@pytest.mark.long
def test_a_slurm_step_gives_the_same_table(spec, database, tmp_path):
    # not imported here: it takes hold of SIGINT
    if importlib.util.find_spec("dask_jobqueue") is None:
        pytest.skip("needs dask-jobqueue")
    command = [sys.executable, "-m", "ffsm_drake", "campaign", "run", str(spec)]
    step = {**os.environ, "SLURM_JOB_ID": "7", "SLURM_NTASKS": "4"}
    with contextlib.ExitStack() as stack:
        tasks = [
            stack.enter_context(
                child(
                    [*command, "--database", "whole.db", "--slurm"],
                    cwd=tmp_path,
                    env={**step, "SLURM_PROCID": str(number)},
                    stdout=PIPE,
                    stderr=STDOUT,
                    text=True,
                )
            )
            for number in range(4)
        ]
        said = [task.communicate(timeout=120)[0] for task in tasks]
    assert [task.returncode for task in tasks] == [0] * 4, said
    assert "32 of 32 runs" in said[1]
    lines = [line for each in (0, 2, 3) for line in said[each].splitlines()]
    assert all(re.match(r" *\d+ s: ", line) for line in lines), lines
    assert table(tmp_path / "whole.db") == table(database)
    assert not list(tmp_path.glob("scheduler-*"))


@pytest.mark.long
def test_rerun_compares_a_row_and_writes_its_record(database, tmp_path):
    path, out = tmp_path / "x.db", tmp_path / "asmc"
    path.write_bytes(database.read_bytes())
    words = ["rerun", path, "--case", 3, "-c", "asmc", "--out", tmp_path, "--no-recording"]
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    assert "all values equal the stored ones, bit for bit" in result.output
    record = RunRecord.load(out)
    with open_store(path) as store:
        row = store.result(3, "asmc")
    assert record.metrics["itae"] == row["itae"]
    assert record.scenario.random_seed == row["random_seed"]
    sql(path, "UPDATE results SET isv = isv * (1 + 1e-15) WHERE case_index = 3")
    result = invoke(*words)
    assert result.exit_code == 3
    assert "NOT as stored: isv" in result.output


@pytest.mark.smoke
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
    masses = [row["payload.truth.mass"] for row in wanted]
    assert [float(row["payload.truth.mass"]) for row in rows] == masses
    pq = pytest.importorskip("pyarrow.parquet")
    with open_store(database) as store:
        store.export(tmp_path / "runs.parquet")
        with pytest.raises(CampaignError, match=r"must end in \.csv or \.parquet"):
            store.export(tmp_path / "runs.xlsx")
    frame = pq.read_table(tmp_path / "runs.parquet").to_pydict()
    assert frame["payload.truth.mass"] == masses
    assert frame["outcome"] == [row["outcome"] for row in wanted]
    assert json.loads(frame["payload.nominal.inertia"][0])[0] > 0


def test_databases_that_cannot_be_used(spec, database, tmp_path):
    other = write_spec(tmp_path / "other.yaml", seed=6)
    (tmp_path / "noise.db").write_bytes(os.urandom(8192))
    sql(tmp_path / "foreign.db", "CREATE TABLE t (x)")
    whole = database.read_bytes()
    (tmp_path / "half.db").write_bytes(whole[:8192] + os.urandom(len(whole) - 8192))
    (tmp_path / "file").write_text("")
    faults = {
        f"run {spec} --database {database}": "exists; finish it with 'ffsm campaign resume",
        f"run {other} --database {database}": "holds another campaign",
        f"resume {other} --database {database}": "holds another campaign",
        f"status {tmp_path}/nothing.db": "no such database",
        f"resume {tmp_path}/noise.db": "is damaged or not a campaign's database",
        f"status {tmp_path}/foreign.db": "is not a campaign's database",
        f"resume {tmp_path}/half.db": "damaged",
        f"run {spec} --database {tmp_path}/file/x.db": "cannot be written",
        f"report {database} --out {tmp_path}/file": "cannot be written",
        f"rerun {database} --case 16": "has no case 16; there are 0 to 15",
        f"rerun {database} --case 1 --controller aismc": "'aismc' is not in this campaign",
        f"run {spec} --workers 1 --scheduler tcp://127.0.0.1:1": "give one of them",
        f"run {spec} --slurm": "srun --ntasks",
    }
    for words, said in faults.items():
        one_line_error(invoke(*words.split()), said)


DAMAGES = {
    "no specification": (
        "DELETE FROM campaign WHERE key = 'specification'",
        "holds no usable specification",
    ),
    "no format": ("DELETE FROM campaign WHERE key = 'format'", "format None is not"),
    "half a specification": (
        "UPDATE campaign SET value = substr(value, 1, 200) WHERE key = 'specification'",
        "holds no usable specification",
    ),
    "another specification": (
        "UPDATE campaign SET value = '[1]' WHERE key = 'specification'",
        "holds no usable specification",
    ),
    "a foreign index": (
        "UPDATE results SET case_index = 16 WHERE case_index = 3 AND controller = 'tdc'",
        "of case 16",
    ),
    "a case too many": (
        "INSERT INTO cases SELECT 99, random_seed, 1, 1, 1, 1, 1, 1 FROM cases LIMIT 1",
        "17 cases",
    ),
    "a missing case": ("DELETE FROM cases WHERE case_index = 4", "15 cases"),
    "text in a number": (
        "UPDATE results SET itae = 'much' WHERE case_index = 2",
        "the results of case 2",
    ),
    "bytes in a text": (
        "UPDATE results SET message = x'00ff' WHERE case_index = 2",
        "the results of case 2",
    ),
    "an unknown outcome": (
        "UPDATE results SET outcome = 'won' WHERE case_index = 2",
        "the results of case 2",
    ),
    "an unknown controller": (
        "UPDATE results SET controller = 'pid' WHERE case_index = 2 AND controller = 'tdc'",
        "the results of case 2",
    ),
    "a missing value": (
        "UPDATE cases SET nominal_error = NULL WHERE case_index = 1",
        "the cases of case 1",
    ),
    "half a list": (
        "UPDATE cases SET \"payload.truth.inertia\" = '[1' WHERE case_index = 1",
        "of case 1 is no value",
    ),
    "another column": (
        "ALTER TABLE cases RENAME COLUMN nominal_error TO other",
        "its tables are not a campaign's",
    ),
    "bytes in a column's name": (
        "PRAGMA writable_schema = 1; UPDATE sqlite_schema SET sql = "
        "replace(sql, 'results.isv', 'results' || CAST(x'c9' AS TEXT) || 'isv') WHERE name = "
        "'runs'",
        "damaged",
    ),
    "no table": ("DROP TABLE software", "its tables are not a campaign's"),
    "a trigger": (
        "CREATE TRIGGER more AFTER INSERT ON results BEGIN DELETE FROM cases; END",
        "its tables are not a campaign's",
    ),
    "results without a key": (
        "CREATE TABLE more AS SELECT * FROM results; DROP VIEW runs; DROP "
        "TABLE results; ALTER TABLE more RENAME TO results",
        "its tables are not a campaign's",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_database_is_one_line(damage, database, tmp_path):
    path = tmp_path / "damaged.db"
    path.write_bytes(database.read_bytes())
    statement, said = DAMAGES[damage]
    with contextlib.closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(statement)
    one_line_error(
        invoke("rerun", path, "--case", "1", "--controller", "tdc", "--out", tmp_path / "out"), said
    )
    assert not (tmp_path / "out").exists()


def test_text_values_come_back_as_they_were(tmp_path):
    values = [
        "[not json",
        "true",
        "null",
        '"quoted"',
        "{",
        "kalman",
        True,
        None,
        [1, "true"],
        7,
        0.5,
    ]
    spec = write_spec(
        tmp_path / "s.yaml",
        parameters={"estimator.kind": {"distribution": "list", "values": values}},
        factors={},
        derive={},
        cases=len(values),
    )
    loaded = load_spec(spec)
    with create_store(tmp_path / "x.db", loaded, make_cases(loaded)) as store:
        found = [
            case.values["estimator.kind"]
            for case, controller in store.pending()
            if controller == "tdc"
        ]
    assert [(type(value), value) for value in found] == [(type(value), value) for value in values]
    assert [path.name for path in tmp_path.glob(".*")] == []  # no lock stays behind


def test_columns_named_as_others_are_told_apart(tmp_path):
    names = ("id", "versions", "value", "rowid", "select")
    spec = write_spec(
        tmp_path / "s.yaml",
        factors={name: {"distribution": "uniform", "low": 0, "high": 1} for name in names},
        derive={"payload.nominal.mass": {"rule": "scale", "of": list(names)}},
    )
    loaded = load_spec(spec)
    with create_store(tmp_path / "x.db", loaded, make_cases(loaded)) as store:
        store.export(tmp_path / "runs.csv")
        assert {*names} < {*store.columns}
        assert store.sampled("rowid") != list(range(8))


def test_a_campaign_with_fewer_cases_is_found_by_its_name(database, tmp_path):
    """Made with --cases, it is that of the same specification."""
    more = write_spec(tmp_path / "more.yaml", cases=400)
    result = invoke("status", more, "--database", database)
    assert result.exit_code == 0, result.output
    assert "32 of 32 runs (100.0 %)" in result.output


BLOCKED = """
import dataclasses, time
from ffsm_drake import ControlLaw

@dataclasses.dataclass(frozen=True)
class Sleeps(ControlLaw):
    def step(self, sample, state):
        time.sleep(1000.0)

@dataclasses.dataclass(frozen=True)
class Computes(ControlLaw):
    def step(self, sample, state):
        while True:
            try:
                sum(range(1000))
            except Exception:
                pass
"""


@pytest.mark.slow
@pytest.mark.parametrize("law", ["Sleeps", "Computes"])
def test_a_controller_that_never_returns_is_a_row(law, tmp_path):
    module = f"blocked_{law.lower()}"
    (tmp_path / f"{module}.py").write_text(BLOCKED)
    controllers = [f"{module}:{law}", "tdc"]
    overrides = {"python_path": [str(tmp_path)], "duration": 0.05}
    spec = load_spec(
        write_spec(
            tmp_path / "s.yaml", controllers=controllers, overrides=overrides, time_limit=1.0
        )
    )
    evaluator, case = Evaluator(spec), next(make_cases(spec))
    blocked, good = (evaluator.evaluate(case, name) for name in controllers)
    assert (blocked["outcome"], blocked["message"]) == (
        "error",
        "TimeLimit: took longer than 1 s of wall time (time_limit)",
    )
    assert blocked["wall_time"] < 5.0
    assert good["outcome"] != "error"


@pytest.mark.parametrize(
    "address",
    [
        "not an address",
        "tcp://[::1",
        "ucx://127.0.0.1:8786",
        "tcp://127.0.0.1",
        "tcp://127.0.0.1:99999",
        "inproc://x:1",
        "",
        "tcp://127.0.0.1:0",
        "tcp://\n:1",
    ],
)
def test_an_address_that_is_none_is_refused_at_once(address, spec, tmp_path):
    start = time.monotonic()
    result = invoke("run", spec, "--database", tmp_path / "x.db", "--scheduler", address)
    one_line_error(result, "is not an address such as tcp://127.0.0.1:8786")
    assert time.monotonic() - start < 1.0
    assert not (tmp_path / "x.db").exists()


def _never_ends():
    """Code that no Python exception can interrupt."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
    pytest.MonkeyPatch().setattr("ffsm_drake.common.time_limit.GRACE", 0.1)
    with time_limit(0.1):
        time.sleep(1000.0)


def test_a_worker_that_cannot_be_interrupted_is_ended():
    with pytest.raises(ChildProcessError, match="ended with 1"):
        call(_never_ends, longest=20.0)


def test_a_database_in_use(database, tmp_path, monkeypatch):
    path = tmp_path / "used.db"
    path.write_bytes(database.read_bytes())
    with (tmp_path / ".used.db.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        one_line_error(invoke("resume", path), "is in use; another campaign is writing to it")
    monkeypatch.setattr("ffsm_drake.plugins.campaign.store.PATIENCE", 0.1)
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("BEGIN EXCLUSIVE")
        one_line_error(invoke("resume", path), "database is locked")


def run_shards(spec, folder, count):
    paths = [folder / f"{number}.db" for number in range(1, count + 1)]
    for number, path in enumerate(paths, start=1):
        start_campaign(load_spec(spec), path, workers=HERE, shard=Shard(number, count))
    return paths


@pytest.mark.smoke
def test_merged_shards_are_one_run(spec, database, tmp_path):
    """Also from a shard that was interrupted: what is missing is run by 'resume'."""
    paths = run_shards(spec, tmp_path, 3)
    assert [count(path) for path in paths] == [12, 10, 10]
    assert "12 of 12 runs (100.0 %) of shard 1/3" in invoke("status", paths[0]).output
    result = invoke("merge", *reversed(paths), "--out", tmp_path / "whole.db")
    assert result.exit_code == 0, result.output
    assert "32 of 32 runs (100.0 %)\n" in result.output
    assert table(tmp_path / "whole.db") == table(database)
    sql(paths[1], "DELETE FROM results WHERE case_index = 4")
    assert invoke("merge", *paths, "--out", tmp_path / "part.db").exit_code == 0
    assert count(tmp_path / "part.db") == 30
    for path in (paths[1], tmp_path / "part.db"):
        resume_campaign(path, workers=HERE)
    assert count(paths[1]) == 10
    assert table(tmp_path / "part.db") == table(database)


@pytest.mark.slow
def test_databases_that_cannot_be_merged(spec, database, tmp_path):
    out = tmp_path / "whole.db"
    same = tmp_path / "same.db"
    same.write_bytes(database.read_bytes())
    shard = "UPDATE campaign SET value = '{}' WHERE key = 'shard'"
    faults = {
        "an earlier database also holds case 0 with asmc": "SELECT 1",
        "case 3 has other values": "UPDATE cases SET random_seed = 1 WHERE case_index = 3",
        "--shard: must be I/N with I from 1 to N, not '5/4'": shard.format("5/4"),
        "it holds 32 results of 16 runs": shard.format("1/2"),
    }
    for said, statement in faults.items():
        sql(same, statement)
        one_line_error(invoke("merge", database, same, "--out", out), said)
        assert not out.exists()
    other = run_shards(write_spec(tmp_path / "o.yaml", seed=6, cases=2), tmp_path, 2)
    one_line_error(invoke("merge", database, *other, "--out", out), "holds another campaign")
    one_line_error(invoke("merge", database, "--out", database), "exists; finish it with")
    for text in ("0/2", "3/2", "1", "a/b", "1/0", "1/2/3", ""):
        one_line_error(invoke("run", spec, "--shard", text), "--shard: must be I/N")


@pytest.mark.slow
def test_errors_are_counted_by_cause_and_only_errors_are_no_success(tmp_path):
    masses = {"payload.truth.mass": {"distribution": "list", "values": [100, -5, -6, 80]}}
    given = {"overrides": {"duration": 0.1}, "factors": {}, "derive": {}}
    spec = write_spec(tmp_path / "s.yaml", **given, cases=4, parameters=masses, controllers="tdc")
    path = run_here(spec, tmp_path / "x.db")
    done = invoke("resume", path, "--workers", 1)
    assert done.exit_code == 0, done.output
    cause = "ScenarioError: payload.truth.mass: must be > 0 kg, not -5"
    assert f"\nerror in 2 runs, such as: {cause}\n" in done.stdout
    sql(path, "UPDATE results SET outcome = 'error', message = 'late' WHERE outcome != 'error'")
    failed = invoke("resume", path, "--workers", 1)
    assert failed.exit_code == 2
    assert "\nerror in 2 runs, such as: late\n" in failed.stdout
    for case, value in enumerate(("0.25", "-3", "1.5e-07", "nan")):
        said = f"late by {value} s of joint"
        sql(path, f"UPDATE results SET message = '{said}' WHERE case_index = {case}")
    assert "\nerror in 4 runs, such as: late by 0.25 s of joint\n" in invoke("status", path).stdout
    last = failed.stderr.splitlines()[-1]
    assert last.startswith(f"error: {path}: every run ended in an error, such as: late; ")
    assert "Next:" not in failed.stdout


def test_a_campaign_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    spec = write_spec(tmp_path / "mine.yaml", cases=1, controllers="tdc")
    assert "mine: no such database" in invoke("status", "mine").stderr
    Path("out/campaigns").mkdir(parents=True)
    run_here(spec, Path("out/campaigns/mine.db"))
    for source in ("mine", "mine.yaml", "out/campaigns/mine.db"):
        assert invoke("status", source).stdout.startswith("out/campaigns/mine.db: a small campaign")
    assert invoke("status", "other/mine").exit_code == 2
