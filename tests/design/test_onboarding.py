"""From a URDF out of nowhere to a converged run, and what is refused on the way."""

import functools
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from outside_urdfs import BOX, OUTSIDE, TURN, gripper, joint, link, robot, rod, two_arms
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake import load_scenario, make_closed_loop, make_true_plant
from ffsm_drake.cli import main
from ffsm_drake.common.errors import ModelError
from ffsm_drake.design.first_motion import plan_motion
from ffsm_drake.design.first_scenario import onboard, onboarding_text
from ffsm_drake.design.stability import assess
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import CONTROLLER_NAMES, Model, Scenario
from ffsm_drake.spacecraft.plant import add_combined_plant, base_body
from ffsm_drake.spacecraft.urdf import read_urdf, write_flyable


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
        # A motion four times as fast as the planned one, so that it is over soon.
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


def test_meshes_come_along(tmp_path):
    """Drawable meshes with what they need, found by package address or path; the author's header stays."""
    package = tmp_path / "my_package"
    for folder in ("meshes", "urdf"):
        (package / folder).mkdir(parents=True)
    shape = "mtllib hull.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    (package / "meshes" / "hull.obj").write_text(shape)
    (package / "meshes" / "hull.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (package / "meshes" / "hand.stl").write_text("solid\nendsolid\n")

    def mesh(file):
        return f'<visual><geometry><mesh filename="{file}"/></geometry></visual>'

    text = (
        gripper()
        .replace("</link>", mesh("package://my_package/meshes/hull.obj") + "</link>", 1)
        .replace('<link name="hand">', '<link name="hand">' + mesh("../meshes/hand.stl"))
        .replace("<robot", "<!-- By its author. -->\n<robot")
    )
    urdf = package / "urdf" / "gripper.urdf"
    urdf.write_text(text)
    out = tmp_path / "out"
    remarks = write_flyable(read_urdf(urdf), out, file_name="gripper.urdf", packages={})
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*.*"))
    assert files == ["gripper.urdf", "meshes/hull.mtl", "meshes/hull.obj"]
    assert any("hand.stl" in remark for remark in remarks)
    assert "<!-- By its author. -->" in (out / "gripper.urdf").read_text()
    shutil.rmtree(package)
    model = Model(directives=None, servicer=str(out / "gripper.urdf"), end_effector="servicer::hand")
    add_combined_plant(DiagramBuilder(), model)

    # Elsewhere, only an option can say where the package is.
    urdf = tmp_path / "gripper.urdf"
    urdf.write_text(text)
    remarks = write_flyable(read_urdf(urdf), tmp_path / "lost", file_name="gripper.urdf", packages={})
    assert any("package://my_package/meshes/hull.obj" in remark for remark in remarks)
    (out / "meshes" / "meshes").mkdir()
    (out / "meshes" / "hull.obj").rename(out / "meshes" / "meshes" / "hull.obj")
    remarks = write_flyable(
        read_urdf(urdf), tmp_path / "found", file_name="gripper.urdf", packages={"my_package": out / "meshes"}
    )
    assert not any("hull.obj" in remark for remark in remarks)
    assert (tmp_path / "found" / "meshes" / "hull.obj").read_text() == shape


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


def plus(*parts):
    return replaced("</robot>", "".join(parts) + "</robot>")


PAN = joint("pan", "bus", "lamp", limit=TURN)
FIRST = 'type="revolute"'
REFUSED = {
    "world": (
        plus(link("world"), joint("root", "world", "bus", kind="fixed")),
        "the base 'bus' is attached to the world; remove joint 'root' and link 'world'",
    ),
    "no moving joint": (replaced(FIRST, 'type="fixed"'), "has no joint that moves"),
    "planar": (
        replaced(FIRST, 'type="planar"', 1),
        "joint 'shoulder' is planar and has more than one degree of freedom",
    ),
    "unknown kind": (replaced(FIRST, 'type="hinge"', 1), "unknown kind 'hinge'; valid are revolute"),
    "massless base": (replaced(link("bus", **BOX), link("bus")), "the base 'bus' has no mass; give it an <inertial>"),
    "massless moving link": (plus(link("lamp"), PAN), "link 'lamp' moves but has no mass, and carries none"),
    "inertia without mass": (replaced('mass value="300.0"', 'mass value="0"'), "link 'bus': has inertia but no mass"),
    "negative mass": (replaced('mass value="10.0"', 'mass value="-1"'), "link 'upper': mass -1 kg must be positive"),
    "impossible inertia": (replaced('izz="90.0"', 'izz="900.0"'), "no body has the principal moments 120, 120, 900"),
    "no inertia about an axis": (
        plus(link("lamp", mass=1, inertia=(0, 0, 0)), PAN),
        "joint 'pan' moves nothing that has inertia beside the rest",
    ),
    "two roots": (plus(link("lost", mass=1)), "not 2 (bus, lost)"),
    "loop": (
        plus(link("a"), link("b"), joint("p", "a", "b"), joint("q", "b", "a")),
        "link 'a' does not hang on the base 'bus'",
    ),
    "two parents": (plus(joint("again", "bus", "fore")), "link 'fore' is the child of 2 joints"),
    "missing link": (replaced('child link="fore"', 'child link="hand"'), "its child link 'hand' does not exist"),
    "repeated joint": (replaced('"elbow"', '"shoulder"'), "more than one joint is called 'shoulder'"),
    "repeated link": (plus(link("fore")), "more than one link is called 'fore'"),
    "reserved name": (replaced('"elbow"', '"joints"'), "joint 'joints': the name clashes"),
    "bad number": (
        replaced('lower="-2"', 'lower="low"'),
        "joint 'shoulder': <limit lower> must be a number, not 'low'",
    ),
    "limits crossed": (replaced('lower="-2"', 'lower="3"'), "its lower limit 3 lies above its upper limit 2"),
    "negative velocity": (replaced('lower="-2"', 'velocity="-1"'), "limits must not be negative"),
    "bad damping": (
        plus(link("lamp", mass=1), PAN.replace("</joint>", '<dynamics damping="x"/></joint>')),
        "<dynamics damp",
    ),
    "bad origin": (replaced('origin xyz="0.0 0.0 0.5"', 'origin xyz="0"'), "Expected 3 values for attribute xyz got 0"),
    "lost frame": (plus('<frame name="eye" link="head" xyz="0 0 0" rpy="0 0 0"/>'), "its link 'head' does not exist"),
    "not XML": ("<robot", "is not valid XML"),
    "other XML": ("<sdf/>", "its root element is <sdf>"),
    "xacro": (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
        "is a xacro file; expand it first",
    ),
    "no links": ("<robot/>", "one link must be the base, without a parent, not none"),
    "geometry": (
        plus(link("tag", extra="<visual><geometry><box/></geometry></visual>"), joint("t", "bus", "tag", kind="fixed")),
        "robot.urdf: Missing box attribute: size",
    ),
}


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


def test_the_tutorial(tmp_path):
    """The URDF that docs/own_arm.md prints, through the command that it prints."""
    page = (Path(__file__).parents[2] / "docs" / "own_arm.md").read_text()
    urdf = tmp_path / "courier.urdf"
    urdf.write_text(page.partition("```xml\n")[2].partition("```")[0].replace('effort="20"', 'effort="0"'))
    (tmp_path / "mine").mkdir()
    arguments = ["new", str(tmp_path / "mine"), "--urdf", str(urdf), "--payload-mass", "40", "--json"]
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
    assert set(yaml.safe_load((tmp_path / "mine" / "mine.yaml").read_text())) < set(vars(Scenario()))
    # What the page says of a payload that is believed too heavy.
    for share, outcome in ((1.45, "completed"), (2.0, "diverged")):
        belief = [
            f"payload.nominal.mass={share * 40}",
            f"payload.nominal.inertia=[{', '.join(3 * [str(share * 40 / 6)])}]",
        ]
        log = Rollout(load_scenario(data["scenario"], ["duration=3", *belief])).run()
        assert log.outcome.status == outcome
    again = CliRunner().invoke(main, arguments)
    assert again.exit_code == 2
    assert "is not empty" in again.output


def test_printed(made):
    text = onboarding_text(made("two_arms"))
    for part in (
        "torso, 450 kg of 485 kg",
        "left_tool, 3 joints, reach 2 m",
        "--tip right_tool",
        "ffsm run ",
        "tde_aismc",
    ):
        assert part in text
