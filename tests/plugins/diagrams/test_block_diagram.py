"""The pictures of the wiring in diagrams/, and those of any scenario."""

import re
import shutil
from pathlib import Path

import pytest

from ffsm_drake import load_scenario
from ffsm_drake.plugins.diagrams import block_diagram

pytestmark = pytest.mark.rounding

DIAGRAMS = Path(__file__).parents[3] / "diagrams"


@pytest.mark.parametrize("name", ["closed_loop", "controller"])
def test_the_pictures_in_diagrams_show_the_wiring_of_today(name):
    """On failure: python -m ffsm_drake.plugins.diagrams.block_diagram"""
    assert (DIAGRAMS / f"{name}.dot").read_text() == block_diagram.shipped_diagrams()[name]
    assert (DIAGRAMS / f"{name}.svg").is_file()


@pytest.mark.smoke
def test_a_changed_wiring_changes_the_picture():
    scenario = load_scenario("postcapture", ["controller=tdc"])
    assert (
        block_diagram.closed_loop_dot(scenario) != block_diagram.shipped_diagrams()["closed_loop"]
    )
    assert block_diagram.closed_loop_dot(scenario) == block_diagram.closed_loop_dot(scenario)


def test_only_idle_ports_are_left_out():
    dot = block_diagram.closed_loop_dot(load_scenario("postcapture"))
    assert "applied_generalized_force" in dot
    assert "servicer_actuation" not in dot
    for block, port in re.findall(r"(s\d+):([uy]\d+):[ew]", dot):
        table = re.search(rf"^{block} \[.*?</TABLE>", dot, re.DOTALL | re.MULTILINE)[0]
        assert f'PORT="{port}"' in table, (block, port)


@pytest.mark.parametrize("name", ["postcapture", "thrusters_and_wheels", "tumbling_capture"])
def test_what_only_a_log_or_a_picture_reads_is_left_out(name):
    """Every other block and connection is drawn."""
    plain, logged = (
        block_diagram.closed_loop_dot(load_scenario(name), logged=logged)
        for logged in (False, True)
    )
    for word in ("output ports", "Meshcat", "SceneGraph", "ZeroOrderHold"):
        assert word in logged
        assert word not in plain

    def wires(dot):
        names = dict(
            re.findall(r"(?m)^(s\d+) \[.*?\nname=(\w+)", dot.replace("<B>", ""), re.DOTALL)
        )
        ends = re.findall(r"(?m)^(s\d+):\w+:\w+ -> (s\d+):", dot)
        return sorted((names[a], names[b]) for a, b in ends if a in names and b in names)

    left = {"scene_graph", "meshcat_visualizer", "measurement"}
    assert wires(plain) == [wire for wire in wires(logged) if not left & {*wire}]
    assert ("plant", "sensing") in wires(plain)


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz's dot is not installed")
def test_pictures_are_drawn(tmp_path):
    assert block_diagram.main(tmp_path) == 0
    for name in ("closed_loop", "controller"):
        assert (tmp_path / f"{name}.svg").read_text().count("<polygon") > 3


def test_without_graphviz_the_dot_file_is_written_and_one_line_says_what_to_do(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert block_diagram.main(tmp_path) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["closed_loop.dot", "controller.dot"]
    assert "install the package 'graphviz'" in capsys.readouterr().out
