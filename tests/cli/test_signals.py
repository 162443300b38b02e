"""SIGINT, SIGTERM and SIGHUP at drawn instants of commands, and while something in them never
returns: they end in time, what is there is whole, the exit code says which, and nothing is left
running.
"""

import os
import random
import shutil
import signal
import sqlite3
import sys
import time
from contextlib import ExitStack, closing
from pathlib import Path

import blocked
import pytest
from children import DEVNULL, PIPE, TimeoutExpired, child, finished, processes

from ffsm_drake import RunRecord
from ffsm_drake.scenario import load_scenario

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
MOST = 60.0  # s to the end after a signal
SLOWNESS = float(os.environ.get("SLOWNESS", "3"))  # factor on bounds of time
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


# Commands, and where in them a call never returns: in the law where no function is named.
PLANT, READING = "ffsm_drake.spacecraft.plant:make_plant", "ffsm_drake.runs.record:RunRecord.load"
STUCK = {
    "run": ("", "run -c blocked:Law --out new --set duration=1"),
    "compare": ("", "compare -c tdc -c blocked:Law --out new --set duration=0.2 --no-report"),
    "benchmark": ("", "benchmark paper -c blocked:Law --out new --workers 2"),
    "campaign run": ("", "campaign run b.yaml --database new/b.db --workers 2"),
    "campaign run, one worker": ("", "campaign run b.yaml --database new/b.db --workers 1"),
    "campaign plan": ("", "campaign plan b.yaml"),
    "campaign rerun": ("", "campaign rerun b.db --case 0 --out new"),
    "campaign report": (
        "ffsm_drake.plugins.campaign.statistics:read_table", "campaign report b.db --out new",
    ),
    "campaign report, boundary": (
        "ffsm_drake.plugins.campaign.prediction:make_case",
        "campaign report b.db --out new --boundary 100 --map payload.truth.mass sample_time",
    ),
    "design": (PLANT, "design --time 5 --out new --set duration=1"),
    "stability": (PLANT, "stability"),
    "validate": (PLANT, "validate postcapture"),
    "plan": (PLANT, "plan --out new/plan.yaml"),
    "reproduce": ("ffsm_drake.plugins.paper.runs:figure_cases", "reproduce fig3 --out new"),
    "new": (PLANT, "new new/mine --urdf plain.urdf"),
    "audit": (PLANT, "audit log.csv --urdf plain.urdf"),
    "analyze": (READING, "analyze old --out new"),
    "export": (READING, "export new/r.csv old"),
    "plot": (READING, "plot old --out new"),
    "replay": (READING, "replay old --out new/r.html"),
}  # fmt: skip
DISPERSED = """
scenario: postcapture
overrides: {duration: 0.2}
controllers: ["blocked:Law"]
cases: 4
parameters:
  payload.truth.mass: {distribution: uniform, low: 20, high: 300}
  sample_time: {distribution: uniform, low: 0.005, high: 0.01}
settled: {hold: 0.1}
predictions: false
"""
WATCHED = """
import sys, threading, time
from pathlib import Path
from ffsm_drake.common import interrupts
interrupts.GRACE = 1.0
interrupts.handle_signals().watch()
threading.Thread(target=time.sleep, args=(1000,), daemon=True).start()  # as the command has
import blocked
with interrupts.unfinished(Path(sys.argv[1])):
    Path(sys.argv[1]).write_text("half")
    blocked.block()
"""
TESTS = Path(__file__).parents[1]


def check_ended(process, number):
    """Its code is the signal's, or it had to be killed; nothing below it is alive. At the very
    end of its work the signal itself ends it.
    """
    assert process.returncode in (128 + number, -number, -signal.SIGKILL), process.returncode
    end = time.monotonic() + 5.0
    while left := [one for one in processes() if one.session == process.pid]:
        assert time.monotonic() < end, [*map(str, left)]
        time.sleep(0.05)


def environment(kind=""):
    folders = os.pathsep.join(map(str, (TESTS, TESTS.parent, Path.cwd())))
    return os.environ | {"PYTHONPATH": folders, "BLOCKED": kind, "OPENBLAS_NUM_THREADS": "1"}


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
def test_the_watcher_ends_what_never_returns(tmp_path):
    """Each kind of call, side by side; the variable SEED draws the signals anew."""
    draw = random.Random(int(os.environ.get("SEED", "58")))
    with ExitStack() as stack:
        there = {}
        for kind in blocked.KINDS:
            command = [sys.executable, "-c", WATCHED, str(tmp_path / f"{kind}.partial")]
            settings = {"env": environment(kind), "stderr": PIPE, "text": True}
            there[kind] = stack.enter_context(child(command, longest=100.0, **settings))
        sent = {}
        for kind, process in there.items():
            assert process.stderr.readline() == "blocked\n", kind
            sent[kind] = draw.choice(SIGNALS)
            process.send_signal(sent[kind])
        for kind, process in there.items():
            _, said = process.communicate(timeout=60.0)
            check_ended(process, sent[kind])
            assert "interrupted; again: ffsm" in said.splitlines()[-1], (kind, said)
    assert not list(tmp_path.iterdir())


