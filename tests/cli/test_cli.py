"""The command line: what it prints, writes and answers with."""

import contextlib
import csv
import json
import re
import shutil
import sys
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import pytest
from children import PIPE, finished
from click.testing import CliRunner
from entry_points import is_there, needs

from ffsm_drake import FfsmError, RunRecord, load_scenario
from ffsm_drake.cli import main
from ffsm_drake.cli.common import forgiving_stderr
from ffsm_drake.cli.progress import ProgressLine, show_life
from ffsm_drake.common.steps import current_step, step
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.scenario import shipped_scenarios

SHORT = ["--set", "duration=0.3"]


def absent(_):
    raise FfsmError("left out")


def without_stability(monkeypatch):
    """Reports leave out this section, which takes longest."""
    if is_there("design"):
        monkeypatch.setattr("ffsm_drake.plugins.design.panels.stability", absent)


def ffsm(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    "command", [[], *[[name] for name in main.commands]], ids=lambda command: " ".join(command)
)
@pytest.mark.smoke
def test_help_has_examples(command):
    result = ffsm(*command, "--help")
    assert "None]" not in result.output  # of a number without bounds
    assert result.exit_code == 0
    assert "Usage:" in result.output
    assert "Example" in result.output


def test_help_needs_no_drake():
    code = (
        "import sys, ffsm_drake.cli as c; c.main(['--help'], standalone_mode=False); "
        "print(sorted(sys.modules))"
    )
    done = finished([sys.executable, "-c", code], check=True)
    loaded = done.stdout.splitlines()[-1]
    for heavy in ("pydrake", "numpy", "matplotlib", "scipy", "xarray"):
        assert f"'{heavy}'" not in loaded


@needs("report")
def test_run_writes_record_and_report(tmp_path, monkeypatch):
    """A report with its stability section: ``plugins/report/test_report.py``."""
    without_stability(monkeypatch)
    result = ffsm("run", "postcapture", *SHORT, "--seed", 4, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    record = RunRecord.load(tmp_path)
    assert record.scenario.random_seed == 4
    assert {path.name for path in tmp_path.iterdir()} == {
        "record.nc",
        "metrics.json",
        "manifest.json",
        "report.html",
    }
    row = next(line for line in result.stdout.splitlines() if line.startswith("tde_aismc  "))
    assert f"{record.metrics['itae']:.4g}" in row
    assert f"{record.metrics['isv']:.5g}" in row


@pytest.mark.smoke
def test_run_as_json(tmp_path):
    result = ffsm("run", *SHORT, "--no-report", "--json", "--out", tmp_path)
    assert result.exit_code == 0, result.output
    (run,) = json.loads(result.stdout)["runs"]
    assert run["status"] == "completed"
    assert run["metrics"] == RunRecord.load(tmp_path).metrics
    assert not (tmp_path / "report.html").exists()


def test_run_goes_to_a_folder_of_the_scenarios_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert ffsm("run", "paper", *SHORT, "--no-report").exit_code == 0
    assert RunRecord.load("out/paper").outcome.completed


@pytest.mark.long
def test_compare_overlays_and_ranks(tmp_path, monkeypatch):
    without_stability(monkeypatch)
    table = tmp_path / "laws.csv"
    result = ffsm("compare", *SHORT, "--seed", 2, "--out", tmp_path, "--table", table)
    assert result.exit_code == 0, result.output
    for name in ("tdc", "asmc", "aismc", "tde_aismc"):
        record = RunRecord.load(tmp_path / name)
        assert record.scenario.controller == name
        assert record.scenario.random_seed == 2
    assert (tmp_path / "report.html").is_file()
    assert f"Written to {tmp_path}, {table}; open " in result.output
    rows = list(csv.DictReader(table.read_text().splitlines()))
    itae = [float(row["ITAE"]) for row in rows]
    assert len(rows) == 4
    assert itae == sorted(itae)


@pytest.mark.long
@pytest.mark.usefixtures("rough_pictures")
def test_plot_overlays_runs(run, tmp_path):
    """Of two runs with the fewest samples that there are; a whole run's are drawn by
    ``test_the_main_job``.
    """
    for name in ("one", "two"):
        run("postcapture", "duration=0.01").save(tmp_path / name)
    result = ffsm("plot", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "figures")
    assert result.exit_code == 0, result.output
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "trajectories.png", "errors.png", "efforts.png", "gains.png",
    }  # fmt: skip
    for given, written in (((".",), "."), (("one", "two"), "."), (("one",), "one")):
        with contextlib.chdir(tmp_path):
            result = ffsm("plot", *given, "--format", "svg")
            assert f"Written to {written}: trajectories.svg, " in result.output
            assert len(list(Path(written).glob("*.svg"))) == 4
            assert given != (".",) or not list(tmp_path.glob("*/*.svg"))
    shutil.move(tmp_path / "two", tmp_path / "figures")
    result = ffsm("plot", tmp_path / "one", tmp_path / "figures")
    assert result.exit_code == 2
    assert "--out: is missing, and the runs are in different folders" in result.output
    for folder in ("vectors", "again"):
        words = ("plot", tmp_path / "one", "--format", "pdf,svg", "--out", tmp_path / folder)
        assert ffsm(*words).exit_code == 0
    drawn = {path.name: path.read_bytes() for path in (tmp_path / "vectors").iterdir()}
    assert len(drawn) == 8
    assert drawn["errors.pdf"].startswith(b"%PDF")
    assert b"<svg" in drawn["errors.svg"]
    assert drawn == {path.name: path.read_bytes() for path in (tmp_path / "again").iterdir()}


