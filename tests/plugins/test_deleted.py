"""Each plug-in can be deleted: the rest works, and one line says what is missing."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import pytest
from children import finished
from click.testing import CliRunner
from entry_points import MISSING

import ffsm_drake
from ffsm_drake.cli import main
from ffsm_drake.cli.common import COMMANDS
from ffsm_drake.common.registrations import own_plugins

PACKAGE = Path(ffsm_drake.__file__).parent
ROOT = Path(__file__).parents[2]
LEFT_OUT = shutil.ignore_patterns("__pycache__", ".git", ".*_cache", "*venv", "out", "site")
SHORT = ["run", "postcapture", "--set", "duration=0.5", "--no-report", "--out", "out"]
# plug-in -> commands that need it
NEEDED = {
    "actuators": [
        [*SHORT, "--set", "actuation.limit.joints=1"],
        [*SHORT, "--set", "effects.link={}"],
    ],
    "analysis": [["analyze", "out"]],
    "audit": [["audit", "log.csv", "--urdf", "craft.urdf"]],
    "barriers": [[*SHORT, "--set", "command_filter.barriers={}"]],
    "baselines": [["validate", "postcapture", "--set", "controller=fixed_time"]],
    "benchmark": [["benchmark", "paper"]],
    "campaign": [["campaign", "status", "c.db"]],
    "capture": [["run", "tumbling_capture", "--no-report", "--out", "out"]],
    "design": [["stability"], ["design"]],
    "diagrams": [["diagram"]],
    "doctor": [["doctor"]],
    "environment": [[*SHORT, "--set", "environment={}"]],
    "estimators": [
        [*SHORT, "--set", "estimator.kind=kalman"],
        [*SHORT, "--set", "command_filter.low_pass=20"],
    ],
    "exports": [["export", "run.csv", "out"]],
    "faults": [[*SHORT, "--set", "faults={}"]],
    "flight": [],
    "foxglove": [[*SHORT, "--foxglove"]],
    "flexible": [["run", "flexible_panels", "--no-report", "--out", "out"]],
    "compiled": [],
    "equations": [],
    "geometry": [[*SHORT, "--set", "effects.geometry={}"]],
    "gymnasium": [],
    "inputs": [],
    "interactive": [
        [*SHORT, "--meshcat"],
        [*SHORT, "--controls"],
    ],
    "live": [[*SHORT, "--controls"]],
    "meshcat": [["replay", "out"]],
    "new": [["new", "mine", "--urdf", "craft.urdf"]],
    "paper": [["reproduce", "table2"]],
    "planning": [["plan", "postcapture"], [*SHORT, "--controller", "tvlqr"]],
    "policy": [["validate", "postcapture", "--set", "controller=policy:a.onnx"]],
    "report": [],
    "tape": [],
    "task_space": [[*SHORT, "--controller", "resolved_rate"]],
    "two_arms": [["run", "two_arms", "--no-report", "--out", "out"]],
    "udp": [["run", "postcapture", "-c", "ffsm_drake.plugins.udp.external:External"]],
    "workers": [["reproduce", "table2"]],
    "zero_reaction": [[*SHORT, "--controller", "adaptive_zero_reaction"]],
}
# Of a copy of the package: what is left is imported, and commands run.
CODE = """
import importlib, json, pkgutil, sys
from click.testing import CliRunner
import ffsm_drake
deleted, commands = json.loads(sys.argv[1])
for module in pkgutil.walk_packages(ffsm_drake.__path__, "ffsm_drake."):
    if not module.name.startswith(("ffsm_drake.plugins.", "ffsm_drake.__main__")):
        importlib.import_module(module.name)
for name in ffsm_drake.__all__:
    getattr(ffsm_drake, name)
results = [CliRunner().invoke(ffsm_drake.cli.main, words) for words in commands]
print(json.dumps([ffsm_drake.__file__, [[each.exit_code, each.stderr] for each in results]]))
"""


def test_every_plugin_is_here():
    folders = {path.parent.name for path in PACKAGE.glob("plugins/*/*.py")}
    assert set(NEEDED) == set(own_plugins()) == folders


def copied(folder, deleted):
    """A copy of the checkout without plug-ins."""
    shutil.copytree(ROOT, folder, ignore=LEFT_OUT)
    for name in deleted:
        shutil.rmtree(folder / "ffsm_drake" / "plugins" / name)


@pytest.mark.long
def test_the_core_passes_its_tests_without_any(tmp_path):
    """Tests that need a plug-in are skipped, none of the others fails."""
    copied(tmp_path / "copy", NEEDED)
    command = "-m pytest -q -n 2 -p no:cacheprovider --ignore tests/plugins tests"
    done = finished(
        [sys.executable, *command.split()],
        longest=3000.0,
        cwd=tmp_path / "copy",
        env={**os.environ, "PYTHONPATH": str(tmp_path / "copy")},
    )
    assert done.returncode == 0, done.stdout[-5000:]
    passed, skipped = (
        int(re.search(rf"(\d+) {word}", done.stdout)[1]) for word in ("passed", "skipped")
    )
    assert passed > 5 * skipped, done.stdout[-5000:]


@pytest.mark.parametrize(
    "deleted",
    [
        pytest.param(sorted(NEEDED), marks=pytest.mark.slow, id="all"),
        *(pytest.param([name], marks=pytest.mark.long, id=name) for name in NEEDED),
    ],
)
def test_the_rest_works_without(deleted, tmp_path):
    copy = tmp_path / "copy" / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    if (models := PACKAGE.parent / "models").is_dir():  # a checkout's
        (copy.parent / "models").symlink_to(models)
    for name in deleted:
        shutil.rmtree(copy / "plugins" / name)
    missing = [words for name in deleted for words in NEEDED[name]]
    commands = [SHORT, ["--help"], ["scenarios"], *missing]
    done = finished(
        [sys.executable, "-c", CODE, json.dumps([deleted, commands])],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(copy.parent)},
    )
    file, (run, listed, examined, *refused) = json.loads(done.stdout.splitlines()[-1])
    assert Path(file).parent == copy
    assert run[0] == listed[0] == examined[0] == 0, (run, examined)
    for words, (code, said) in zip(missing, refused, strict=True):
        assert code == 2, (words, said)
        lines = [line for line in said.splitlines() if not line.startswith("warning: ")]
        assert len(lines) == 1 or lines[0].startswith("Usage: "), said
        assert MISSING.search(lines[-1]), said
        assert "run from the folder" not in lines[-1], said


@pytest.mark.parametrize("name", COMMANDS.offers())
@pytest.mark.smoke
def test_help_has_examples(name):
    """As that of the core's commands."""
    result = CliRunner().invoke(main, [name, "--help"])
    assert result.exit_code == 0
    assert "Usage:" in result.output
    assert "Example" in result.output
