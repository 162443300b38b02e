"""MJCF through ``ffsm new``: the mass matrix is MuJoCo's; what cannot be represented is told."""

from pathlib import Path

import numpy as np
import pytest
from mass_matrices import by_drake, by_mujoco

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.target import read_target
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.coordinates import joints_of
from ffsm_drake.spacecraft.plant import make_plant

BUS = '<inertial pos="0 0 0" mass="200" diaginertia="60 50 40"/>'
LINK = '<inertial pos="0 0 0.4" mass="8" diaginertia="0.5 0.5 0.02"/>'
FORE = '<inertial pos="0 0 0.3" mass="5" diaginertia="0.2 0.2 0.01"/>'


def arm(
    *, joint: str = "", bus: str = BUS, link: str = LINK, outside: str = "", base: str = ""
) -> str:
    """A bus with two links: attributes of the first joint, inertias, elements outside, and of the
    bus.
    """
    return f"""<mujoco>{outside}<worldbody><body name="bus"><freejoint/>{bus}{base}
      <body name="upper" pos="0.1 0 0.6" euler="0.2 0 0.1">{link}
        <joint name="shoulder" axis="0 1 0.2" pos="0 0.05 0.1" {joint}/>
        <body name="fore" pos="0 0 0.8">{FORE}<joint name="elbow" axis="0 1 0"/></body>
      </body></body></worldbody></mujoco>"""


# What a file can do to the inertias of a model, one case each.
CASES = {
    "plain": arm(),
    "armature": arm(joint='armature="1"'),
    "armature_of_class": arm(
        outside='<default><joint armature="0.3"/></default>', joint='type="slide"'
    ),
    "armature_of_motor": arm(joint='armature="0.1"').replace(
        "</mujoco>", '<actuator><motor joint="elbow" gear="30"/></actuator></mujoco>'
    ),
    "radian": arm(outside='<compiler angle="radian"/>', joint='range="-2 2"'),
    "degree": arm(joint='range="-90 90"'),
    "eulerseq": arm(outside='<compiler eulerseq="ZYX" angle="radian"/>'),
    "ref": arm(joint='ref="30" range="-90 90"'),
    "inertiafromgeom": arm(
        outside='<compiler inertiafromgeom="true"/>',
        bus='<geom type="box" size="0.4 0.5 0.6" mass="90" euler="10 20 30" pos="0.1 0 0"/>',
        link=LINK + '<geom type="capsule" fromto="0 0 0 0.1 0.2 0.8" size="0.04"/>',
    ).replace(FORE, '<geom type="cylinder" size="0.03 0.3" pos="0 0 0.3" density="500"/>'),
    "balanceinertia": arm(
        outside='<compiler balanceinertia="true"/>',
        link='<inertial pos="0 0 0.4" mass="8" diaginertia="0.1 0.1 0.5"/>',
    ),
    "bounds": arm(outside='<compiler boundmass="9" boundinertia="0.3"/>'),
    "settotalmass": arm(outside='<compiler settotalmass="100"/>'),
    "fullinertia": arm(
        link='<inertial pos="0 0 0.4" mass="8" fullinertia="0.5 0.4 0.3 0.02 -0.03 0.01"/>'
    ),
    "turned": arm(
        link='<inertial pos="0.1 0 0.4" euler="20 30 40" mass="8" diaginertia="0.5 0.4 0.2"/>'
    ),
    "joints_in_a_row": arm().replace(
        '<joint name="elbow" axis="0 1 0"/>',
        '<joint name="a" axis="0 1 0" pos="0 0 -0.1"/><joint name="b" type="slide"/>'
        '<joint name="elbow" axis="1 0 0" pos="0.1 0 0"/>',
    ),
    "fused": arm(
        outside='<compiler fusestatic="true"/>',
        base='<body name="box" pos="0 0 1"><geom type="box" size="0.1 0.1 0.1" mass="3"/></body>',
    ),
    "welded": arm(base='<body pos="0 1 1" euler="40 0 0"><geom size="0.1" mass="3"/></body>'),
    "fingers": arm(base='<site name="dock"/>').replace(
        "</worldbody>",
        "</worldbody><option timestep='0.01' cone='elliptic' gravity='0 0 -3'/>"
        "<sensor><gyro site='dock'/></sensor><keyframe><key name='home'/></keyframe>",
    ),
}


