"""Reading a user's URDF, what is refused, and the copy that Drake loads."""

import re
import shutil

import numpy as np
import pytest
from outside_urdfs import BOX, OUTSIDE, TURN, gripper, joint, link, simple_arm, two_armed
from pydrake.geometry import Role
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.scenario import Model
from ffsm_drake.spacecraft.plant import add_combined_plant


def read(folder, text, **options):
    urdf = folder / "robot.urdf"
    urdf.write_text(text)
    return read_urdf(urdf, **options)


@pytest.mark.smoke
def test_tips_masses_and_reach(tmp_path):
    six, arms, hand, seven = (
        read(tmp_path, OUTSIDE[name]())
        for name in ("six_joints", "two_armed", "gripper", "seven_joints")
    )
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
    urdf.write_text(two_armed())
    assert read_urdf(urdf, tip="right_elbow_link").tip.joints == ("right_shoulder", "right_elbow")
    with pytest.raises(
        ModelError, match="no link or frame 'nose' for the tip; choose one of right_shoulder_link, "
    ):
        read_urdf(urdf, tip="nose")
    with pytest.raises(ModelError, match="tip 'torso' does not move"):
        read_urdf(urdf, tip="torso")


def test_what_is_left_out_is_said(tmp_path):
    six, hand, arms = (
        write_urdf(
            read(tmp_path, OUTSIDE[name]()), tmp_path / name, file_name="copy.urdf", packages={}
        )
        for name in ("six_joints", "gripper", "two_armed")
    )
    for text in (
        "damping and friction",
        "<transmission> (6 times)",
        "<gazebo>",
        "package://nowhere/a.stl",
        "contact",
    ):
        assert text in " ".join(six)
    assert "mimic" not in " ".join(hand)
    (told,) = arms
    assert told.startswith("links without a picture drawn as plain bodies: torso, ")
    assert told.endswith("and 3 more (not counted for clearances: torso)")


@pytest.mark.parametrize("name", OUTSIDE)
def test_plain_bodies_touch_at_every_joint(tmp_path, name):
    """A joint's origin lies within what is drawn of its parent and of its child, whatever the
    posture.
    """
    write_urdf(read(tmp_path, OUTSIDE[name]()), tmp_path, file_name="copy.urdf", packages={})
    # distances need collision shapes
    solid = re.sub(r"(</?)visual\b", r"\1collision", (tmp_path / "copy.urdf").read_text())
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    Parser(plant).AddModelsFromString(solid, "urdf")
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    moving = [
        each for each in map(plant.get_joint, plant.GetJointIndices()) if each.num_velocities() == 1
    ]
    for share in (0.0, 0.37, 1.0):
        q = plant.GetPositions(plant_context)
        for each in moving:
            low, high = np.clip(
                [each.position_lower_limits()[0], each.position_upper_limits()[0]], -3.0, 3.0
            )
            q[each.position_start()] = low + share * (high - low)
        plant.SetPositions(plant_context, q)
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        for each in moving:
            origin = each.frame_on_parent().CalcPoseInWorld(plant_context).translation()
            near = [n for n in query.ComputeSignedDistanceToPoint(origin, 1.0) if n.distance < 1e-6]
            reached = {
                plant.GetBodyFromFrameId(query.inspector().GetFrameId(n.id_G)).index() for n in near
            }
            for side in (each.parent_body(), each.child_body()):
                assert reached & {body.index() for body in plant.GetBodiesWeldedTo(side)}, (
                    each.name(),
                    share,
                )


def mesh(file):
    return f'<visual><geometry><mesh filename="{file}"/></geometry></visual>'


