"""SDFormat and xacro through ``ffsm new``."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mass_matrices import by_drake, plant_of

from ffsm_drake.cli import main
from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.servicer import Servicer, read_urdf
from ffsm_drake.plugins.new.urdf.target import read_target
from ffsm_drake.plugins.new.urdf.writing import write_urdf

SDF = """<sdf version="1.9"><model name="craft">{extra}
  <link name="bus"><inertial><mass>200</mass><inertia><ixx>60</ixx><iyy>50</iyy><izz>40</izz>
    </inertia></inertial>{bus}</link>
  <link name="upper"><pose>0.1 0 0.6 0.2 0 0.1</pose><inertial><pose>0 0.1 0.4 0.3 0 0</pose>
    <mass>8</mass><inertia><ixx>0.5</ixx><iyy>0.4</iyy><izz>0.2</izz><ixy>0.05</ixy></inertia>
    </inertial></link>
  <link name="fore"><pose relative_to="upper">0 0 0.8 0 0 0</pose><inertial><mass>5</mass><inertia>
    <ixx>0.2</ixx><iyy>0.2</iyy><izz>0.01</izz></inertia></inertial></link>
  <frame name="tool" attached_to="fore"><pose>0 0 0.5 0 0 0</pose></frame>
  <joint name="shoulder" type="revolute"><pose>0 0.05 -0.1 0 0.3 0</pose><parent>bus</parent>
    <child>upper</child><axis><xyz>0 1 0</xyz>{limit}</axis></joint>
  <joint name="boom" type="prismatic"><parent>upper</parent><child>fore</child><axis>
    <xyz expressed_in="bus">0 0 1</xyz><limit><lower>0</lower><upper>0.4</upper></limit></axis>
  </joint></model></sdf>"""
LIMIT = "<limit><lower>-2</lower><upper>1</upper><effort>80</effort></limit>"


def read(text: str, folder: Path) -> Servicer:
    file = folder / "craft.sdf"
    file.write_text(text)
    return read_urdf(file)


def sdf(extra: str = "", bus: str = "", limit: str = LIMIT) -> str:
    return SDF.format(extra=extra, bus=bus, limit=limit)


@pytest.mark.smoke
@pytest.mark.parametrize(
    "text",
    [sdf(), sdf(limit='<limit><effort>9</effort></limit><drake:rotor_inertia '
                'xmlns:drake="drake.mit.edu">0.4</drake:rotor_inertia>')],
)  # fmt: skip
def test_mass_matrix_of_sdformat_is_drakes(text: str, tmp_path: Path) -> None:
    servicer = read(text, tmp_path)
    assert servicer.tip.frame == "tool"
    write_urdf(servicer, tmp_path, file_name="craft.urdf", packages={})
    expected, found = (
        by_drake(plant_of(tmp_path / f"craft.{kind}"), {"boom": 0.2, "shoulder": 0.6})
        for kind in ("sdf", "urdf")
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_limits_and_what_is_passed_over(tmp_path: Path) -> None:
    sensor = '<sensor name="imu" type="imu"/><visual name="v"><geometry><box><size>1 1 1</size>'
    servicer = read(
        sdf('<plugin name="p" filename="f"/>', f"{sensor}</box></geometry></visual>"), tmp_path
    )
    shoulder, boom = servicer.joints
    assert (shoulder.lower, shoulder.upper, shoulder.effort) == (-2.0, 1.0, 80.0)
    assert (boom.lower, boom.upper) == (0.0, 0.4)
    assert servicer.remarks == (
        "passed over, of no effect in free flight: <plugin> (1 time), <sensor> (1 time)",
    )
    assert servicer.root.find("link[@name='bus']/visual/geometry/box") is not None


@pytest.mark.parametrize(("slope", "offset", "zero"), [(-1.0, 0.0, 0.0), (2.0, 0.1, 0.3)])
def test_a_finger_that_follows(slope: float, offset: float, zero: float, tmp_path: Path) -> None:
    """It is fixed at its leader's rest: slope (rest - zero) + offset."""
    mass = """<inertial><mass>0.1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz>
        </inertia></inertial>"""
    pose = '<pose relative_to="fore">0 0.1 0.5 0 0 0</pose>'
    range_ = "<limit><lower>0.2</lower><upper>0.7</upper></limit>"
    extra = "".join(
        f"""<link name="{name}">{pose}{mass}</link><joint name="{name}_slide" type="prismatic">
        <parent>fore</parent><child>{name}</child><axis><xyz>0 1 0</xyz>{more}</axis></joint>"""
        for name, more in (
            ("left", range_),
            (
                "right",
                f"""{range_}<mimic joint="left_slide" axis="axis"><multiplier>{slope}</multiplier>
                <offset>{offset}</offset><reference>{zero}</reference></mimic>""",
            ),
        )
    )
    servicer = read(sdf(extra), tmp_path)
    assert "joints that follow others are fixed: right_slide (follows left_slide)" in " ".join(
        servicer.remarks
    )
    joint = servicer.root.find("joint[@name='right_slide']")
    assert joint.get("type") == "fixed"
    place = np.array(joint.find("origin").get("xyz").split(), dtype=float)
    rest = next(each.rest for each in servicer.joints if each.name == "left_slide")
    assert rest > 0.2
    np.testing.assert_allclose(place, [0.0, 0.1 + slope * (rest - zero) + offset, 0.5], atol=1e-9)
    with pytest.raises(ModelError, match="multiplier"):
        read(sdf(extra).replace(f"<multiplier>{slope}", "<multiplier>two"), tmp_path)


