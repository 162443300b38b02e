"""The wiring: its names, its pictures in diagrams/, and a controller of one's own in the same sockets."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from ffsm_drake import block_diagram, load_scenario, make_closed_loop
from ffsm_drake.closed_loop import SIGNALS

DIAGRAMS = Path(__file__).parents[1] / "diagrams"


def test_systems_and_signals_have_names():
    loop = make_closed_loop(load_scenario("postcapture"))
    names = {system.get_name() for system in loop.diagram.GetSystems()}
    assert names == {
        "plant", "scene_graph", "reference", "tde_aismc", "actuation", "disturbance", "sensing", "total_force",
    }  # fmt: skip
    outputs = [loop.diagram.get_output_port(i).get_name() for i in range(loop.diagram.num_output_ports())]
    assert outputs == [*SIGNALS, "sliding_variable", "reaching_gain", "switching_gain"]


def test_the_plant_is_continuous_weightless_and_free():
    plant = make_closed_loop(load_scenario("postcapture")).plant
    assert plant.time_step() == 0.0
    assert plant.num_velocities() == 11
    assert plant.num_positions() == 12
    assert plant.gravity_field().gravity_vector().tolist() == [0, 0, 0]
    assert plant.num_actuators() == 0


def test_initialize_sets_posture_payload_and_seed():
    loop = make_closed_loop(load_scenario("postcapture", ["random_seed=5", "payload.truth.mass=123"]))
    noise = []
    for _ in range(2):
        context = loop.diagram.CreateDefaultContext()
        loop.initialize(loop.diagram, context)
        noise.append(
            loop.diagram.GetOutputPort("estimated_state").Eval(context)
            - loop.diagram.GetOutputPort("state").Eval(context)
        )
    assert np.array_equal(noise[0], noise[1])
    assert noise[0][12:].any()
    assert not noise[0][:12].any()
    plant_context = loop.plant.GetMyContextFromRoot(context)
    assert loop.plant.GetPositions(plant_context) == pytest.approx(loop.reference.evaluate(0.0)[0])
    assert loop.plant.CalcTotalMass(plant_context) == pytest.approx(549.0)


@pytest.mark.parametrize("name", ["closed_loop", "controller"])
def test_the_pictures_in_diagrams_show_the_wiring_of_today(name):
    """On failure: python -m ffsm_drake.block_diagram"""
    assert (DIAGRAMS / f"{name}.dot").read_text() == block_diagram.shipped_diagrams()[name]
    assert (DIAGRAMS / f"{name}.svg").is_file()


def test_a_changed_wiring_changes_the_picture():
    scenario = load_scenario("postcapture", ["controller=tdc"])
    assert block_diagram.closed_loop_dot(scenario) != block_diagram.shipped_diagrams()["closed_loop"]
    assert block_diagram.closed_loop_dot(scenario) == block_diagram.closed_loop_dot(scenario)


def test_only_idle_ports_are_left_out():
    dot = block_diagram.closed_loop_dot(load_scenario("postcapture"))
    assert "applied_generalized_force" in dot
    assert "servicer_actuation" not in dot
    for block, port in re.findall(r"(s\d+):([uy]\d+):[ew]", dot):
        table = re.search(rf"^{block} \[.*?</TABLE>", dot, re.DOTALL | re.MULTILINE)[0]
        assert f'PORT="{port}"' in table, (block, port)


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz's dot is not installed")
def test_pictures_are_drawn(tmp_path):
    assert block_diagram.main(tmp_path) == 0
    for name in ("closed_loop", "controller"):
        assert (tmp_path / f"{name}.svg").read_text().count("<polygon") > 3


def test_without_graphviz_the_dot_file_is_written_and_one_line_says_what_to_do(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert block_diagram.main(tmp_path) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["closed_loop.dot", "controller.dot"]
    assert "install the package 'graphviz'" in capsys.readouterr().out