IMPORTING = """
import os, sys
import ffsm_drake.__main__ as command
from ffsm_drake.common.interrupts import interruptible
def main(interrupts):
    with interruptible():
        try:
            os.kill(os.getpid(), int(sys.argv[1]))
        except KeyboardInterrupt:  # as the initialisation of a native module does
            raise ImportError("initialization failed") from None
command._main = main
command.main()
"""


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_within_an_import_is_no_error(number):
    command = [sys.executable, "-c", IMPORTING, str(int(number))]
    done = finished(command, stderr=PIPE, text=True, env=environment())
    assert done.returncode == 128 + number
    assert "error" not in done.stderr
    assert "interrupted; again: ffsm" in done.stderr


STARTING = """
import os, subprocess
from ffsm_drake.common import interrupts
interrupts.handle_signals().watch()
os.write(1, b"starting\\n")
subprocess.run(["sh", "-c", os.environ["SHELL_WORDS"]], check=False)
"""
SHELL_WORDS = (
    "trap '' INT TERM HUP; for i in 1 2 3 4 5 6; do sh -c 'sleep 1000; :' & done; sleep 1000; :"
)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
def test_a_signal_while_processes_start_leaves_none():
    """As many as the variable SIGNALS says, 12 without; the variable SEED draws them anew."""
    draw = random.Random(int(os.environ.get("SEED", "58")))
    settings = {"env": environment() | {"SHELL_WORDS": SHELL_WORDS}, "stdout": PIPE}
    for _ in range(int(os.environ.get("SIGNALS", "12"))):
        with child([sys.executable, "-c", STARTING], stderr=DEVNULL, **settings) as process:
            process.stdout.readline()
            time.sleep(draw.uniform(0.0, 0.02))
            number = draw.choice(SIGNALS)
            process.send_signal(number)
            process.wait(timeout=MOST)
            check_ended(process, number)


def disturb_stuck(draw, folder):
    """One signal, or two, to a command in a call that never returns. Returns seconds and words."""
    name, kind = draw.choice([*STUCK]), draw.choice([*blocked.KINDS])
    number, wait = draw.choice(SIGNALS), draw.uniform(0.0, 1.0)
    twice = draw.random() < 0.2
    place, words = STUCK[name]
    shutil.rmtree("new", ignore_errors=True)
    said = f"{name}; {kind}; {number.name}{' twice' if twice else ''}"
    command = [sys.executable, str(TESTS / "blocked.py"), place, *words.split()]
    settings = {"env": environment(kind), "stdout": DEVNULL, "stderr": PIPE, "text": True}
    with child(command, **settings) as process:
        lines = []
        for line in process.stderr:
            lines.append(line)
            if line == "blocked\n":
                break
        assert "blocked\n" in lines, f"{said}: never blocked: {lines[-3:]}"
        time.sleep(wait)
        begun = time.monotonic()
        process.send_signal(number)
        if twice:
            time.sleep(1.0)
            process.send_signal(number)
        _, stderr = process.communicate(timeout=MOST)
        seconds = time.monotonic() - begun
        check_ended(process, number)
        assert "Traceback" not in stderr, f"{said}: {stderr}"
        last = [line for line in stderr.splitlines() if line][-1]
        assert last.startswith("interrupted; "), f"{said}: {stderr}"
        assert seconds < (10.0 if not twice else 5.0) * SLOWNESS, f"{said}: {seconds:.1f} s"
        assert not list(folder.rglob("*partial*")), said
        code = "killed" if process.returncode < 0 else str(process.returncode)
    return seconds, f"{said}; {code}"


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="finds processes in /proc")
def test_a_command_that_never_returns_ends(tmp_path, monkeypatch, run):
    """As many as the variable SIGNALS says, 4 without, from the seed SEED."""
    monkeypatch.chdir(tmp_path)
    Path("b.yaml").write_text(DISPERSED)
    Path("plain.urdf").write_text((TESTS.parent / "models/urdf/servicer.urdf").read_text())
    Path("log.csv").write_text("t\n0\n")
    run("postcapture", "duration=0.2").save("old")
    start = [sys.executable, "-m", "ffsm_drake", "campaign", "run", "b.yaml"]
    finished([*start, "--database", "b.db", "--workers", "1"], env=environment(), check=True)
    draw, unclean, table = random.Random(int(os.environ.get("SEED", "58"))), [], []
    for _ in range(int(os.environ.get("SIGNALS", "4"))):
        try:
            table.append(disturb_stuck(draw, tmp_path))
            print(f"{table[-1][0]:5.1f} s; {table[-1][1]}", flush=True)
        except (AssertionError, TimeoutExpired, OSError) as error:
            unclean.append(f"{type(error).__name__}: {error}")
            print(unclean[-1], flush=True)
    assert not unclean, "\n".join(unclean)
