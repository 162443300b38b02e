"""From a URDF out of nowhere to a converged run, and what is refused on the way."""

import functools
import json
import re
import shutil

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from outside_urdfs import BOX, OUTSIDE, TURN, gripper, joint, link, robot, rod, two_arms

from ffsm_drake import load_scenario, make_closed_loop, make_true_plant
from ffsm_drake.cli import main
from ffsm_drake.errors import FfsmError, ModelError
from ffsm_drake.onboarding import onboard, read_urdf
from ffsm_drake.onboarding.motion import plan_motion
from ffsm_drake.plant import base_body
from ffsm_drake.scenario import CONTROLLER_NAMES, Scenario
from ffsm_drake.simulation import Rollout
from ffsm_drake.stability import assess


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """made(name) -> Onboarding of one of OUTSIDE, written once."""
    folder = tmp_path_factory.mktemp("outside")

    @functools.cache
    def make(name):
        urdf = folder / f"{name}.urdf"
        urdf.write_text(OUTSIDE[name]())
        return onboard(urdf, folder / name)

    return make


@pytest.mark.parametrize("name", OUTSIDE)
def test_every_controller_converges(made, name):
    new = made(name)
    for controller in CONTROLLER_NAMES:
        assert new.margins[controller].verdict == "stable"
        # A motion four times as fast as the one that was planned, so that it is over soon.
        quick = [f"controller={controller}", "reference.duration=5", "duration=6.5"]
        log = Rollout(load_scenario(new.scenario_file, quick)).run()
        assert log.outcome.completed, log.outcome.message
        assert np.abs(log.error[-1]).max() < 1e-5
        assert np.abs(log.error).max() < 1e-3
        start, end = log.series["state"][0, 7:], log.series["state"][-1, 7:]
        assert np.abs(start - end)[: len(log.coordinates.joints)].max() > 0.1


@pytest.mark.parametrize("name", OUTSIDE)
def test_what_was_found_is_what_flies(made, name):
    new = made(name)
    scenario = load_scenario(new.scenario_file)
    true = make_true_plant(scenario)
    plant, found = true.plant, new.servicer
    assert base_body(plant).name() == found.base
    assert set(true.coordinates.joints) == {each.name for each in found.joints}
    assert plant.CalcTotalMass(true.context) == pytest.approx(found.total_mass + new.payload_mass)
    assert new.payload_mass == pytest.approx(0.25 * found.base_mass, rel=0.01)
    for posture in (scenario.initial_posture, scenario.target_posture):
        for joint_name, value in posture.joints.items():
            moved = plant.GetJointByName(joint_name)
            assert moved.position_lower_limits()[0] <= value <= moved.position_upper_limits()[0]
    # At rest in the target posture, no joint that moves the tip is near where it loses a direction.
    assert set(found.tip.joints) <= set(true.coordinates.joints)


def test_tips_masses_and_reach(made):
    six, arms, hand, seven = (made(name).servicer for name in ("six_joints", "two_arms", "gripper", "seven_joints"))
    assert (six.tip.frame, len(six.tip.joints)) == ("tool0", 6)
    assert six.tip.reach == pytest.approx(0.2 + 0.8 + 0.7 + 0.15 + 0.15 + 0.1)
    assert six.base_mass == 300.0
    assert [(tip.frame, tip.reach) for tip in (arms.tip, *arms.other_tips)] == [
        ("left_tool", pytest.approx(2.0)),
        ("right_tool", pytest.approx(1.5)),
    ]
    assert (hand.tip.frame, hand.other_tips) == ("hand", ())  # the palm, not a finger
    assert (seven.tip.frame, seven.base, seven.base_mass) == ("grasp_point", "base_link", 220.0)


def test_tip_can_be_chosen(tmp_path):
    urdf = tmp_path / "arms.urdf"
    urdf.write_text(two_arms())
    assert read_urdf(urdf, tip="right_elbow_link").tip.joints == ("right_shoulder", "right_elbow")
    with pytest.raises(ModelError, match="no link or frame 'nose' for the tip; choose one of right_shoulder_link, "):
        read_urdf(urdf, tip="nose")
    with pytest.raises(ModelError, match="tip 'torso' does not move"):
        read_urdf(urdf, tip="torso")


def test_what_is_left_out_is_said(made):
    remarks = " ".join(made("six_joints").remarks)
    for text in ("damping and friction", "<transmission> (6 times)", "<gazebo>", "package://nowhere/a.stl", "contact"):
        assert text in remarks
    assert "<mimic>" in " ".join(made("gripper").remarks)
    assert made("two_arms").remarks == ("links without a picture drawn as plain bodies: 7",)


def test_margins_are_those_of_the_stability_command(made):
    new = made("gripper")
    margins = assess(load_scenario(new.scenario_file, ["controller=aismc"]))
    shown = new.margins["aismc"]
    assert margins.verdict == shown.verdict == "stable"
    assert shown.k_s_limit == pytest.approx(margins.k_s_limit.min(), rel=0.02)
    assert margins.k_s_limit.min() > 1.5 * margins.law.k_s_max.max()


