"""Several programs at one record's folder: nothing is lost, and a reader sees one record."""

import itertools
import json
import os
import shutil
import threading
import time
from pathlib import Path

import pytest
from click.testing import CliRunner

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.cli import main
from ffsm_drake.common import files
from ffsm_drake.common.errors import RecordError
from ffsm_drake.common.files import published, read_together
from ffsm_drake.runs import record as records
from ffsm_drake.runs.record import record_stamp


@pytest.fixture(scope="module")
def runs():
    """Two short runs that differ."""
    scenarios = [
        load_scenario("postcapture", ["duration=0.05"]).replace(random_seed=k) for k in (1, 2)
    ]
    return [simulate(each, check_stability=False) for each in scenarios]


def seeds_in(folder):
    """Folder -> seed of each record beneath, loaded."""
    found = {path.parent: RunRecord.load(path.parent) for path in folder.rglob("manifest.json")}
    return {place.relative_to(folder): each.scenario.random_seed for place, each in found.items()}


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("files", [(), ("notes.txt",), ("manifest.json",)])
def test_what_comes_while_a_record_is_written_stays(there, files, runs, tmp_path, monkeypatch):
    """Whether the folder was there before or not, and whatever it then holds."""
    place, digest_of = tmp_path / "out", records.digest_of
    if there:
        place.mkdir()

    def meanwhile(path):
        if "manifest.json" in files:
            runs[1].save(place)
        place.mkdir(exist_ok=True)
        if "notes.txt" in files:
            (place / "notes.txt").write_text("mine")
        return digest_of(path)

    monkeypatch.setattr(records, "digest_of", lambda path: (monkeypatch.undo(), meanwhile(path))[1])
    saved = runs[0].save(place)
    assert RunRecord.load(saved).scenario.random_seed == 1
    if "manifest.json" in files:
        assert seeds_in(tmp_path) == {Path("out"): 2, Path("out_2"): 1}
    else:
        assert saved == place
        assert seeds_in(tmp_path) == {Path("out"): 1}
    if "notes.txt" in files:
        assert (place / "notes.txt").read_text() == "mine"
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.slow
def test_a_run_that_finds_another_says_where_it_is(runs, tmp_path, monkeypatch):
    """The other came while the first was simulated; the third finds two."""
    monkeypatch.chdir(tmp_path)
    simulate_one = records.compute_metrics
    others = []

    def meanwhile(data):
        if not others:
            others.append(runs[1])
            shutil.copytree("other", "out")
        return simulate_one(data)

    runs[1].save("other")
    monkeypatch.setattr(records, "compute_metrics", meanwhile)
    line = ["run", "postcapture", "--set", "duration=0.05", "--seed", "1", "--out", "out"]
    result = CliRunner().invoke(main, [*line, "--no-report"])
    assert result.exit_code == 0, result.output
    assert (
        "warning: another run was written to out meanwhile; this run is in out_2" in result.stderr
    )
    assert "Written to out_2" in result.stdout
    assert seeds_in(tmp_path) == {Path("out"): 2, Path("out_2"): 1, Path("other"): 2}
    again = CliRunner().invoke(main, [*line, "--no-report"])  # it was there before
    assert again.exit_code == 0, again.output
    assert seeds_in(tmp_path)[Path("out")] == 1


@pytest.mark.long
def test_a_reader_beside_a_writer_sees_one_record(runs, tmp_path):
    """Files with and without a lock: a set, and each file, is old or new."""
    good = [run.save(tmp_path / str(run.scenario.random_seed)) for run in runs]
    place, over, wrong, seen = tmp_path / "out", threading.Event(), [], set()
    shutil.copytree(good[0], place)
    manifests = {(each / "manifest.json").read_bytes() for each in good}

    def write():
        until = time.monotonic() + 100.0  # a busy machine may write hundreds of times per reading
        for k in itertools.count():
            if k >= 60 and (seen == {1, 2} or time.monotonic() > until):
                break
            with published(place) as folder:
                shutil.copytree(good[k % 2], folder, dirs_exist_ok=True)
        over.set()

    def look():
        while not over.is_set():
            try:
                if (place / "manifest.json").read_bytes() not in manifests:
                    wrong.append("a mixture")
            except OSError as error:
                wrong.append(repr(error))

    threads = [threading.Thread(target=each) for each in (write, look)]
    for thread in threads:
        thread.start()
    while not over.is_set():
        seen.add(RunRecord.load(place).scenario.random_seed)
    for thread in threads:
        thread.join()
    assert not wrong
    assert seen == {1, 2}


def test_a_reader_notices_an_exchange_and_its_return(tmp_path, monkeypatch):
    """Copies keep times and sizes, and a file system may give their numbers again."""
    monkeypatch.setattr(files, "_PATIENCE", 0.01)
    place, good = tmp_path / "out", [tmp_path / "1", tmp_path / "2"]
    for folder in good:
        folder.mkdir()
        for name in "ab":
            (folder / name).write_text(folder.name)
    shutil.copytree(good[0], place)
    calls = []

    def exchange(k):
        with published(place) as folder:
            shutil.copytree(good[k], folder, dirs_exist_ok=True)

    def read():
        calls.append(None)
        first = (place / "a").read_text()
        if len(calls) <= 20:
            exchange(1)
        second = (place / "b").read_text()
        if len(calls) <= 20:
            exchange(0)
        if first != second:
            raise RecordError("a mixture")
        return first

    assert read_together([place / "a", place / "b"], read) == "1"
    assert len(calls) == 21


def test_a_stopped_writer_does_not_stop_another(runs, tmp_path, monkeypatch):
    import fcntl

    monkeypatch.setattr(files, "_PATIENCE", 0.05)
    place = runs[0].save(tmp_path / "out")
    folder = os.open(place, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    stamp = record_stamp(place)
    runs[1].save(place)
    os.close(folder)
    assert record_stamp(place) != stamp
    assert json.loads((place / "manifest.json").read_text())["random_seed"] == 2
