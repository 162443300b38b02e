"""A disk that is full at any byte: what a failed command made is gone, or is whole."""

import importlib.util
import os
import resource
import shutil
import sqlite3
import traceback
from contextlib import closing
from pathlib import Path

import pytest
from alone import run_alone
from children import forked
from click.testing import CliRunner
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from ffsm_drake import RunRecord
from ffsm_drake.cli import main
from ffsm_drake.spacecraft.plant import models_dir

campaign_tools = pytest.importorskip("campaign_tools")
run_here, write_spec = campaign_tools.run_here, campaign_tools.write_spec

SERVICER = str(models_dir() / "urdf" / "servicer.urdf")
SHORT = ("--set", "duration=0.05")
COMMANDS = {
    "run": ("run", *SHORT, "--no-report", "--out", "new/a/b"),
    "report": ("run", *SHORT, "--out", "new/a/b"),
    "again": ("run", *SHORT, "--set", "random_seed=3", "--no-report", "--out", "old"),
    "plot": ("plot", "old", "--out", "new/a"),
    "plot here": ("plot", "old"),
    "analyze": ("analyze", "old", "--out", "new/a"),
    "replay": ("replay", "old", "--out", "new/a/r.html"),
    **{
        f"export {end}": ("export", f"new/run.{end}", "old")
        for end in ("mcap", "csv", "parquet", "mat", "fmu")
        if importlib.util.find_spec("ffsm_drake.plugins.exports")
    },
    "diagram": ("diagram", "--out", "new/a/d.svg"),
    "new": ("new", "made", "--urdf", SERVICER),
    "campaign": ("campaign", "run", "c.yaml", "--workers", "1", "--database", "new/c.db"),
    "resume": ("campaign", "resume", "part.db", "--workers", "1"),
    "pages": ("campaign", "report", "all.db", "--out", "new/pages"),
}
QUICK = {"run", "again", "plot", "plot here", "replay", "campaign", "diagram", "export mcap"}


@pytest.fixture(scope="module")
def before(tmp_path_factory, run):
    """A folder with a record, a campaign's specification, and one of its databases."""
    folder = tmp_path_factory.mktemp("before")
    run("postcapture", "duration=0.05").save(folder / "old")
    mass = {"payload.truth.mass": {"distribution": "uniform", "low": 20, "high": 300}}
    changes = {"cases": 2, "overrides": {"duration": 0.05}, "factors": {}, "derive": {}}
    run_here(write_spec(folder / "c.yaml", parameters=mass, **changes), folder / "all.db")
    shutil.copyfile(folder / "all.db", folder / "part.db")
    with closing(sqlite3.connect(folder / "part.db")) as database, database:
        database.execute("DELETE FROM results WHERE case_index = 1")
    return folder


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in Path(folder).rglob("*")
        if "__pycache__" not in path.parts
    }


def check(before, name, size):
    """In a child: run a command while no file may grow beyond a size, bytes."""
    shutil.rmtree("here", ignore_errors=True)
    shutil.copytree(before, "here")
    os.chdir("here")
    old = contents(".")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    result = CliRunner().invoke(main, [*COMMANDS[name]])
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code in (0, 2), result.output
    if result.exit_code == 0:
        return
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, result.stderr
    assert ".partial" not in errors[0]
    new = contents(".")
    if name == "report" and "new/a/b/manifest.json" in new:  # the record was saved before
        RunRecord.load("new/a/b")
        new = {path: kept for path, kept in new.items() if not path.startswith("new")}
    if name == "resume":
        with closing(sqlite3.connect("part.db")) as database:
            assert database.execute("PRAGMA quick_check").fetchone() == ("ok",)
            assert database.execute("SELECT count(*) FROM results").fetchone()[0] in (2, 3)
        for files in (old, new):
            for path in ("part.db", "part.db-wal", "part.db-shm"):
                files.pop(path, None)
    left = {path for path in new if new[path] != old.get(path, b"nothing")}
    assert not left, f"left behind: {sorted(left)}; {errors[0]}"
    assert new.keys() == old.keys()


def in_child(act):
    """What went wrong in a forked child, as text; in a process with one thread."""

    def tried(tell):
        try:
            act()
        except BaseException:
            tell(traceback.format_exc()[-4000:])

    fork = forked(tried, silence=150.0)
    return fork.death or fork.told


def full_at_drawn_bytes(before, names, count):
    for command in ("run", "plot", "diagram"):  # so that the children find models and modules
        check(before, command, 10**9)
        os.chdir("..")
    # most files end below 200 kB; small sizes meet the first of several files
    sizes = st.one_of(st.integers(0, 5_000), st.integers(0, 200_000), st.integers(0, 8_000_000))

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )
    @given(st.sampled_from(names), sizes)
    def fill(name, size):
        problem = in_child(lambda: check(before, name, size))
        assert not problem, f"{name}, full at {size} bytes: {problem}"

    fill()


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_full_disk_leaves_nothing_by_halves(before, place):
    run_alone(full_at_drawn_bytes, before, [name for name in COMMANDS if name in QUICK], 12)


@pytest.mark.parametrize(
    "count",
    [
        pytest.param(40, marks=pytest.mark.long),
        pytest.param(1000, marks=pytest.mark.exhaustive),
    ],
)
def test_a_full_disk_leaves_nothing_by_halves_for_long(before, place, count):
    run_alone(full_at_drawn_bytes, before, [*COMMANDS], count, inputs=count)