def test_folder_can_be_moved(made, tmp_path):
    new = made("prismatic")
    shutil.copytree(new.scenario_file.parent, tmp_path / "elsewhere")
    loop = make_closed_loop(load_scenario(tmp_path / "elsewhere" / new.scenario_file.name))
    assert loop.coordinates.joint_units == ("rad", "rad", "m", "rad")


def test_meshes_come_along(made, tmp_path):
    """Drawable meshes with what they need, from the package's folder or beside the URDF; the motion is the same."""
    package = tmp_path / "my_package"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    (package / "meshes" / "hull.obj").write_text(
        "mtllib hull.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    )
    (package / "meshes" / "hull.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (package / "meshes" / "hand.stl").write_text("solid\nendsolid\n")

    def visual(file):
        return f'<visual><geometry><mesh filename="{file}"/></geometry></visual></link>'

    text = gripper().replace("</link>", visual("package://my_package/meshes/hull.obj"), 1)
    text = text.replace(
        '<link name="hand">', '<link name="hand">' + visual("../meshes/hand.stl").removesuffix("</link>")
    )
    (package / "urdf" / "gripper.urdf").write_text("<!-- By its author. -->\n" + text)
    new = onboard(package / "urdf" / "gripper.urdf", tmp_path / "gripper")
    names = sorted(str(path.relative_to(tmp_path / "gripper")) for path in new.files)
    assert names == ["gripper.urdf", "gripper.yaml", "meshes/hull.mtl", "meshes/hull.obj"]
    assert any("hand.stl" in remark for remark in new.remarks)
    assert "<!-- By its author. -->" in (tmp_path / "gripper" / "gripper.urdf").read_text()
    assert new.scenario_file.read_text() == made("gripper").scenario_file.read_text()
    shutil.rmtree(package)
    make_closed_loop(load_scenario(new.scenario_file))


def simple_arm(**limits):
    """Two joints on a box."""
    limit = " ".join(f'{key}="{value}"' for key, value in limits.items())
    return robot(
        link("bus", **BOX),
        rod("upper", 1.0, 10.0),
        rod("fore", 1.0, 10.0),
        joint("shoulder", "bus", "upper", axis="0 1 0", xyz="0 0 0.6", limit=limit),
        joint("elbow", "upper", "fore", axis="0 1 0", xyz="0 0 1", limit=limit),
    )


def test_weak_or_slow_joints_get_more_time(made, tmp_path):
    urdf = tmp_path / "arm.urdf"
    true = make_true_plant(load_scenario(made("two_arms").scenario_file))
    joints = made("two_arms").servicer
    usual = plan_motion(true, joints, body="debris::debris")
    assert usual.duration == 20.0
    urdf.write_text(two_arms().replace('effort="80"', 'effort="2"').replace('velocity="1.5"', 'velocity="0.1"'))
    weak = plan_motion(true, read_urdf(urdf), body="debris::debris")
    assert weak.initial == usual.initial
    assert weak.duration > 20.0
    assert weak.peak_force[6:].max() <= 0.3 * 2.0
    change = max(abs(weak.initial.joints[each.name] - weak.target.joints[each.name]) for each in joints.joints)
    assert 1.875 * change / weak.duration <= 0.2 * 0.1  # the quintic's peak rate


def replaced(old, new, count=-1):
    text = simple_arm(lower=-2, upper=2)
    assert old in text
    return text.replace(old, new, count)


REFUSED = {
    "world": (
        replaced('<link name="bus">', '<link name="world"/>' + joint("root", "world", "bus", kind="fixed") + '<link name="bus">'),
        "the base 'bus' is attached to the world; remove joint 'root' and link 'world'",
    ),
    "no moving joint": (replaced('type="revolute"', 'type="fixed"'), "has no joint that moves"),
    "planar": (replaced('type="revolute"', 'type="planar"', 1), "joint 'shoulder' is planar and has more than one degree"),
    "unknown kind": (replaced('type="revolute"', 'type="hinge"', 1), "unknown kind 'hinge'; valid are revolute"),
    "massless base": (replaced(link("bus", **BOX), link("bus")), "the base 'bus' has no mass; give it an <inertial>"),
    "massless moving link": (
        replaced("</robot>", link("lamp") + joint("pan", "bus", "lamp", limit=TURN) + "</robot>"),
        "link 'lamp' moves but has no mass, and carries none",
    ),
    "inertia without mass": (replaced('mass value="300.0"', 'mass value="0"'), "link 'bus': has inertia but no mass"),
    "negative mass": (replaced('mass value="10.0"', 'mass value="-1"'), "link 'upper': mass -1 kg must be positive"),
    "impossible inertia": (replaced('izz="90.0"', 'izz="900.0"'), "link 'bus': no body has the principal moments 120, 120, 900"),
    "no inertia about the axis": (
        replaced("</robot>", link("lamp", mass=1, inertia=(0, 0, 0)) + joint("pan", "bus", "lamp", limit=TURN) + "</robot>"),
        "joint 'pan' moves nothing that has inertia",
    ),
    "two roots": (replaced("</robot>", link("lost", mass=1) + "</robot>"), "not 2 (bus, lost)"),
    "loop": (
        replaced("</robot>", link("a") + link("b") + joint("p", "a", "b") + joint("q", "b", "a") + "</robot>"),
        "link 'a' does not hang on the base 'bus'",
    ),
    "two parents": (replaced("</robot>", joint("again", "bus", "fore") + "</robot>"), "link 'fore' is the child of 2 joints"),
    "missing link": (replaced('child link="fore"', 'child link="hand"'), "joint 'elbow': its child link 'hand' does not exist"),
    "repeated joint": (replaced('joint name="elbow"', 'joint name="shoulder"'), "more than one joint is called 'shoulder'"),
    "repeated link": (replaced("</robot>", link("fore") + "</robot>"), "more than one link is called 'fore'"),
    "reserved name": (replaced('joint name="elbow"', 'joint name="joints"'), "joint 'joints': the name clashes"),
    "bad number": (replaced('lower="-2"', 'lower="low"'), "joint 'shoulder': <limit lower> must be a number, not 'low'"),
    "limits crossed": (replaced('lower="-2"', 'lower="3"'), "its lower limit 3 lies above its upper limit 2"),
    "not XML": ("<robot", "is not valid XML"),
    "other XML": ("<sdf/>", "its root element is <sdf>"),
    "xacro": ('<robot xmlns:xacro="http://ros.org/xacro"><xacro:include filename="a"/></robot>', "is a xacro file; expand it"),
    "no links": ("<robot/>", "one link must be the base, without a parent, not none"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(tmp_path, case):
    text, told = REFUSED[case]
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(text)
    result = CliRunner().invoke(main, ["new", str(tmp_path / "deep" / "mine"), "--urdf", str(urdf)])
    assert result.exit_code == 2, result.output
    assert told in result.output
    assert re.fullmatch(r"error: [^\n]+\n", result.output)
    assert [path.name for path in tmp_path.iterdir()] == ["robot.urdf"]


def test_refused_arguments(tmp_path):
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(simple_arm())
    full = tmp_path / "full"
    full.mkdir()
    (full / "work.txt").write_text("mine")

    def told(*arguments, directory=tmp_path / "new"):
        result = CliRunner().invoke(main, ["new", str(directory), *map(str, arguments)])
        assert result.exit_code == 2
        return result.output.splitlines()[-1]

    assert "none.urdf: no such file" in told("--urdf", tmp_path / "none.urdf")
    assert "no such file" in told("--urdf", tmp_path)
    assert "is not empty; name a new folder" in told("--urdf", urdf, directory=full)
    assert "is a file; name a new folder" in told("--urdf", urdf, directory=urdf)
    assert "name of a scenario that ships" in told("--urdf", urdf, directory=tmp_path / "paper")
    assert "must be > 0 kg, not -1" in told("--urdf", urdf, "--payload-mass", -1)
    assert "no such folder: /nowhere" in told("--urdf", urdf, "--package", "a=/nowhere")
    assert "must have the form NAME=FOLDER" in told("--urdf", urdf, "--package", "a")
    assert "no link or frame 'x'" in told("--urdf", urdf, "--tip", "x")
    assert (full / "work.txt").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["full", "robot.urdf"]


def test_command(tmp_path):
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(simple_arm(lower=-2, upper=2, effort=0, velocity=0))
    (tmp_path / "new").mkdir()
    arguments = ["new", str(tmp_path / "new"), "--urdf", str(urdf), "--payload-mass", "40", "--json"]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    assert data["payload_mass"] == 40.0
    assert [each["name"] for each in data["joints"]] == ["shoulder", "elbow"]
    assert data["joints"][0] == {
        "name": "shoulder", "kind": "revolute", "unit": "rad", "lower": -2.0, "upper": 2.0, "effort": None, "velocity": None,
    }  # fmt: skip
    assert all(each["stable"] for each in data["margins"].values())
    scenario = load_scenario(data["scenario"])
    assert (scenario.payload.truth.mass, scenario.payload.belief.mass) == (40.0, 32.0)
    # Only what a user edits, and nothing that the scenario does not know.
    assert set(yaml.safe_load((tmp_path / "new" / "new.yaml").read_text())) < set(vars(Scenario()))
    again = CliRunner().invoke(main, arguments)
    assert again.exit_code == 2
    assert "is not empty" in again.output


def test_printed(made):
    from ffsm_drake.onboarding import onboarding_text

    text = onboarding_text(made("two_arms"))
    for part in (
        "torso, 450 kg of 485 kg",
        "left_tool, 3 joints, reach 2 m",
        "--tip right_tool",
        "ffsm run ",
        "tde_aismc",
    ):
        assert part in text
    assert issubclass(ModelError, FfsmError)