def made(text: str, folder: Path) -> tuple[Path, tuple[str, ...]]:
    """The URDF that is written for an MJCF text, and the remarks."""
    file = folder / "model.xml"
    file.write_text(text)
    servicer = read_urdf(file)
    write_urdf(servicer, folder, file_name="model.urdf", packages={})
    return folder / "model.urdf", servicer.remarks


def assert_same_mass(text: str, urdf: Path, held: dict[str, float] | None = None) -> None:
    """H of an MJCF text and of its URDF agree in a configuration. ``held``: see ``by_mujoco``."""
    directives, rng = urdf.with_name("model.dmd.yaml"), np.random.default_rng(0)
    directives.write_text(
        "directives:\n- add_model: {name: servicer, file: package://own/model.urdf}\n"
    )
    model = Model(
        directives=str(directives), packages={"own": str(urdf.parent)}, end_effector="servicer::bus"
    )
    plant, turned = make_plant(model), rng.normal(size=4)
    turned /= np.linalg.norm(turned)
    joints = {joint.name(): rng.uniform(-1.0, 1.0) for joint in joints_of(plant)}
    expected = by_mujoco(text, joints, turned=turned, held=held)
    found = by_drake(plant, joints, turned=turned)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-11 * expected.max())


@pytest.mark.smoke
@pytest.mark.parametrize("case", CASES)
def test_mass_matrix_is_mujocos(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log
    urdf, _ = made(CASES[case], tmp_path)
    assert not Path("MUJOCO_LOG.TXT").exists()
    assert_same_mass(CASES[case], urdf)


def test_without_effect_is_listed_in_one_line(tmp_path: Path) -> None:
    more = """<camera name="c"/><light name="a"/><light name="b"/><body name="m" mocap="true"/>
        <body name="n" mocap="true"><site name="goal"/></body></worldbody>
        <actuator><motor joint="elbow"/></actuator>"""
    _, remarks = made(CASES["fingers"].replace("</worldbody>", more), tmp_path)
    (line,) = [remark for remark in remarks if "passed over" in remark]
    for part in ("cone", "gravity", "timestep", "1 sensor", "1 keyframe", "1 camera", "2 lights",
                 "2 mocap bodies", "1 actuator (but for their limits)"):  # fmt: skip
        assert part in line


def test_effort_and_range(tmp_path: Path) -> None:
    text = arm(joint='range="-60 90" ref="30"').replace(
        "</mujoco>",
        '<actuator><motor joint="shoulder" gear="20" ctrlrange="-2 2"/>'
        '<general joint="elbow" forcerange="-7 7"/></actuator></mujoco>',
    )
    file = tmp_path / "model.xml"
    file.write_text(text)
    shoulder, elbow = read_urdf(file).joints
    assert (shoulder.effort, elbow.effort) == (40.0, 7.0)
    assert np.rad2deg([shoulder.lower, shoulder.upper]) == pytest.approx([-90.0, 60.0])
    assert elbow.kind == "continuous"


def test_all_that_cannot_be_represented_is_told_at_once(tmp_path: Path) -> None:
    text = arm(joint='stiffness="3"').replace("<freejoint/>", '<joint type="free" armature="1"/>')
    text = text.replace('axis="0 1 0"', 'type="ball"').replace(
        "</mujoco>", '<equality><weld body1="fore"/></equality></mujoco>'
    )
    with pytest.raises(ModelError) as error:
        made(text, tmp_path)
    for fault in ("ball joint", "springs at joints shoulder", "equality", "free joint"):
        assert fault in str(error.value)


@pytest.mark.parametrize("seed", range(6))
def test_followers_are_fixed_where_their_leader_rests(seed: int, tmp_path: Path) -> None:
    """Drives of fingers add an armature, which one that is fixed does not turn any more."""
    rng = np.random.default_rng(seed)
    armature = "" if seed == 0 else f'armature="{rng.uniform(0.01, 0.3)}"'
    slope, offset = (-1.0, 0.0) if seed == 0 else (rng.uniform(-2, 2), rng.uniform(-0.01, 0.01))
    fingers = "".join(
        f'<body name="{name}" pos="0 {y} 0.6"><inertial pos="0 0 0.02" mass="0.1" '
        f'diaginertia="1e-4 1e-4 1e-5"/><joint name="{name}_slide" type="slide" axis="0 1 0" '
        f'range="0 0.04" {armature}/></body>'
        for name, y in (("left", 0.05), ("right", -0.05))
    )
    text = arm().replace('<joint name="elbow" axis="0 1 0"/>', f'<joint name="elbow"/>{fingers}')
    text = text.replace(
        "</mujoco>",
        '<equality><joint joint1="right_slide" joint2="left_slide" '
        f'polycoef="{offset} {slope} 0 0 0"/></equality></mujoco>',
    )
    urdf, _ = made(text, tmp_path)
    servicer = read_urdf(tmp_path / "model.xml")
    assert [joint.name for joint in servicer.joints] == ["shoulder", "elbow", "left_slide"]
    held = {"right_slide": offset + slope * servicer.joints[2].rest}
    assert_same_mass(text, urdf, held)
    assert servicer.tip.frame == "fore"
    assert any("right_slide (follows left_slide)" in remark for remark in servicer.remarks)


def test_target_and_free_bodies(tmp_path: Path) -> None:
    text = arm().replace(
        "</worldbody>",
        '<body name="client"><freejoint/><geom size="0.3" mass="20"/></body>'
        '<body name="wall"><geom type="box" size="1 1 1"/></body></worldbody>',
    )
    _, remarks = made(text, tmp_path)
    told = " ".join(remarks)
    assert "client" in told
    assert "bodies fixed to the world (wall)" in told


def test_missing_pictures_are_left_out(tmp_path: Path) -> None:
    """A mesh that gives a body its mass is another matter."""
    outside = (
        '<asset><texture name="t" type="2d" file="t.png"/><material name="m" texture="t"/>'
        '<mesh name="named" file="a.stl"/><mesh file="b.stl"/></asset>'
    )
    shapes = '<geom type="mesh" mesh="named" material="m"/><geom type="mesh" mesh="b"/>'
    text = arm(outside=outside, link=LINK + shapes)
    urdf, remarks = made(text, tmp_path)
    assert "missing files (a.stl, b.stl, t.png)" in " ".join(remarks)
    assert_same_mass(arm(), urdf)
    with pytest.raises(ModelError, match=r"MuJoCo cannot compile it: .*a\.stl"):
        made(arm(outside=outside, link=shapes), tmp_path)


def test_every_named_site_can_be_the_tip(tmp_path: Path) -> None:
    sites = '<site name="tool" pos="0 0 0.6"/><site name="camera" pos="0.1 0 0.2"/><site/>'
    text = arm().replace('<joint name="elbow"', f'{sites}<joint name="elbow"')
    made(text, tmp_path)
    for name in ("tool", "camera"):
        assert read_urdf(tmp_path / "model.xml", tip=name).tip.frame == name
    assert read_urdf(tmp_path / "model.xml").tip.frame == "tool"
    with pytest.raises(ModelError, match="one of upper, shoulder_axis, fore, tool, camera"):
        read_urdf(tmp_path / "model.xml", tip="site_2")


def test_advice_on_a_target_is_that_of_its_format(tmp_path: Path) -> None:
    ports = '<site name="a" pos="0 0 -0.5"/><site name="b" pos="0 0 0.5"/>'
    text = (
        '<mujoco><worldbody><body name="stage"><freejoint/><geom type="box" size="1 1 1" '
        f'mass="30"/>{ports}</body></worldbody></mujoco>'
    )
    file = tmp_path / "target.xml"
    file.write_text(text)
    with pytest.raises(ModelError) as error:
        read_target(file)
    assert '2 frames (a, b) where it could be held; name one <site name="grasp"' in str(error.value)
    file.write_text(text.replace('name="a"', 'name="grasp"'))
    assert read_target(file).grasp == "grasp"


def test_an_armature_that_is_no_number_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="an armature is no finite number; give one of 0 or more"):
        made(arm(joint='armature="nan"'), tmp_path)
