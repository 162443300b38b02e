"""The command ``ffsm reproduce``."""

import inspect

import pytest
from click.testing import CliRunner

from ffsm_drake.cli import main
from ffsm_drake.common.steps import current_step
from ffsm_drake.plugins.paper import reproduce


def ffsm(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def test_reproduce_a_figure(tmp_path, monkeypatch):
    asked = {}

    def asking(what, directory, **options):  # the figure itself: ``test_reproduction.py``
        inspect.signature(reproduce).bind(what, directory, **options)
        asked.update(options, what=what)
        assert current_step() == "the first runs"
        options["progress"](2, 2, "tables, figures, page")
        assert current_step() == "2 of 2 runs: tables, figures, page"
        return directory / "figure.png"

    monkeypatch.setattr("ffsm_drake.plugins.paper.reproduce", asking)
    result = ffsm("reproduce", "fig3", "--seeds", 2, "--out", tmp_path / "new")
    assert result.exit_code == 0, result.output
    assert (asked["what"], asked["seeds"], asked["workers"]) == ("fig3", 2, 2)
    assert "2 of 2 runs: tables, figures, page" in result.output
    assert f"open {tmp_path / 'new' / 'figure.png'}" in " ".join(result.output.split())


@pytest.mark.smoke
def test_reproduce_refuses_what_the_paper_has_not(tmp_path):
    result = ffsm("reproduce", "fig9", "--out", tmp_path)
    assert result.exit_code == 2
    assert "'fig9' is not one of" in result.output
