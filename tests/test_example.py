"""The examples as a user runs them, and the recording in a browser."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.show.meshcat import start_meshcat, write_recording

EXAMPLES = Path(__file__).parents[1] / "examples"
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


def example(name, *arguments, directory):
    return subprocess.run(
        [sys.executable, EXAMPLES / name, *arguments], cwd=directory, capture_output=True, text=True, check=False
    )


def test_the_main_job(tmp_path):
    done = example("postcapture.py", directory=tmp_path)
    assert done.returncode == 0, done.stderr
    written = {path.name for path in (tmp_path / "out" / "postcapture").iterdir()}
    assert written >= {
        "record.nc", "metrics.json", "manifest.json", "report.html", "recording.html", "trajectories.png", "errors.png",
        "efforts.png", "gains.png", "block_diagram.dot",
    }  # fmt: skip
    metrics = json.loads((tmp_path / "out/postcapture/metrics.json").read_text())
    row = next(line for line in done.stdout.splitlines() if line.startswith("tde_aismc  "))
    assert f"{metrics['itae']:.4g}" in row
    assert f"{metrics['isv']:.5g}" in row
    assert "   5 of 20 s" in done.stdout
    assert re.search(r"completed 20 s; \d+ times real time", done.stdout)
    assert "Traceback" not in done.stderr


def test_another_scenario_and_controller(tmp_path):
    overrides = ["--set", "controller=tdc", "--set", "duration=0.5"]
    done = example("postcapture.py", "--scenario", "paper", *overrides, directory=tmp_path)
    assert done.returncode == 0, done.stderr
    record = RunRecord.load(tmp_path / "out" / "paper")
    assert record.scenario.controller == "tdc"
    assert record.scenario.simulator_config.integration_scheme == "explicit_euler"


def test_a_diverging_run_says_so_and_keeps_its_record(tmp_path):
    overrides = ["--set", "controllers.tde_aismc.k_s_initial=150", "--set", "controllers.tde_aismc.k_s_max=null"]
    done = example("postcapture.py", *overrides, "--out", "mine", directory=tmp_path)
    assert done.returncode == 3
    assert re.search(r"tde_aismc diverged at t = [\d.]+ s: \S+ moves at", done.stdout)
    assert "warning: the sampled loop is unstable at the starting gains" in done.stderr
    assert RunRecord.load(tmp_path / "mine").outcome.status == "diverged"
    assert (tmp_path / "mine" / "report.html").is_file()


def test_bad_input_gets_one_line(tmp_path):
    done = example("postcapture.py", "--set", "controllers.tdc.kd=1", directory=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: controllers.tdc.kd: unknown gain; tdc has k_d, k_p; did you mean 'k_d'?")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.py") if path.name != "postcapture.py"))
def test_the_other_examples(name, tmp_path):
    done = example(name, directory=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    written = {path.name for path in (tmp_path / "out").rglob("*")}
    assert written & {"report.html", "runs.csv"}


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