def test_meshes_come_along(tmp_path):
    """Drawable meshes with what they need, found by package address or path; the author's header
    stays.
    """
    package = tmp_path / "my_package"
    shape = "mtllib hull.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"
    files = {
        "meshes/hull.obj": shape,
        "meshes/hull.mtl": "newmtl a\nKd 1 0 0\nmap_Kd -s 1 1 1 skin.png\n",
        "meshes/skin.png": "",
        "meshes/other.png": "",
        "meshes/hand.stl": "solid\nendsolid\n",
        "more/hull.obj": shape.replace("hull.mtl", "my paint.mtl"),
        "more/my paint.mtl": "newmtl a\nmap_Kd ../../../secret.png\n",
        "../secret.png": "",
    }
    for name, content in files.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(content)
    text = (
        gripper()
        .replace("</link>", mesh("package://my_package/meshes/hull.obj") + "</link>", 1)
        .replace('<link name="hand">', '<link name="hand">' + mesh("../meshes/hand.stl"))
        .replace(
            '<link name="upper">', '<link name="upper">' + mesh(f"file://{package}/more/hull.obj")
        )
        .replace("<robot", "<!-- By its author. -->\n<robot")
    )
    urdf = package / "urdf" / "gripper.urdf"
    urdf.parent.mkdir()
    urdf.write_text(text)
    out = tmp_path / "out"
    remarks = write_urdf(read_urdf(urdf), out, file_name="gripper.urdf", packages={})
    copied = {str(path.relative_to(out)) for path in out.rglob("*.*")}
    assert copied == {
        "gripper.urdf",
        "meshes/1/hull.obj",
        "meshes/1/hull.mtl",
        "meshes/1/skin.png",
        "meshes/2/hull.obj",
        "meshes/2/my paint.mtl",
    }
    assert any("hand.stl" in remark for remark in remarks)
    assert "<!-- By its author. -->" in (out / "gripper.urdf").read_text()
    assert str(tmp_path) not in (out / "gripper.urdf").read_text()
    shutil.rmtree(package)
    model = Model(
        directives=None, servicer=str(out / "gripper.urdf"), end_effector="servicer::hand"
    )
    add_combined_plant(DiagramBuilder(), model)

    # Elsewhere, only an option can say where the package is.
    urdf = tmp_path / "gripper.urdf"
    urdf.write_text(text)
    remarks = write_urdf(read_urdf(urdf), tmp_path / "lost", file_name="gripper.urdf", packages={})
    (lost,) = [remark for remark in remarks if "not found" in remark]
    assert "package://my_package/meshes/hull.obj, hull.obj" in lost
    assert str(tmp_path) not in lost
    (out / "meshes" / "1").rename(out / "meshes" / "meshes")
    remarks = write_urdf(
        read_urdf(urdf),
        tmp_path / "found",
        file_name="gripper.urdf",
        packages={"my_package": out / "meshes"},
    )
    assert (tmp_path / "found" / "meshes" / "1" / "hull.obj").read_text() == shape


