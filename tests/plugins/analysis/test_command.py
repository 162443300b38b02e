"""``ffsm analyze``: what it prints, writes and answers with."""

import json

from click.testing import CliRunner
from matplotlib.figure import Figure
from matplotlib.image import imread

from ffsm_drake.cli import main


def ffsm(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_analyze(run, tmp_path, monkeypatch):
    """The picture itself: ``test_analysis.py``."""
    monkeypatch.setattr(
        "ffsm_drake.plugins.analysis.figure.plot_analysis", lambda analysis: Figure(figsize=(1, 1))
    )
    directory = run("postcapture", "duration=2").save(tmp_path / "run")
    result = ffsm("analyze", directory)
    assert result.exit_code == 0, result.output
    assert "[does not hold] Lemma 1, premise" in result.output
    findings = json.loads((directory / "analysis.json").read_text())
    assert findings["momentum_balance"]["verdict"] == "holds"
    assert imread(directory / "analysis.png").shape[:2] == (130, 130)
    elsewhere = ffsm("analyze", directory, "--out", tmp_path / "new", "--json")
    assert elsewhere.exit_code == 0
    assert (
        json.loads((tmp_path / "new" / "analysis.json").read_text())
        == findings
        == json.loads(elsewhere.stdout)
    )
    assert (tmp_path / "new" / "analysis.png").is_file()


def test_analyze_needs_a_record(tmp_path):
    result = ffsm("analyze", tmp_path / "nothing")
    assert result.exit_code == 2
    assert "contains no run (manifest.json is missing)" in result.output
    assert result.output.count("\n") == 1