@pytest.mark.long
@pytest.mark.parametrize("scenario", ["postcapture", "seven_joint", "two_arms"])
def test_figures_fit_a_page(scenario, run, tmp_path):
    """The given width, larger than no label, and no heading, which the caption of a page has."""
    run(scenario, "duration=0.01").save(tmp_path / "one")
    words = ("plot", tmp_path / "one", "--format", "svg", "--width", "7.16")
    assert ffsm(*words).exit_code == 0
    for name in ("trajectories", "errors", "efforts", "gains"):
        text = (tmp_path / "one" / f"{name}.svg").read_text()
        width, height = re.search(
            r'<svg[^>]* width="([\d.]+)pt" height="([\d.]+)pt"', text
        ).groups()
        assert float(width) == pytest.approx(7.16 * 72.0, rel=1e-3)
        assert float(height) < 9.3 * 72.0
        assert load_scenario(scenario).description not in text


def test_diagram(tmp_path):
    printed = ffsm("diagram", "--controller", "pd_plus")
    assert printed.exit_code == 0
    assert printed.stdout.startswith("digraph")
    assert "name=pd_plus" in printed.stdout
    written = ffsm("diagram", "--controller", "pd_plus", "--out", tmp_path / "loop.svg")
    assert written.exit_code == 0
    assert (tmp_path / "loop.dot").read_text().strip() == printed.stdout.strip()


@pytest.mark.smoke
def test_scenarios_and_validate(tmp_path):
    listed = json.loads(ffsm("scenarios", "--json").stdout)
    assert set(listed) == set(shipped_scenarios())
    mine = tmp_path / "mine.yaml"
    mine.write_text(ffsm("scenarios", "flight_sensors").stdout)
    good = ffsm("validate", "--no-rehearsal", "postcapture", "tumbling_capture", mine)
    assert good.exit_code == 0, good.output
    assert f"{mine}: valid; tde_aismc, free base and 5 joints" in good.stdout
    if JUDGES.first():
        assert "tumbling_capture: momentum after the planned grasp: 0.3517 N s" in good.stdout
    mine.write_text("payload: {truth: {mass: -1}}")
    bad = ffsm("validate", "postcapture", mine, "--json", "--no-rehearsal")
    assert bad.exit_code == 2
    results = json.loads(bad.stdout)
    assert results["postcapture"]["valid"]
    assert results[str(mine)]["error"] == f"{mine}: payload.truth.mass: must be > 0 kg, not -1"


@pytest.mark.long
def test_every_shipped_scenario_is_valid():
    """Without the rehearsal, which the verdict's and the matrix's tests look at."""
    done = ffsm("validate", "--no-rehearsal", *shipped_scenarios())
    assert done.exit_code == 0, done.output
    assert all(f"{name}: valid; " in done.stdout for name in shipped_scenarios())