def test_colors(tmp_path):
    """The first definition of a name holds; what has no colour, and textures, go; unnamed colours
    stay apart.
    """

    def visual(material):
        return f'<visual><geometry><sphere radius="0.1"/></geometry>{material}</visual>'

    red, blue = '<color rgba="1 0 0 1"/>', '<color rgba="0 0 1 1"/>'
    materials = (
        f'<material name="hull">{red}</material>',
        f'<material name="hull">{blue}</material>',
        '<material name="hull"/>',
        '<material name="nowhere"/>',
        '<material name="photo"><texture filename="photo.png"/></material>',
        f"<material>{red}</material>",
        f"<material>{blue}</material>",
    )
    text = simple_arm().replace(
        '<link name="upper">', '<link name="upper">' + "".join(map(visual, materials))
    )
    collision = visual('<material name="nowhere"/>').replace("visual", "collision")
    text = text.replace('<link name="fore">', f'<link name="fore">{collision}')
    text = text.replace("</robot>", '<material name="nowhere else"/></robot>')
    write_urdf(read(tmp_path, text), tmp_path, file_name="copy.urdf", packages={})
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    parser = Parser(plant)
    parser.SetStrictParsing()
    parser.AddModels(str(tmp_path / "copy.urdf"))
    inspector = scene_graph.model_inspector()
    shapes = inspector.GetGeometries(
        plant.GetBodyFrameIdOrThrow(plant.GetBodyByName("upper").index()), Role.kIllustration
    )
    colors = [
        properties.GetProperty("phong", "diffuse").rgba.tolist()
        if properties.HasProperty("phong", "diffuse")
        else None
        for properties in (inspector.GetIllustrationProperties(shape) for shape in shapes)
    ]
    red, blue = [1, 0, 0, 1], [0, 0, 1, 1]
    assert colors == [red, red, red, None, None, red, blue]


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
        "or remove joint 'root' and 'world'",
    ),
    "no moving joint": (replaced(FIRST, 'type="fixed"'), "has no joint that moves"),
    "planar": (
        replaced(FIRST, 'type="planar"', 1),
        "joint 'shoulder' must be revolute, continuous, prismatic or fixed, not 'planar'; replace "
        "it with single joints",
    ),
    "unknown kind": (
        replaced(FIRST, 'type="hinge"', 1),
        "joint 'shoulder' must be revolute, continuous, prismatic or fixed, not 'hinge'",
    ),
    "massless base": (
        replaced(link("bus", **BOX), link("bus")),
        "the base 'bus' has no mass; give it an <inertial>",
    ),
    "massless moving link": (
        plus(link("lamp"), PAN),
        "link 'lamp' moves but has no mass, and carries none",
    ),
    "inertia without mass": (
        replaced('mass value="300.0"', 'mass value="0"'),
        "link 'bus': has inertia but no mass",
    ),
    "negative mass": (
        replaced('mass value="10.0"', 'mass value="-1"'),
        "link 'upper': mass -1 kg must be positive",
    ),
    "impossible inertia": (
        replaced('izz="90.0"', 'izz="900.0"'),
        "no body has the principal moments 120, 120, 900",
    ),
    "two roots": (plus(link("lost", mass=1)), "not 2 (bus, lost)"),
    "loop": (
        plus(link("a"), link("b"), joint("p", "a", "b"), joint("q", "b", "a")),
        "link 'a' is not connected to the base 'bus'",
    ),
    "two parents": (plus(joint("again", "bus", "fore")), "link 'fore' is the child of 2 joints"),
    "missing link": (
        replaced('child link="fore"', 'child link="hand"'),
        "its child link 'hand' does not exist",
    ),
    "repeated joint": (
        replaced('"elbow"', '"shoulder"'),
        "more than one joint is called 'shoulder'",
    ),
    "repeated link": (plus(link("fore")), "more than one link is called 'fore'"),
    "reserved name": (replaced('"elbow"', '"joints"'), "joint 'joints': the name clashes"),
    "bad number": (
        replaced('lower="-2"', 'lower="low"'),
        "joint 'shoulder': <limit lower> must be a number, not 'low'",
    ),
    "limits crossed": (
        replaced('lower="-2"', 'lower="3"'),
        "its lower limit 3 lies above its upper limit 2",
    ),
    "negative velocity": (replaced('lower="-2"', 'velocity="-1"'), "limits must not be negative"),
    "bad damping": (
        plus(link("lamp", mass=1), PAN.replace("</joint>", '<dynamics damping="x"/></joint>')),
        "<dynamics damp",
    ),
    "bad origin": (
        replaced('origin xyz="0.0 0.0 0.5"', 'origin xyz="0"'),
        "link 'upper': <origin xyz> must be 3 numbers",
    ),
    "lost frame": (
        plus('<frame name="eye" link="head" xyz="0 0 0" rpy="0 0 0"/>'),
        "its link 'head' does not exist",
    ),
    "not XML": ("<robot", "is not valid XML"),
    "other XML": ("<html/>", "its root element is <html>"),
    "xacro": (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>',
        "cannot be expanded: ",
    ),
    "no links": ("<robot/>", "one link must be the base, without a parent, not none"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_one_line(tmp_path, case):
    text, told = REFUSED[case]
    with pytest.raises(ModelError) as refusal:
        write_urdf(read(tmp_path, text), tmp_path, file_name="copy.urdf", packages={})
    assert told in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert [path.name for path in tmp_path.iterdir()] == ["robot.urdf"]
