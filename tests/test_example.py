"""examples/postcapture.py as a user runs it."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.visualization import start_meshcat, write_recording

EXAMPLE = Path(__file__).parents[1] / "examples" / "postcapture.py"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("postcapture_example", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_default_run_from_the_shell(tmp_path):
    done = subprocess.run([sys.executable, EXAMPLE], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    written = {path.name for path in (tmp_path / "out" / "postcapture").iterdir()}
    assert written >= {
        "record.nc", "metrics.json", "manifest.json", "recording.html", "trajectories.png", "errors.png", "efforts.png",
        "gains.png", "block_diagram.dot",
    }  # fmt: skip
    metrics = json.loads((tmp_path / "out/postcapture/metrics.json").read_text())
    row = next(line for line in done.stdout.splitlines() if line.startswith("tde_aismc  "))
    assert f"{metrics['itae']:.4g}" in row
    assert f"{metrics['isv']:.5g}" in row
    assert re.search(r"tde_aismc: +5 of 20 s", done.stdout)
    assert re.search(r"completed 20 s; simulated in [\d.]+ s, \d+ times real time", done.stdout)
    assert "Traceback" not in done.stderr


def test_all_controllers(example, tmp_path, capsys):
    code = example(["--all-controllers", "--no-recording", "--set", "duration=1", "--out", str(tmp_path)])
    assert code == 0
    for name in ("tdc", "asmc", "aismc", "tde_aismc"):
        assert RunRecord.load(tmp_path / name).scenario.controller == name
    assert (tmp_path / "errors.png").is_file()
    assert not (tmp_path / "recording.html").exists()
    table = capsys.readouterr().out
    assert [name for name in ("tdc", "asmc", "aismc", "tde_aismc") if re.search(rf"^{name} .*\d", table, re.MULTILINE)]


def test_other_scenario_and_controller(example, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert example(["--scenario", "paper", "--controller", "tdc", "--set", "duration=0.5", "--no-recording"]) == 0
    record = RunRecord.load("out/paper")
    assert record.scenario.controller == "tdc"
    assert record.scenario.simulator_config.integration_scheme == "explicit_euler"


def test_a_diverging_run_says_so_and_keeps_its_record(example, tmp_path, capsys):
    overrides = ["--set", "controllers.tde_aismc.k_s_initial=150", "--set", "controllers.tde_aismc.k_s_max=null"]
    assert example([*overrides, "--no-recording", "--out", str(tmp_path)]) == 3
    assert re.search(r"tde_aismc diverged at t = [\d.]+ s: \S+ moves at", capsys.readouterr().out)
    assert RunRecord.load(tmp_path).outcome.status == "diverged"
    assert (tmp_path / "errors.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--scenario", "nowhere"], "error: nowhere: no such scenario; choose one of"),
        (["--set", "controllers.tdc.kd=1"], "error: override: controllers.tdc.kd: unknown key; valid here: k_d, k_p"),
        (["--set", "model.end_effector=x", "--no-recording"], "error: model.end_effector: no frame 'x'"),
        (["--set", "duration=0.1", "--no-recording", "--out", "/proc/nowhere"], "cannot be written"),
    ],
)
def test_bad_input_gets_one_line(example, capsys, arguments, expected):
    assert example(arguments) == 2
    captured = capsys.readouterr()
    assert expected in captured.err
    assert captured.err.count("\n") == 1


def test_graphviz_text(example, capsys):
    assert example(["--graphviz", "--controller", "aismc"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("digraph")
    assert "name=aismc" in text


def test_recording_is_self_contained(tmp_path):
    record = simulate(load_scenario("postcapture", ["duration=1"]))
    write_recording(record, tmp_path / "recording.html")
    page = (tmp_path / "recording.html").read_text()
    for part in ("set_animation", "target_posture", "end_effector_path"):
        assert part in page or part.encode().hex() in page or _in_packed(part, page), part
    assert not re.search(r'<script[^>]+src="http', page)


def _in_packed(part: str, page: str) -> bool:
    """Meshcat packs its commands into base64 blobs."""
    import base64

    blobs = re.findall(r"base64,([A-Za-z0-9+/=]{20,})", page)
    return any(part.encode() in base64.b64decode(blob) for blob in blobs)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_recording_shows_the_spacecraft_in_a_browser(tmp_path):
    from matplotlib import image

    record = simulate(load_scenario("postcapture", ["duration=1"]))
    write_recording(record, tmp_path / "recording.html")
    picture = tmp_path / "picture.png"
    subprocess.run(
        [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
            "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
            "--use-angle=swiftshader", "--enable-unsafe-swiftshader", f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=800,600", "--virtual-time-budget=3000", f"--screenshot={picture}",
            (tmp_path / "recording.html").as_uri(),
        ],
        capture_output=True, timeout=120, check=True,
    )  # fmt: skip
    pixels = image.imread(picture)[..., :3]
    gold = (pixels[..., 0] > 0.45) & (pixels[..., 1] > 0.3) & (pixels[..., 2] < 0.35)
    panels = (pixels[..., 2] > 0.4) & (pixels[..., 0] < 0.25)
    assert gold.sum() > 1000  # the bus
    assert panels.sum() > 1000  # the solar cells


def test_meshcat_serves_this_machine_only():
    assert "127.0.0.1" in start_meshcat().web_url()