def test_all_faults_of_an_sdformat_file(tmp_path: Path) -> None:
    text = sdf().replace("<izz>0.2</izz>", "<izz>2</izz>").replace("<izz>0.01<", "<izz>4<")
    with pytest.raises(ModelError) as error:
        read(text, tmp_path)
    for name in ("upper", "fore"):
        assert f"link '{name}': no body has the principal moments" in str(error.value)
    spring = "<dynamics><spring_stiffness>3</spring_stiffness></dynamics>"
    with pytest.raises(ModelError, match="1 spring at joints"):
        read(sdf(limit=spring), tmp_path)


def test_bodies_beside_the_servicer(tmp_path: Path) -> None:
    world = sdf().replace('<sdf version="1.9">', '<sdf version="1.9"><world name="w">')
    other = '<model name="client"><link name="bus"/></model>'
    rock = '<model name="rock"><static>true</static><link name="rock"/></model>'
    servicer = read(world.replace("</sdf>", f"{other}{rock}</world></sdf>"), tmp_path)
    assert servicer.base == "craft_bus"
    assert any("client_bus, rock" in remark for remark in servicer.remarks)
    standing = '<joint name="f" type="fixed"><parent>world</parent><child>bus</child></joint>'
    with pytest.raises(ModelError, match="attached to the world"):
        read(sdf(standing), tmp_path)


XACRO = """<robot name="craft" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="mass" default="100"/>
  <xacro:include filename="$(find parts)/link.xacro"/>
  <xacro:body name="bus" mass="$(arg mass)"/><xacro:body name="arm" mass="5"/>
  <joint name="j" type="revolute"><parent link="bus"/><child link="arm"/><origin xyz="0 0 ${1/2}"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="10" velocity="1"/></joint>
</robot>"""
MACRO = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="body"
  params="name mass"><link name="${name}"><inertial><mass value="${mass}"/><inertia ixx="${mass/9}"
  iyy="${mass/9}" izz="${mass/9}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  </xacro:macro></robot>"""


@pytest.mark.long
@pytest.mark.parametrize("folder", ["above", "given"])
def test_xacro_with_arguments_and_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    file = tmp_path / "craft/craft.urdf.xacro"
    parts = tmp_path / ("parts" if folder == "above" else "elsewhere")
    for each in (file.parent, parts):
        each.mkdir()
    file.write_text(XACRO)
    (parts / "link.xacro").write_text(MACRO)
    (parts / "package.xml").write_text("<package/>")
    monkeypatch.chdir(tmp_path)
    words = ["new", "out", "--model", str(file), "--xacro-arg", "mass=300", "--json"]
    if folder == "given":
        missing = CliRunner().invoke(main, words)
        assert missing.exit_code == 2
        assert "--package parts=FOLDER" in missing.output
        words += ["--package", f"parts={parts.relative_to(tmp_path)}"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, result.output
    assert '"mass": 300.0' in result.output
    assert Path("out/craft.urdf").is_file()


def test_one_message_names_every_missing_argument(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for _ in range(8):
        names = [f"a{k}" for k in range(rng.integers(2, 9))]
        given, default, included = (rng.random(len(names)) < p for p in (0.25, 0.25, 0.3))
        parts = {True: "", False: ""}  # in the included file, in the file itself
        for k, name in enumerate(names):
            if default[k]:
                parts[False] += f'<xacro:arg name="{name}" default="1"/>'
            used = (
                f'<xacro:property name="p{k}" value="$(arg {name})"/><link name="l${{p{k}}}"/>',
                f"<xacro:if value=\"${{'$(arg {name})' == 'x'}}\"><link name=\"n{k}\"/></xacro:if>",
                f'<link name="m$(arg {name})"/>',
            )[rng.integers(3)]
            parts[bool(included[k])] += used
        undefined = bool(rng.random() < 0.5)
        parts[False] += '<xacro:include filename="more.xacro"/>' + "${nothing}" * undefined
        for file, text in (("more", parts[True]), ("craft", parts[False])):
            (tmp_path / f"{file}.xacro").write_text(
                f'<robot name="c" xmlns:xacro="http://www.ros.org/wiki/xacro">{text}</robot>'
            )
        arguments = {name: "2" for name, is_given in zip(names, given, strict=True) if is_given}
        missing = {name for k, name in enumerate(names) if not (given[k] or default[k])}
        if not missing:
            continue
        with pytest.raises(ModelError) as caught:
            read_urdf(tmp_path / "craft.xacro", arguments=arguments)
        told = str(caught.value)
        assert set(re.findall(r"--xacro-arg (\w+)=", told)) == missing, told
        assert ("name 'nothing' is not defined" in told) == undefined, told


def test_a_target_in_mjcf(tmp_path: Path) -> None:
    file = tmp_path / "client.xml"
    file.write_text(
        '<mujoco><worldbody><body name="client"><freejoint/><geom type="box" size="0.3 0.3 0.3" '
        'mass="30"/><body name="panel" pos="0 1 0"><geom type="box" size="0.4 0.4 0.01" mass="3"/>'
        '<site name="panel_tip" pos="0 0.4 0"/></body><site name="grasp" pos="0 0 -0.3"/></body>'
        "</worldbody></mujoco>"
    )
    target = read_target(file)
    assert (target.body, target.grasp, target.mass) == ("client", "grasp", 33.0)
    assert target.center_of_mass == pytest.approx((0.0, 3.0 / 33.0, 0.0))


def test_what_to_install_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xacro", None)
    (tmp_path / "craft.xml").write_text('<robot><xacro:a xmlns:xacro="x/xacro"/></robot>')
    with pytest.raises(ModelError, match=re.escape("pip install 'ffsm-drake[xacro]'")):
        read_urdf(tmp_path / "craft.xml")
