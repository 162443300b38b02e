"""SIGINT, SIGTERM and SIGHUP at drawn instants of commands: what is there is whole, the exit code
says which, and nothing is left running.
"""

import os
import random
import shutil
import signal
import sqlite3
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest
from children import PIPE, TimeoutExpired, child, processes

from ffsm_drake import RunRecord
from ffsm_drake.scenario import load_scenario

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
MOST = 60.0  # s to the end after a signal
SPEC = """
description: small
scenario: postcapture
overrides: {duration: 0.3}
controllers: [tdc]
cases: 6
seed: 5
parameters: {payload.truth.mass: {distribution: uniform, low: 20, high: 300}}
settled: {hold: 0.1}
"""
# words, and the seconds within which a signal comes: beyond what an undisturbed one lasts
COMMANDS = (
    (("run", "--no-report", "--out", "new/run", "--set", "duration=60"), 5.0),
    (("run", "--out", "new/run", "--set", "duration=0.5"), 6.0),
    (("campaign", "run", "c.yaml", "--database", "new/c.db", "--workers", "2"), 9.0),
    (("design", "--time", "2", "--out", "new/design", "--set", "duration=1"), 8.0),
    (("replay", "old", "--out", "new/replay/r.html"), 4.0),
    (("plot", "old", "--out", "new/plots"), 6.0),
    (("analyze", "old", "--out", "new/analysis"), 6.0),
)


def check_whole(words, code):
    new = Path("new")
    assert not list(Path().rglob("*partial*"))
    assert not list(Path().rglob(".*.lock"))
    empty = [path for path in new.rglob("*") if path.is_dir() and not any(path.iterdir())]
    assert not empty, f"empty folders: {empty}"
    assert not new.exists() or any(new.iterdir())
    if (new / "run").exists():
        record = RunRecord.load(new / "run")
        assert record.outcome.status in ("completed", "interrupted")
    if (new / "c.db").exists():
        with closing(sqlite3.connect(new / "c.db")) as database:
            assert database.execute("PRAGMA quick_check").fetchone() == ("ok",)
            assert database.execute("SELECT count(*) FROM cases").fetchone() == (6,)
    for name, files in (
        ("design", {"design.yaml", "design.png"}),
        ("analysis", {"analysis.json", "analysis.png"}),
        ("plots", {f"{each}.png" for each in ("trajectories", "errors", "efforts", "gains")}),
    ):
        if (new / name).exists():
            assert {path.name for path in (new / name).iterdir()} == files
    if (new / "design").exists():
        load_scenario("new/design/design.yaml")
    for page in new.rglob("*.html"):
        assert page.read_text().rstrip().endswith("</html>")
    if code == 0:
        assert any(new.rglob("*"))


def disturb(old, draw):
    """Start a command, send it a signal, look at what is left. Returns its end in words."""
    words, longest = draw.choice(COMMANDS)
    number, instant = draw.choice(SIGNALS), draw.uniform(0.0, longest)
    shutil.rmtree("new", ignore_errors=True)
    said = f"{' '.join(words)}: {number.name} at {instant:.2f} s"
    command = [sys.executable, "-m", "ffsm_drake", *words]
    with child(command, stdout=PIPE, stderr=PIPE, text=True) as process:
        try:
            _, stderr = process.communicate(timeout=instant)
        except TimeoutExpired:
            process.send_signal(number)
            _, stderr = process.communicate(timeout=MOST)
        end = time.monotonic() + 10.0
        while left := [one for one in processes() if one.session == process.pid]:
            if time.monotonic() > end:
                break
            time.sleep(0.05)
        assert not left, f"{said}: still running: {[*map(str, left)]}"
        # before Python runs a line of ours, the signal meets its own handler or the system's
        if process.returncode != -number or instant > 0.5:
            assert "Traceback" not in stderr, f"{said}: {stderr}"
            codes = (0, 3, 128 + number)
            assert process.returncode in codes, f"{said}: {process.returncode}: {stderr}"
        check_whole(words, process.returncode)
    return "interrupted" if process.returncode not in (0, 3) else "in time"


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
def test_signals_at_any_instant(tmp_path, monkeypatch, run):
    """As many as the variable SIGNALS says, 6 without."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    Path("c.yaml").write_text(SPEC)
    run("postcapture", "duration=0.2").save("old")
    draw, ends, unclean = random.Random(28), {}, []
    for _ in range(int(os.environ.get("SIGNALS", "6"))):
        try:
            end = disturb("old", draw)
        except (AssertionError, TimeoutExpired, OSError) as error:
            end = "unclean"
            unclean.append(f"{type(error).__name__}: {error}")
        ends[end] = ends.get(end, 0) + 1
        print(ends, *unclean[len(unclean) - (end == "unclean") :], flush=True)
    assert not unclean, "\n".join(unclean)
