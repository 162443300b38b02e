"""The wiring: its names, its pictures in diagrams/, and a controller of one's own in the same
sockets.
"""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.loop.closed_loop import SIGNALS
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.show import block_diagram
from ffsm_drake.show.meshcat import quiet_drake, start_meshcat
from ffsm_drake.systems.reference import make_motion

pytestmark = pytest.mark.rounding

DIAGRAMS = Path(__file__).parents[2] / "diagrams"


@pytest.mark.smoke
def test_systems_and_signals_have_names():
    loop = make_closed_loop(load_scenario("postcapture"))
    names = {system.get_name() for system in loop.diagram.GetSystems()}
    assert names == {
        "plant", "reference", "tde_aismc", "disturbance", "sensing", "measurement", "total_force",
    }  # fmt: skip
    outputs = [
        loop.diagram.get_output_port(i).get_name() for i in range(loop.diagram.num_output_ports())
    ]
    assert outputs == [*SIGNALS, "sliding_variable", "reaching_gain", "switching_gain"]


def test_the_geometry_is_loaded_only_to_be_shown():
    """It takes longer than all the rest of the build."""
    scenario = load_scenario("postcapture")
    with quiet_drake():
        shown = Rollout(scenario, meshcat=start_meshcat()).loop
    names = {system.get_name() for system in shown.diagram.GetSystems()}
    plain = Rollout(scenario).loop
    assert names - {system.get_name() for system in plain.diagram.GetSystems()} == {
        "scene_graph",
        "meshcat_visualizer",
    }


def test_showing_the_bodies_does_not_make_them_collide(tmp_path):
    """A box that reaches deep into another leaves it alone, with the picture and without."""
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    (tmp_path / "robot.urdf").write_text(
        f"""<robot name="robot"><link name="base">{inertial}{box}</link>
        <link name="middle">{inertial}</link><link name="debris">{inertial}{box}</link>
        <joint name="joint_1" type="revolute"><parent link="base"/><child link="middle"/>
        <axis xyz="0 0 1"/></joint>
        <joint name="joint_2" type="revolute"><parent link="middle"/><child link="debris"/>
        <origin xyz="0.8 0 0"/><axis xyz="0 0 1"/></joint></robot>"""
    )
    directives = tmp_path / "robot.dmd.yaml"
    directives.write_text(
        f"directives:\n- add_model: {{name: robot, file: file://{tmp_path / 'robot.urdf'}}}\n"
    )
    zero = "{joint_1: 0, joint_2: 0}"
    scenario = load_scenario(
        "postcapture",
        [
            f"model.directives={directives}",
            "model.end_effector=robot::debris",
            "payload.body=robot::debris",
            f"initial_posture.joints={zero}",
            f"target_posture.joints={zero}",
            "disturbance.harmonics={}",
        ],
    )
    for meshcat in (None, start_meshcat()):
        with quiet_drake():
            loop = Rollout(scenario, meshcat=meshcat).loop
        context = loop.diagram.CreateDefaultContext()
        loop.initialize(loop.diagram, context)
        derivatives = loop.diagram.EvalTimeDerivatives(context).CopyToVector()
        assert np.array_equal(derivatives, np.zeros(17)), meshcat


@pytest.mark.smoke
def test_the_plant_is_continuous_weightless_and_free():
    plant = make_closed_loop(load_scenario("postcapture")).plant
    assert plant.time_step() == 0.0
    assert plant.num_velocities() == 11
    assert plant.num_positions() == 12
    assert plant.gravity_field().gravity_vector().tolist() == [0, 0, 0]
    assert plant.num_actuators() == 5  # of the joints' rotors; no force goes that way


@pytest.mark.smoke
def test_initialize_sets_posture_payload_and_seed():
    loop = make_closed_loop(
        load_scenario("postcapture", ["random_seed=5", "payload.truth.mass=123"])
    )
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
    assert loop.plant.GetPositions(plant_context) == pytest.approx(
        make_motion(loop.scenario, loop.coordinates).evaluate(0.0)[0]
    )
    assert loop.plant.CalcTotalMass(plant_context) == pytest.approx(549.0)


@pytest.mark.parametrize("name", ["closed_loop", "controller"])
def test_the_pictures_in_diagrams_show_the_wiring_of_today(name):
    """On failure: python -m ffsm_drake.show.block_diagram"""
    assert (DIAGRAMS / f"{name}.dot").read_text() == block_diagram.shipped_diagrams()[name]
    assert (DIAGRAMS / f"{name}.svg").is_file()


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
