"""The command line: what it prints, writes and answers with."""

import json

import pytest
from click.testing import CliRunner

from ffsm_drake.cli import main


def test_analyze(run, tmp_path):
    directory = run("postcapture").save(tmp_path / "run")
    result = CliRunner().invoke(main, ["analyze", str(directory)])
    assert result.exit_code == 0, result.output
    assert "[does not hold] Lemma 1, premise" in result.output
    findings = json.loads((directory / "analysis.json").read_text())
    assert findings["momentum_balance"]["verdict"] == "holds"
    assert (directory / "analysis.png").stat().st_size > 50_000
    elsewhere = CliRunner().invoke(main, ["analyze", str(directory), "--out", str(tmp_path / "new")])
    assert elsewhere.exit_code == 0
    assert json.loads((tmp_path / "new" / "analysis.json").read_text()) == findings


def test_analyze_needs_a_record(tmp_path):
    result = CliRunner().invoke(main, ["analyze", str(tmp_path / "nothing")])
    assert result.exit_code == 2
    assert "manifest.json: cannot be read" in result.output
    assert result.output.count("\n") == 1


@pytest.mark.parametrize("command", [[], ["stability"], ["analyze"], ["reproduce"], ["design"], ["noise"]])
def test_help(command):
    result = CliRunner().invoke(main, [*command, "--help"])
    assert result.exit_code == 0
    assert "Usage:" in result.output
    if command:
        assert "Example" in result.output


def test_reproduce_a_figure(tmp_path):
    result = CliRunner().invoke(main, ["reproduce", "fig3", "--out", str(tmp_path / "new")])
    assert result.exit_code == 0, result.output
    assert "runs: tables, figures, page" in result.output
    assert (tmp_path / "new" / "figures" / "fig3_euler.png").stat().st_size > 50_000


def test_reproduce_refuses_what_the_paper_has_not(tmp_path):
    result = CliRunner().invoke(main, ["reproduce", "fig9", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert "'fig9' is not one of" in result.output