@pytest.mark.slow
def test_schema_describes_every_shipped_scenario():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(ffsm("schema").stdout)
    assert schema["properties"]["duration"]["description"].startswith("s; ")
    assert (
        "kg"
        in schema["properties"]["payload"]["properties"]["truth"]["properties"]["mass"][
            "description"
        ]
    )
    validator = jsonschema.validators.validator_for(schema)
    validator.check_schema(schema)  # once: it costs more than all that follows
    validator = validator(schema)
    for name in shipped_scenarios():
        assert (
            list(validator.iter_errors(json.loads(ffsm("scenarios", name, "--json").stdout))) == []
        )
    for wrong in ({"duration": "long"}, {"durations": 1.0}):
        assert not validator.is_valid(wrong)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
@pytest.mark.smoke
def test_completion(shell):
    result = ffsm("completion", shell)
    assert result.exit_code == 0
    assert "_FFSM_COMPLETE" in result.stdout


def test_completion_knows_scenarios_and_controllers(monkeypatch):
    from click.shell_completion import ShellComplete

    completer = ShellComplete(main, {}, "ffsm", "_FFSM_COMPLETE")
    assert "flight_sensors" in [item.value for item in completer.get_completions(["run"], "fl")]
    assert "computed_torque" in [
        item.value for item in completer.get_completions(["run", "--controller"], "comp")
    ]


@pytest.mark.long
def test_a_silent_command_names_its_steps(tmp_path):
    """Everything a run does that takes long: nothing of it is without a name."""
    scenario = tmp_path / "heavy.yaml"
    scenario.write_text("extends: postcapture\npayload: {nominal: {mass: 130}}\n")
    code = (
        "import sys, threading, ffsm_drake.cli.common as c\nfrom ffsm_drake.cli import main\n"
        "from ffsm_drake.cli.progress import show_life\n"
        "go = threading.Thread(target=show_life, args=(threading.Event(),), daemon=True,\n"
        "    kwargs={'first': 0.01, 'then': 0.05})\n"
        "c.forgiving_stderr(); go.start(); main(prog_name='ffsm')"
    )
    command = [sys.executable, "-c", code, "run", scenario, "--out", tmp_path / "run"]
    done = finished(command, stdout=PIPE, stderr=PIPE, text=True)
    steps = set(re.findall(r"^ *\d+ s: (.*)", done.stderr, re.MULTILINE))
    assert done.returncode == 3, done.stderr
    assert "checking the linear loop" in steps
    assert "searching for a change that helps (checking the linear loop)" in steps
    assert any(each.startswith("writing the report") for each in steps)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_one_updated_line_on_a_terminal_and_rare_lines_elsewhere(
    terminal, capsys, monkeypatch
):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with ProgressLine(period=60.0) as line:
        line.show("first", share=0.5)
        line.show("too soon")
        line.show("last", last=True)
    first, begin = ("[############............] first", "\r") if terminal else ("first\n", "f")
    told = capsys.readouterr().err
    assert "too soon" not in told
    assert told.count("\n") == (1 if terminal else 2)
    assert first in told
    assert told.rstrip().endswith("last")
    assert told.startswith(begin)


@pytest.mark.parametrize(
    ("first", "least", "named"), [(0.1, 1, True), (0.1, 1, False), (60, 0, True)]
)
def test_a_silent_command_says_that_it_goes_on(first, least, named, capsys, monkeypatch):
    over = threading.Event()
    monkeypatch.setattr(sys, "stderr", sys.stderr)
    monkeypatch.setattr(sys, "argv", ["ffsm", "new", "mine"])
    forgiving_stderr()
    settings = {"first": first, "then": 60.0}
    watcher = threading.Thread(target=show_life, args=(over,), kwargs=settings)
    watcher.start()
    with step("the whole") if named else nullcontext(), step("a part") if named else nullcontext():
        time.sleep(0.5)
    over.set()
    watcher.join()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == least
    at = "the whole (a part)" if named else "running ffsm new"
    assert all(line.endswith(f" s: {at}") for line in lines)
    assert current_step() == ""
