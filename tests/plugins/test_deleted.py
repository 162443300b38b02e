"""Each plug-in can be deleted: the rest works, and one line says what is missing."""

import json
import os
import shutil
import sys
from pathlib import Path

import pytest
from children import finished
from click.testing import CliRunner

import ffsm_drake
from ffsm_drake.cli import main
from ffsm_drake.common.plugins import COMMANDS, offered

PACKAGE = Path(ffsm_drake.__file__).parent
SHORT = ["run", "postcapture", "--set", "duration=0.5", "--no-report", "--out", "out"]
# plug-in -> commands that need it
NEEDED = {
    "audit": [["audit", "log.csv", "--urdf", "craft.urdf"]],
    "benchmark": [["benchmark", "paper"]],
    "campaign": [["campaign", "status", "c.db"]],
    "exports": [["export", "out", "--to", "run.csv"], [*SHORT, "--foxglove"]],
    "generated": [],
    "gymnasium": [],
    "interactive": [
        [*SHORT, "--meshcat"],
        [*SHORT, "--controls"],
        ["replay", "out", "--live"],
    ],
    "paper": [["reproduce", "table2"]],
    "policy": [["validate", "postcapture", "--set", "controller=policy:a.onnx"]],
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
    assert set(NEEDED) == {path.parent.name for path in PACKAGE.glob("plugins/*/__init__.py")}


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
    missing = [(name, words) for name in deleted for words in NEEDED[name]]
    commands = [SHORT, ["--help"], ["doctor"], *(words for _, words in missing)]
    done = finished(
        [sys.executable, "-c", CODE, json.dumps([deleted, commands])],
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(copy.parent)},
    )
    file, (run, listed, examined, *refused) = json.loads(done.stdout.splitlines()[-1])
    assert Path(file).parent == copy
    assert run[0] == listed[0] == examined[0] == 0, (run, examined)
    for (name, words), (code, said) in zip(missing, refused, strict=True):
        assert code == 2, (words, said)
        lines = [line for line in said.splitlines() if not line.startswith("warning: ")]
        assert len(lines) == 1, said
        assert f"No module named 'ffsm_drake.plugins.{name}'" in lines[0], said


@pytest.mark.parametrize("name", offered(COMMANDS))
@pytest.mark.smoke
def test_help_has_examples(name):
    """As that of the core's commands."""
    result = CliRunner().invoke(main, [name, "--help"])
    assert result.exit_code == 0
    assert "Usage:" in result.output
    assert "Example" in result.output
