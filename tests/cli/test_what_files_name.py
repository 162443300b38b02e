"""What files from elsewhere lead to, as SECURITY.md lists it: which commands import what a record
or a database names, and files that would be read without end.
"""

import json
import os
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
from click.testing import CliRunner
from record_tools import sealed

from ffsm_drake.cli import main
from ffsm_drake.common.errors import CampaignError

campaign_tools = pytest.importorskip("campaign_tools")
run_here, write_spec = campaign_tools.run_here, campaign_tools.write_spec
open_store = pytest.importorskip("ffsm_drake.plugins.campaign").open_store

NAMED = "module_that_a_file_names"
# command -> whether it imports what the scenario of a record names
OF_A_RECORD = {
    ("plot", "it", "--out", "out"): False,
    ("replay", "it", "--out", "out/r.html"): False,
    ("export", "out/x.csv", "it"): False,
    ("export", "out/x.mcap", "it"): False,
    ("scenarios", "it"): False,
    ("analyze", "it", "--out", "out"): True,
    ("validate", "it", "--no-rehearsal"): True,
    ("stability", "it"): True,
    ("diagram", "it"): True,
    ("run", "it", "--no-report", "--out", "out"): True,
    ("export", "out/x.fmu", "it"): False,  # the plant has no law
    ("export", "out/x.fmu", "it", "--part", "controller"): True,
}
OF_A_DATABASE = {
    ("campaign", "status", "it.db"): False,
    ("campaign", "report", "it.db", "--out", "out"): False,
    ("campaign", "merge", "it.db", "it.db", "--out", "out.db"): False,
    ("campaign", "rerun", "it.db", "--case", "1", "--no-recording", "--out", "out"): True,
    ("campaign", "resume", "it.db", "--workers", "1"): True,  # in a worker
}


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A current folder with a module that only files name; returns whether it was imported."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    flag = tmp_path / "imported"
    (folder / f"{NAMED}.py").write_text(
        f"open({str(flag)!r}, 'w').close()\ndef make(setup): raise RuntimeError('was called')\n"
    )
    yield flag.exists
    sys.modules.pop(NAMED, None)


@pytest.mark.slow
@pytest.mark.parametrize(("command", "imports"), OF_A_RECORD.items(), ids=str)
@pytest.mark.usefixtures("rough_pictures")
def test_a_record_is_a_program_where_it_is_run(command, imports, here, run):
    if command[0] == "export":
        pytest.importorskip("ffsm_drake.plugins.exports")
    if "out/x.fmu" in command and shutil.which("cc") is None:
        pytest.skip("needs a C compiler")
    if "out/x.mcap" in command:
        pytest.importorskip("foxglove")
    run("postcapture", "duration=0.05").save("it")
    path = Path("it/manifest.json")
    data = json.loads(path.read_text())
    data["scenario"] |= {"controller": f"{NAMED}:make", "python_path": ["../elsewhere"]}
    path.write_text(json.dumps(data))
    sealed(Path("it"))
    result = CliRunner().invoke(main, list(command))
    assert here() == imports, result.output
    assert result.exit_code in (0, 2), result.output
    assert (result.exit_code == 0) >= (not imports)


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    folder = tmp_path_factory.mktemp("database")
    changes = {"cases": 2, "controllers": ["tdc"], "overrides": {"duration": 0.02}}
    mass = {"payload.truth.mass": {"distribution": "uniform", "low": 20, "high": 300}}
    changes |= {"parameters": mass, "factors": {}, "derive": {}}
    return run_here(write_spec(folder / "s.yaml", **changes), folder / "it.db")


def changed(database, *statements):
    """A copy of a database in the current folder, after some statements."""
    shutil.copyfile(database, "it.db")
    with closing(sqlite3.connect("it.db")) as connection, connection:
        for statement in statements:
            connection.execute(*statement)


@pytest.mark.long
@pytest.mark.parametrize(("command", "imports"), OF_A_DATABASE.items(), ids=str)
def test_a_database_is_a_program_where_it_is_run(command, imports, here, database):
    with open_store(database) as store:
        spec = json.loads(store.spec.to_json())
    spec["controllers"] = [f"{NAMED}:make"]
    spec["base"]["python_path"] = ["elsewhere"]
    changed(
        database,
        ("UPDATE campaign SET value = ? WHERE key = 'specification'", (json.dumps(spec),)),
        ("UPDATE results SET controller = ?", (f"{NAMED}:make",)),
        *([("DELETE FROM results WHERE case_index = 0",)] if "resume" in command else []),
    )
    result = CliRunner().invoke(main, list(command))
    assert here() == imports, result.output
    assert result.exit_code in (0, 2, 3), result.output
    assert "Traceback" not in result.output


ENDLESS = (
    "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n) SELECT k AS key, k AS value "
    "FROM n"
)


@pytest.mark.parametrize(
    "statements",
    [
        ("DROP TABLE campaign", f"CREATE VIEW campaign AS {ENDLESS}"),
        ("DROP VIEW runs", f"CREATE VIEW runs AS {ENDLESS}"),
        ("CREATE TRIGGER t AFTER INSERT ON results BEGIN DELETE FROM cases; END",),
    ],
    ids=["table", "view", "trigger"],
)
def test_a_database_runs_no_sql_of_its_own(statements, here, database):
    changed(database, *((each,) for each in statements))
    with pytest.raises(CampaignError, match="is damaged"), open_store(Path("it.db")):
        pass


@pytest.mark.parametrize("name", ["/dev/zero", "pipe"])
@pytest.mark.parametrize("key", ["reference.plan", "model.servicer", "controller", "extends"])
def test_no_device_or_pipe_is_read(key, name, here):

    os.mkfifo("pipe")
    if key == "extends":
        Path("s.yaml").write_text(json.dumps({"extends": name}))
        words = ["s.yaml"]
    else:
        value = f"policy:{name}" if key == "controller" else name
        words = ["postcapture", "--set", f"{key}={value}"]
        words += ["--set", "reference.kind=optimal"] if key == "reference.plan" else []
    result = CliRunner().invoke(main, ["validate", "--no-rehearsal", *words])
    assert result.exit_code == 2, result.output
    assert len(result.stderr.splitlines()) == 1, result.stderr
