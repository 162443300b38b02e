"""The wiring: its names, and a controller of one's own in the same sockets."""

import numpy as np
import pytest

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.mission import make_mission
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.systems.reference import make_motion

pytestmark = pytest.mark.rounding

stage = pytest.importorskip("ffsm_drake.plugins.meshcat.stage")


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
    assert outputs == [
        "state", "estimated_state", "measurement", "desired_state", "desired_acceleration",
        "generalized_force", "applied_force", "disturbance_force", "sliding_variable",
        "reaching_gain", "switching_gain",
    ]  # fmt: skip


def test_the_geometry_is_loaded_only_to_be_shown():
    """It takes longer than all the rest of the build."""
    scenario = load_scenario("postcapture")
    with stage.quiet_drake():
        shown = Rollout(scenario, meshcat=stage.start_meshcat()).loop
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
    for server in (None, stage.start_meshcat()):
        with stage.quiet_drake():
            loop = Rollout(scenario, meshcat=server).loop
        context = loop.diagram.CreateDefaultContext()
        loop.initialize(loop.diagram, context)
        derivatives = loop.diagram.EvalTimeDerivatives(context).CopyToVector()
        assert np.array_equal(derivatives, np.zeros(17)), server


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
        make_motion(make_mission(loop.scenario)).evaluate(0.0)[0]
    )
    assert loop.plant.CalcTotalMass(plant_context) == pytest.approx(549.0)
