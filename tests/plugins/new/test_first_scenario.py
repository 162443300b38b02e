"""From a user's URDF to a scenario that every shipped controller settles."""

import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from outside_urdfs import (
    OUTSIDE,
    arm_alone,
    stage,
    two_armed,
)
from steps_seen import steps_seen

from ffsm_drake import load_scenario, make_true_plant
from ffsm_drake.cli import main
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.plugins.new.urdf.mounting import make_bus
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.plant import base_body

# Final error, rad or m, held after a motion of a quarter of the planned duration (PD+: of half of
# it). Computed torque and PD+ estimate neither the disturbance nor the payload's deviation, and
# keep the error that these cause.
LARGEST_ERROR = {"computed_torque": 2e-4, "pd_plus": 1e-3}


@pytest.fixture(scope="module", autouse=True)
def few_postures():
    """Two postures of the motion instead of five: what is made here is simulated as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ffsm_drake.plugins.design.stability.margins.POSTURES", (0.0, 0.5))
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """made(name) -> NewScenario of one of OUTSIDE, written once."""
    folder = tmp_path_factory.mktemp("outside")

    @functools.cache
    def make(name):
        urdf = folder / f"{name}.urdf"
        urdf.write_text(OUTSIDE[name]())
        return new_scenario(urdf, folder / name)

    return make


@pytest.mark.long
def test_every_step_that_takes_time_has_a_name(tmp_path):
    """Also which try of how many."""
    urdf = tmp_path / "craft.urdf"
    urdf.write_text(OUTSIDE["six_joints"]())
    with steps_seen() as seen:
        new_scenario(urdf, tmp_path / "mine")
    assert seen[""] < 0.2 * seen.total(), seen
    assert any(re.search(r"bandwidth 1 of at most \d+", name) for name in seen), seen


# Who flies each URDF; the margins of all controllers are asserted for each.
CONTROLLERS = {
    "six_joints": ["tde_aismc", "aismc"],
    "prismatic": ["pd_plus"],
    "gripper": ["tdc"],
    "two_armed": ["asmc", "tde_aismc"],
    "seven_joints": ["computed_torque"],
}
SLOW = ("two_armed", "seven_joints", "prismatic")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.long if name in SLOW else ()) for name in OUTSIDE]
)
def test_every_controller_settles(made, name):
    new = made(name)
    check_model(new)
    assert {each.verdict for each in new.margins.values()} == {"stable for small errors"}
    for controller in CONTROLLERS[name]:
        moving = 10 if controller == "pd_plus" else 5
        quick = [
            f"controller={controller}",
            f"reference.duration={moving}",
            f"duration={moving + 1}",
        ]
        log = Rollout(load_scenario(new.scenario_file, quick)).run()
        assert log.outcome.completed, log.outcome.message
        assert np.abs(log.error[-1]).max() < LARGEST_ERROR.get(controller, 1e-5)
        assert np.abs(log.error).max() < 5e-3
        start, end = log.series["state"][0, 7:], log.series["state"][-1, 7:]
        assert np.abs(start - end)[: len(log.coordinates.joints)].max() > 0.1


def check_model(new):
    """What was found is what is simulated."""
    scenario = load_scenario(new.scenario_file)
    true = make_true_plant(scenario)
    plant, found = true.plant, new.servicer
    assert base_body(plant).name() == found.base
    assert set(true.coordinates.joints) == {each.name for each in found.joints}
    assert plant.CalcTotalMass(true.context) == pytest.approx(found.total_mass + new.payload_mass)
    assert new.payload_mass == pytest.approx(0.25 * found.base_mass, rel=0.01)
    efforts = {each.name: each.effort for each in found.joints if np.isfinite(each.effort)}
    if len(set(efforts.values())) == 1:
        efforts = {"joints": next(iter(efforts.values()))}
    assert scenario.actuation.limit == efforts
    for posture in (scenario.initial_posture, scenario.target_posture):
        for joint_name, value in posture.joints.items():
            moved = plant.GetJointByName(joint_name)
            assert moved.position_lower_limits()[0] <= value <= moved.position_upper_limits()[0]


def test_margins_are_those_of_the_stability_command(made):
    new = made("gripper")
    margins = stability(load_scenario(new.scenario_file, ["controller=aismc"]))
    shown = new.margins["aismc"]
    assert margins.verdict == shown.verdict == "stable for small errors"
    assert shown.axes.k_s_limit.min() == pytest.approx(margins.axes.k_s_limit.min(), rel=0.02)
    assert margins.axes.k_s_limit.min() > 1.5 * margins.axes.k_s_max.max()


def test_folder_can_be_moved(made, tmp_path):
    """No file names the place where it was made, and the moved scenario gives the same run."""
    new = made("six_joints")
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(new.scenario_file.parent, elsewhere)
    for file in elsewhere.rglob("*.*"):
        assert not re.search(r'(^|[\s"\'=\[{])/\w|file://', file.read_text(), re.MULTILINE)
        assert str(new.scenario_file.parents[1]) not in file.read_text()
    before = Rollout(load_scenario(new.scenario_file, ["duration=1"])).run()
    new.scenario_file.parent.rename(tmp_path / "not there any more")
    moved = load_scenario(elsewhere / new.scenario_file.name, ["duration=1"])
    shutil.move(tmp_path / "not there any more", new.scenario_file.parent)
    assert Path(moved.model.servicer).is_relative_to(elsewhere)
    assert np.array_equal(Rollout(moved).run().series["state"], before.series["state"])


@pytest.mark.long
def test_pd_plus_gains_follow_the_inertia(made):
    """A wrist gets less than the base, a heavy hull more than a light platform; every coordinate
    has its own.
    """
    gains = {name: pd_plus(made(name)) for name in ("gripper", "prismatic")}
    for name, (k_p, k_d) in gains.items():
        planned = PlannedDynamics(make_mission(load_scenario(made(name).scenario_file)))
        assert tuple(k_p) == tuple(k_d) == planned.coordinates.names
        # K_D L of the coupled loop, which must stay below 2, at the worst of the postures.
        rate = max(
            np.linalg.eigvals(np.linalg.solve(h, np.diag(list(k_d.values())))).real.max()
            for h, _ in map(planned.mass_matrices, np.linspace(0.0, planned.motion.end, 9))
        )
        assert 0.4 < 0.01 * rate < 0.81
    assert gains["gripper"][1]["base_position_x"] < 0.2 * gains["prismatic"][1]["base_position_x"]
    assert gains["gripper"][1]["grip_a"] < 0.1 * gains["gripper"][1]["base_position_x"]


def pd_plus(new):
    gains = yaml.safe_load(new.scenario_file.read_text())["controllers"]["pd_plus"]
    return gains["k_p"], gains["k_d"]


@pytest.mark.slow
def test_weak_or_slow_joints_get_more_time(made, tmp_path):
    usual, urdf = made("two_armed"), tmp_path / "arm.urdf"
    assert usual.scenario.reference.duration == 20.0
    urdf.write_text(
        two_armed().replace('effort="80"', 'effort="2"').replace('velocity="1.5"', 'velocity="0.1"')
    )
    weak = new_scenario(urdf, tmp_path / "weak")
    start, end = weak.scenario.initial_posture.joints, weak.scenario.target_posture.joints
    assert start == usual.scenario.initial_posture.joints
    duration = weak.scenario.reference.duration
    assert duration > 20.0
    assert max(weak.peak_force[name] for name in start) <= 0.3 * 2.0
    change = max(abs(start[name] - end[name]) for name in start)
    assert 1.875 * change / duration <= 0.2 * 0.1  # the quintic's peak rate


@pytest.mark.long
def test_the_tutorial(tmp_path):
    """The URDF of docs/own_arm.md, through the command that the page prints."""
    example = Path(__file__).parents[3] / "examples" / "courier.urdf"
    urdf = tmp_path / "courier.urdf"
    urdf.write_text(example.read_text().replace('effort="20"', 'effort="0"'))
    (tmp_path / "mine").mkdir()
    arguments = [
        "new",
        str(tmp_path / "mine"),
        "--urdf",
        str(urdf),
        "--payload-mass",
        "40",
        "--json",
    ]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["payload_mass"] == 40.0
    assert [each["name"] for each in data["joints"]] == ["yaw", "shoulder", "elbow", "wrist"]
    wrist = {"name": "wrist", "kind": "revolute", "unit": "rad", "lower": -2.0, "upper": 2.0}
    assert data["joints"][3] == wrist | {"effort": None, "velocity": 1.0}
    assert (data["base"], data["tip"]) == ({"link": "bus", "mass": 150.0}, "tool")
    assert all(each["stable"] for each in data["margins"].values())
    scenario = load_scenario(data["scenario"])
    assert (scenario.payload.truth.mass, scenario.payload.nominal.mass) == (40.0, 32.0)
    # Only keys that the scenario knows, and not all of them.
    assert set(yaml.safe_load((tmp_path / "mine" / "mine.yaml").read_text())) < set(
        vars(Scenario())
    )
    # What the page says of a payload that is nominally too heavy.
    for share, outcome in ((1.45, "completed"), (2.0, "diverged")):
        nominal = [
            f"payload.nominal.mass={share * 40}",
            f"payload.nominal.inertia={[share * each for each in scenario.payload.truth.inertia]}",
        ]
        log = Rollout(load_scenario(data["scenario"], ["duration=3", *nominal])).run()
        assert log.outcome.status == outcome
    again = CliRunner().invoke(main, arguments)
    assert again.exit_code == 2
    assert "is not empty" in again.output


@pytest.mark.long
def test_an_arm_alone_on_a_bus_with_a_target_of_its_own(tmp_path):
    (tmp_path / "ur5.urdf").write_text(arm_alone())
    (tmp_path / "stage.urdf").write_text(stage())
    words = [
        "new",
        str(tmp_path / "mine"),
        "--urdf",
        str(tmp_path / "ur5.urdf"),
        "--bus-mass",
        "400",
        "--bus-size",
    ]
    result = CliRunner().invoke(
        main, [*words, "1,1.5,2", "--target", str(tmp_path / "stage.urdf"), "--json"]
    )
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["base"] == {"link": "bus", "mass": 404.0}  # with the arm's foot
    assert data["payload_mass"] == 250.0
    assert {each["verdict"] for each in data["margins"].values()} == {"stable for small errors"}
    scenario = load_scenario(data["scenario"])
    plant, context = (true := make_true_plant(scenario)).plant, true.context
    assert plant.CalcTotalMass(context) == pytest.approx(data["total_mass"] + 250.0)
    bus, foot, tank = (plant.GetBodyByName(name) for name in ("bus", "base_link", "tank"))
    # The joint to the world says where the arm stands on the +z face.
    X_bus_foot = foot.body_frame().CalcPose(context, bus.body_frame())
    assert X_bus_foot.translation() == pytest.approx([0.2, 0.0, 1.05])
    assert X_bus_foot.rotation().ToAngleAxis().angle() == pytest.approx(0.5)
    inertia = bus.default_spatial_inertia().CalcRotationalInertia()
    box = [400 / 12 * (1.5**2 + 2**2), 400 / 12 * (1 + 2**2), 400 / 12 * (1 + 1.5**2)]
    assert inertia.get_moments() == pytest.approx(box)
    # The target's mass properties are those that Drake reads in its URDF.
    truth, own = scenario.payload.truth, tank.default_spatial_inertia()
    assert (truth.mass, truth.center_of_mass) == (own.get_mass(), pytest.approx(own.get_com()))
    central = own.Shift(own.get_com()).CalcRotationalInertia()
    wanted = [*central.get_moments(), *central.get_products()]
    assert truth.inertia == pytest.approx(wanted, abs=1e-9)
    assert wanted[5] == pytest.approx(10.0)
    assert scenario.payload.nominal.mass == 200.0
    log = Rollout(load_scenario(data["scenario"], ["duration=2"])).run()
    assert np.abs(log.error).max() < 1e-4


@pytest.mark.smoke
def test_an_arm_without_a_world_stands_on_the_middle_of_a_cube(tmp_path):
    (tmp_path / "ur5.urdf").write_text(arm_alone(stand=False))
    servicer = read_urdf(tmp_path / "ur5.urdf", bus=make_bus(400.0))
    mounting = servicer.root.findall("joint")[-1]
    assert mounting.find("child").get("link") == "base_link"
    assert mounting.find("origin").get("xyz") == "0.0 0.0 1.0"  # the shipped servicer's cube
    assert (servicer.base, servicer.base_mass) == ("bus", 404.0)


def test_printed(made):
    text = made("two_armed").summary()
    for part in (
        "torso, 450 kg of 485 kg; holds a target of 112 kg, a cube of 1.04 m",
        "left_tool, 3 joints, reach 2 m",
        "--tip right_tool",
        "ffsm run ",
        "tde_aismc",
    ):
        assert part in text


def test_the_comment_names_the_laws_that_have_gains(made):
    new = made("gripper")
    text = new.scenario_file.read_text()
    named = re.search(r"^# Gains of ([\w, ]+)\. Other laws", text, re.MULTILINE)[1]
    assert named.split(", ") == list(yaml.safe_load(text)["controllers"])
