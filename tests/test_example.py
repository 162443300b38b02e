"""The examples as a user runs them, and the recording in a browser."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest
from browser import needs_chromium, pictured
from children import finished
from entry_points import is_there, needs

from ffsm_drake import FfsmError, RunRecord

EXAMPLES = Path(__file__).parents[1] / "examples"
OWN_TESTS = ("postcapture.py", "campaign.py")
OTHERS = sorted(path.name for path in EXAMPLES.glob("*.py") if path.name not in OWN_TESTS)
ON_EACH_CHANGE = ("own_law.py", "own_sensor.py", "notebook.py")
DOCS = EXAMPLES.parent / "docs"


@pytest.mark.long
@needs("diagrams")
@needs("meshcat")
@pytest.mark.usefixtures("rough_pictures")
def test_the_main_job(tmp_path, monkeypatch, capfd):
    """As a script, in this process: the longest of the examples loads nearly all there is."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["postcapture.py"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXAMPLES / "postcapture.py"), run_name="__main__")
    assert ended.value.code == 0
    out, err = capfd.readouterr()
    written = {path.name for path in (tmp_path / "out" / "postcapture").iterdir()}
    assert written >= {
        "record.nc",
        "metrics.json",
        "manifest.json",
        "report.html",
        "recording.html",
        "trajectories.png",
        "errors.png",
        "efforts.png",
        "gains.png",
        "block_diagram.dot",
    }
    metrics = json.loads((tmp_path / "out/postcapture/metrics.json").read_text())
    row = next(line for line in out.splitlines() if line.startswith("tde_aismc  "))
    assert f"{metrics['itae']:.4g}" in row
    assert f"{metrics['isv']:.5g}" in row
    assert "   5 of 20 s" in out
    assert re.search(r"completed 20 s; \d+ times real time", out)
    assert "Traceback" not in err


@pytest.mark.long
def test_the_jacobian_of_a_fixed_base_misses_where_the_generalized_one_does_not(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["draw_free_floating.py"])
    runpy.run_path(str(DOCS / "draw_free_floating.py"), run_name="__main__")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:5]]
    assert [row[:3] for row in rows[::2]] == [
        [name, "fixed-base", "J"] for name in ("planar_detumble", "postcapture")
    ]
    # m, rad, rad
    assert [row[-3:] for row in rows[::2]] == [
        ["0.253", "0.0968", "0.0968"],
        ["0.208", "-", "0.0905"],
    ]
    assert max(float(row[2]) for row in rows[1::2]) < 1e-9
    assert Path("out/free_floating.png").stat().st_size > 10_000


def absent(_):
    raise FfsmError("left out")


@pytest.fixture
def cheap(monkeypatch):
    """Without the figures and the report's stability section, which cost seconds and have tests of
    their own.
    """
    monkeypatch.setattr("ffsm_drake.show.figures.run.save_figures", lambda *_, **__: [])
    if is_there("design"):
        monkeypatch.setattr("ffsm_drake.plugins.design.panels.stability", absent)


@pytest.fixture
def main(monkeypatch, tmp_path):
    """The main function of examples/postcapture.py, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return runpy.run_path(str(EXAMPLES / "postcapture.py"))["main"]


@pytest.mark.long
@needs("report")
@needs("design")
@pytest.mark.filterwarnings("default")
@pytest.mark.usefixtures("cheap")
def test_a_diverging_run_of_another_scenario_says_so_and_keeps_its_record(main, capfd):
    scenario = [
        "--scenario",
        "paper",
        "--set",
        "controller=aismc",
        "--set",
        "divergence_speed=1e-3",
    ]
    unstable = [
        "--set",
        "controllers.aismc.k_s_initial=250",
        "--set",
        "controllers.aismc.k_s_max=null",
    ]
    assert main([*scenario, *unstable, "--out", "mine"]) == 3
    out, err = capfd.readouterr()
    assert re.search(r"diverged at t = [\d.]+ s: \S+ moves at", out)
    assert "warning: not expected to go as planned: motion: unstable at rest" in err
    record = RunRecord.load("mine")
    assert record.outcome.status == "diverged"
    assert record.scenario.controller == "aismc"
    assert record.scenario.simulator_config.integration_scheme == "explicit_euler"
    assert Path("mine/report.html").is_file()


def test_bad_input_gets_one_line(main, capfd):
    assert main(["--set", "controllers.tdc.kd=1"]) == 2
    error = capfd.readouterr().err
    assert error.startswith(
        "error: controllers.tdc.kd: unknown gain; tdc has k_d, k_p; did you mean 'k_d'?"
    )
    assert error.count("\n") == 1


@pytest.mark.long
@needs("campaign")
def test_the_campaign(tmp_path):
    """In a process of its own, since its workers import the file."""
    command = [sys.executable, EXAMPLES / "campaign.py"]
    done = finished(command, cwd=tmp_path, longest=600.0)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "tdc: 8 settled" in done.stdout
    assert len((tmp_path / "out/campaign/runs.csv").read_text().splitlines()) == 17


def test_examples_are_short():
    assert {"own_arm.py", "own_law.py", "own_sensor.py", "own_mission.py"} < set(OTHERS)
    lines = {file.name: len(file.read_text().splitlines()) for file in EXAMPLES.glob("*.py")}
    assert max(lines.values()) < 60, lines


@pytest.mark.usefixtures("cheap")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name in ON_EACH_CHANGE else pytest.mark.long)
        for name in OTHERS
    ],
)
def test_the_other_examples(name, tmp_path, monkeypatch):
    """As scripts, in this process: as __main__, and with their folder among those that modules come
    from.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)
    made = runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    if name == "point_mass.py":
        adapts, fixed = (record.metrics["itae"] for record in made["records"])
        assert adapts < 0.2 * fixed
    (report,) = Path("out").rglob("report.html")
    assert "Accuracy, ITAE" in report.read_text()


@pytest.fixture(scope="module")
def recording(tmp_path_factory, run):
    file = tmp_path_factory.mktemp("recording") / "recording.html"
    page = pytest.importorskip("ffsm_drake.plugins.meshcat.recording")
    page.write_recording(run("postcapture", "duration=1"), file)
    return file


def test_recording_is_self_contained(recording):
    page = recording.read_text()
    for part in ("set_animation", "target_posture", "end_effector_path"):
        assert part in page or part.encode().hex() in page or _in_packed(part, page), part
    assert not re.search(r'<script[^>]+src="http', page)


def _in_packed(part: str, page: str) -> bool:
    """Meshcat packs its commands into base64 blobs."""
    import base64

    blobs = re.findall(r"base64,([A-Za-z0-9+/=]{20,})", page)
    return any(part.encode() in base64.b64decode(blob) for blob in blobs)


@pytest.mark.long
@needs_chromium
def test_recording_shows_the_spacecraft_in_a_browser(recording, tmp_path):
    def shows_it(pixels):
        gold = (pixels[..., 0] > 0.45) & (pixels[..., 1] > 0.3) & (pixels[..., 2] < 0.35)
        panels = (pixels[..., 2] > 0.4) & (pixels[..., 0] < 0.25)
        # The bus and the solar cells.
        return gold.sum() > 250 and panels.sum() > 250

    pictured(recording, tmp_path, shows_it, "--window-size=400,300")


def test_meshcat_serves_this_machine_only():
    stage = pytest.importorskip("ffsm_drake.plugins.meshcat.stage")
    assert stage.start_meshcat().web_url().startswith("http://127.")
