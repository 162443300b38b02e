"""A mast of random pose, in each way of writing one: the measured distance is that of own geometry.

FFSM_DRAWS sets the number of drawn files.
"""

import dataclasses
import itertools
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from ffsm_drake.cli import main
from ffsm_drake.plugins.new.urdf.servicer import read_urdf
from ffsm_drake.plugins.new.urdf.writing import write_urdf
from ffsm_drake.runs.exceeded_limits import not_measured
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.clearance import Clearance

DRAWS = int(os.environ.get("FFSM_DRAWS", "9"))
FAR = "0 0 400"  # of the pictures of the links between mast and probe
FACES = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"
BARE = (
    '<robot name="d"><link name="debris"><inertial><mass value="9"/><inertia ixx="5" iyy="5" '
    'izz="5" ixy="0" ixz="0" iyz="0"/></inertial></link><frame name="grasp" link="debris" '
    'xyz="0 0 0" rpy="0 0 0"/></robot>'
)
Pose = tuple[Rotation, np.ndarray]
AXES = np.eye(3)


def told(*values: object) -> str:
    return " ".join(f"{x:.12g}" for x in np.ravel(np.hstack(values)))


def drawn(rng: np.random.Generator, size: float = 1.0) -> Pose:
    turn = Rotation.random(random_state=rng) if rng.random() < 0.8 else Rotation.identity()
    return turn, size * rng.normal(size=3)


def after(first: Pose, second: Pose) -> Pose:
    """first.inverse @ second."""
    return first[0].inv() * second[0], first[0].inv().apply(second[1] - first[1])


def corners_of(half: np.ndarray) -> np.ndarray:
    return np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * half


def box_distance(halves: list[np.ndarray], poses: list[Pose]) -> float:
    """Signed distance of two boxes: by separating axes if they overlap, else by least squares."""
    (A, p), (B, q) = ((turn.as_matrix(), at) for turn, at in poses)
    edges = [np.cross(a, b) for a in A.T for b in B.T]
    axes = np.array([*A.T, *B.T, *(e for e in edges if np.linalg.norm(e) > 1e-9)])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    gaps = abs(axes @ (q - p)) - abs(axes @ A) @ halves[0] - abs(axes @ B) @ halves[1]
    if gaps.max() <= 0.0:
        return float(gaps.max())
    limits = np.concatenate(halves)
    found = lsq_linear(np.hstack([A, -B]), q - p, (-limits, limits), tol=1e-14)
    return float(np.sqrt(2.0 * found.cost))


# --- meshes ------------------------------------------------------------------------------------


def write_mesh(file: Path, vertices: np.ndarray, rng: np.random.Generator) -> None:
    faces = np.array(FACES.split(), int).reshape(-1, 3)
    if file.suffix == ".obj":
        lines = [f"v {told(v)}" for v in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        file.write_text("\n".join(lines))
    elif file.suffix == ".stl":
        record = np.zeros(12, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
        record["corners"] = vertices[faces]
        file.write_bytes(bytes(80) + (12).to_bytes(4, "little") + record.tobytes())
    else:  # vertices under a drawn unit, and drawn nodes
        unit = float(rng.choice([1.0, 0.001, 0.0254]))
        vertices, nodes = vertices / unit, ""
        for _ in range(rng.integers(0, 3)):
            turn, at = drawn(rng)
            scale = rng.uniform(0.5, 2.0, 3)
            vertices = turn.inv().apply(vertices - at) / scale
            angle = np.linalg.norm(turn.as_rotvec())
            axis = turn.as_rotvec() / angle if angle else AXES[0]
            parts = (
                f"<translate>{told(at)}</translate>"
                f"<rotate>{told(axis, np.degrees(angle))}</rotate><scale>{told(scale)}</scale>"
            )
            if rng.random() < 0.5:
                matrix = np.eye(4)
                matrix[:3, :3], matrix[:3, 3] = turn.as_matrix() * scale, at
                parts = f"<matrix>{told(matrix)}</matrix>"
            nodes += f"<node>{parts}"
        text = (
            f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>'
            f'<unit meter="{unit}"/><up_axis>Z_UP</up_axis></asset><library_geometries>'
            f'<geometry id="g"><mesh><source id="p"><float_array id="a" count="24">{told(vertices)}'
            '</float_array><technique_common><accessor source="#a" count="8" stride="3">'
            '<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" '
            'type="float"/></accessor></technique_common></source><vertices id="v"><input '
            'semantic="POSITION" source="#p"/></vertices><triangles count="12"><input '
            f'semantic="VERTEX" source="#v" offset="0"/><p>{FACES}</p></triangles></mesh>'
            '</geometry></library_geometries><library_visual_scenes><visual_scene id="s">'
            f'<node>{nodes}<instance_geometry url="#g"/>{"</node>" * nodes.count("<node>")}</node>'
            '</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/>'
            "</scene></COLLADA>"
        )
        file.write_text(text)


def mesh_of(
    folder: Path,
    rng: np.random.Generator,
    half: np.ndarray,
    kinds: tuple[str, ...],
    own: Pose,
    reference: Pose | None = None,
) -> tuple[str, np.ndarray]:
    """The name of a file with the mast, at a pose in the mesh's axes, and the scale to give it
    after a reference pose has been subtracted.
    """
    scale = rng.choice([1.0, 0.01, 2.0]) * np.ones(3)
    vertices = (own[0].apply(corners_of(half)) + own[1]) / scale
    if reference is not None:
        vertices = reference[0].apply(vertices) + reference[1]
    name = f"mast{rng.choice(kinds)}"
    write_mesh(folder / name, vertices, rng)
    return name, scale


# --- URDF --------------------------------------------------------------------------------------


def urdf(rng: np.random.Generator, folder: Path, half: np.ndarray, mast: Pose, probe: str) -> str:
    shape, place, own = f'<box size="{told(2 * half)}"/>', mast, drawn(rng)
    if rng.random() < 0.7:
        name, scale = mesh_of(folder, rng, half, (".obj", ".stl", ".dae"), own)
        shape = f'<mesh filename="{name}" scale="{told(scale)}"/>'
        turn = mast[0] * own[0].inv()
        place = turn, mast[1] - turn.apply(own[1])
    rpy = told(place[0].as_euler("xyz"))
    tag = rng.choice(["visual", "collision"])
    visual = (
        f'<{tag}><origin xyz="{told(place[1])}" rpy="{rpy}"/><geometry>{shape}</geometry></{tag}>'
    )
    inertia = '<inertia ixx="5" iyy="5" izz="5" ixy="0" ixz="0" iyz="0"/>'
    links = f'<link name="bus"><inertial><mass value="99"/>{inertia}</inertial>{visual}</link>'
    for k in range(1, 5):
        far = f'<origin xyz="{FAR}"/><geometry><sphere radius="0.01"/></geometry>'
        seen = probe if k == 4 else f"<visual>{far}</visual>"
        above = "bus" if k == 1 else f"l{k - 1}"
        links += (
            f'<link name="l{k}"><inertial><mass value="9"/>{inertia}</inertial>{seen}</link>'
            f'<joint name="j{k}" type="revolute"><parent link="{above}"/>'
            f'<child link="l{k}"/><axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="9" '
            'velocity="1"/></joint>'
        )
    return f'<robot name="c">{links}</robot>'


# --- SDFormat ----------------------------------------------------------------------------------


def sdf_pose(rng: np.random.Generator, pose: Pose, relative: str | None = None) -> str:
    turn, at = pose
    where = f' relative_to="{relative}"' if relative else ""
    if rng.random() < 0.3:
        quaternion = told(at, turn.as_quat())
        return f'<pose{where} rotation_format="quat_xyzw">{quaternion}</pose>'
    if rng.random() < 0.5:
        return f'<pose{where} degrees="true">{told(at, np.degrees(turn.as_euler("xyz")))}</pose>'
    return f"<pose{where}>{told(at, turn.as_euler('xyz'))}</pose>"


def sdf(rng: np.random.Generator, folder: Path, half: np.ndarray, mast: Pose, probe: str) -> str:
    """Links turned and moved from each other; the mast relative to one of their frames."""
    inertia = "".join(f"<i{a}>5</i{a}>" for a in ("xx", "yy", "zz"))
    weight = f"<inertial><mass>9</mass><inertia>{inertia}</inertia></inertial>"
    shape, own = f"<box><size>{told(2 * half)}</size></box>", (Rotation.identity(), np.zeros(3))
    if rng.random() < 0.5:
        own = drawn(rng)
        name, scale = mesh_of(folder, rng, half, (".obj", ".stl", ".dae"), own)
        shape = f"<mesh><uri>{name}</uri><scale>{told(scale)}</scale></mesh>"
    turn = mast[0] * own[0].inv()
    place = turn, mast[1] - turn.apply(own[1])  # of the mesh, in the model = the bus
    frame, tag = drawn(rng), rng.choice(["visual", "collision"])
    ways = {"": place, "bus": place, "f": after(frame, place), "l2": place, "j3": place}
    inside, extra = "", ""
    relative = rng.choice(list(ways))
    picture = f"<geometry>{shape}</geometry></{tag}>"
    picture = f'<{tag} name="m">{sdf_pose(rng, ways[relative], relative)}{picture}'
    if rng.random() < 0.35:  # on a part of its own, in another file
        at, merged = drawn(rng), rng.random() < 0.5
        part = f'<{tag} name="m">{sdf_pose(rng, after(at, place))}<geometry>{shape}</geometry>'
        link = f'<link name="part">{weight}{part}</{tag}></link>'
        if merged:
            link = link.replace('name="m"', 'name="p"')
        (folder / "part.sdf").write_text(f'<sdf version="1.9"><model name="p">{link}</model></sdf>')
        child = "part" if merged else "p::part"
        extra = (
            f'<include merge="{str(merged).lower()}"><uri>part.sdf</uri>{sdf_pose(rng, at)}'
            f'</include><joint name="fix" type="fixed"><parent>bus</parent><child>{child}</child>'
            "</joint>"
        )
    else:
        inside = picture
    links = f'<link name="bus">{weight}{inside}</link>'
    far = f"<pose>{FAR} 0 0 0</pose><geometry><sphere><radius>0.01</radius></sphere></geometry>"
    for k in range(1, 5):
        seen = probe if k == 4 else f'<visual name="v">{far}</visual>'
        above = "bus" if k == 1 else f"l{k - 1}"
        links += (
            f'<joint name="j{k}" type="revolute"><pose relative_to="l{k}"/><parent>{above}</parent>'
            f"<child>l{k}</child><axis><xyz>0 0 1</xyz><limit><lower>-1</lower><upper>1</upper>"
            f'<effort>9</effort><velocity>1</velocity></limit></axis></joint><link name="l{k}">'
            f"{weight}{seen}</link>"
        )
    links += f'<frame name="f" attached_to="bus">{sdf_pose(rng, frame)}</frame>{extra}'
    return f'<sdf version="1.9"><model name="c">{links}</model></sdf>'


# --- MJCF --------------------------------------------------------------------------------------


def mjcf(rng: np.random.Generator, folder: Path, half: np.ndarray, mast: Pose, probe: str) -> str:
    degrees, order = rng.random() < 0.5, str(rng.choice(["xyz", "XYZ", "ZYX", "zyx", "XZY"]))
    unit = np.degrees if degrees else np.array

    def turned(turn: Rotation) -> str:
        way = rng.integers(4)
        if way == 0:
            return f'quat="{told(np.roll(turn.as_quat(), 1))}"'
        if way == 1:  # capitals turn about fixed axes, the opposite of scipy's
            return f'euler="{told(unit(turn.as_euler(order.swapcase())))}"'
        if way == 2:
            angle = np.linalg.norm(turn.as_rotvec())
            axis = turn.as_rotvec() / angle if angle else AXES[0]
            return f'axisangle="{told(axis, unit(angle))}"'
        return f'xyaxes="{told(turn.as_matrix()[:, :2].T)}"'

    def at(pose: Pose) -> str:
        return f'pos="{told(pose[1])}" {turned(pose[0])}'

    asset, frame = "", drawn(rng)
    way = rng.integers(4)
    if way == 0:
        geom = f'<geom type="box" size="{told(half)}" {{}}/>'
        own: Pose = Rotation.identity(), np.zeros(3)
    elif way == 1:  # along z
        half[1] = half[0]
        way_out = mast[0].apply(half * AXES[2])
        ends = told(mast[1] - way_out, mast[1] + way_out)
        body = f'<geom type="box" fromto="{ends}" size="{half[0]:.12g}"/>'
    elif way in (2, 3):
        own, reference = drawn(rng), drawn(rng)
        name, scale = mesh_of(folder, rng, half, (".obj", ".stl"), own, reference)
        asset = (
            f'<asset><mesh name="m" file="{name}" scale="{told(scale)}" refpos="'
            f'{told(reference[1])}" refquat="{told(np.roll(reference[0].as_quat(), 1))}"/></asset>'
        )
        geom = '<geom type="mesh" mesh="m" {}/>'
    compiler = f'<compiler angle="{"degree" if degrees else "radian"}" eulerseq="{order}"/>'
    weight = '<inertial pos="0 0 0" mass="9" diaginertia="5 5 5"/>'
    if way != 1:
        turn = mast[0] * own[0].inv()
        place = turn, mast[1] - turn.apply(own[1])
        body = geom.format(at(place))
        if rng.random() < 0.3:
            body = f"<frame {at(frame)}>{geom.format(at(after(frame, place)))}</frame>"
        elif rng.random() < 0.5:  # a part of its own, in another file
            part = f'<body name="part">{weight}{geom.format(at(after(frame, place)))}</body>'
            (folder / "part.xml").write_text(
                f"<mujoco>{compiler}{asset}<worldbody>{part}</worldbody></mujoco>"
            )
            asset = '<asset><model name="q" file="part.xml"/></asset>'
            body = f'<frame {at(frame)}><attach model="q" body="part" prefix="p_"/></frame>'
        elif rng.random() < 0.3:
            (folder / "more.xml").write_text(f"<mujocoinclude>{body}</mujocoinclude>")
            body = '<include file="more.xml"/>'
    group = rng.choice(["", 'class="hidden"'])
    usual = '<default><default class="hidden"><geom group="3"/></default></default>'
    body = body.replace("<geom ", f"<geom {group} ") if "part" not in body else body
    inner = probe
    for k in (3, 2, 1):
        far = f'<geom type="sphere" size="0.01" pos="{FAR}"/>'
        inner = f'<body name="l{k}">{weight}<joint name="j{k}"/>{far}{inner}</body>'
    return (
        f"<mujoco>{compiler}{usual}{asset}<worldbody>"
        f'<body name="bus"><freejoint/>{weight}{body}{inner}</body></worldbody></mujoco>'
    )


def _from_z(way: np.ndarray) -> Rotation:
    """The least turn from z to a direction."""
    way = way / np.linalg.norm(way)
    axis, angle = np.cross(AXES[2], way), np.arccos(np.clip(way[2], -1.0, 1.0))
    size = np.linalg.norm(axis)
    return Rotation.from_rotvec(axis / size * angle if size > 1e-12 else 0.0 * axis)


Writer = Callable[[np.random.Generator, Path, np.ndarray, Pose, str], str]
WRITERS: Mapping[str, tuple[Writer, str]] = {
    "urdf": (
        urdf,
        '<visual><origin xyz="{at}" rpy="{rpy}"/><geometry><box size="{size}"/></geometry>'
        "</visual>",
    ),
    "sdf": (
        sdf,
        '<visual name="v"><pose>{at} {rpy}</pose><geometry><box><size>{size}</size></box>'
        "</geometry></visual>",
    ),
    "xml": (
        mjcf,
        '<body name="l4"><inertial pos="0 0 0" mass="9" diaginertia="5 5 5"/><joint name="j4"/>'
        '<geom type="box" size="{half}" pos="{at}" quat="{quat}"/></body>',
    ),
}


@pytest.mark.parametrize("kind", list(WRITERS))
def test_a_mast_is_where_it_is_written(kind: str, tmp_path: Path) -> None:
    writer, picture = WRITERS[kind]
    rng = np.random.default_rng(int(os.environ.get("FFSM_SEED", "1")))
    wrong = []
    for k in range(DRAWS // len(WRITERS)):
        folder = tmp_path / str(k)
        folder.mkdir()
        halves, poses = (
            list(rng.uniform(0.05, 0.6, (2, 3))),
            [drawn(rng), drawn(rng)],
        )
        turn, at = poses[1]
        probe = picture.format(
            at=told(at), rpy=told(turn.as_euler("xyz")), size=told(2 * halves[1]),
            half=told(halves[1]), quat=told(np.roll(turn.as_quat(), 1)),
        )  # fmt: skip
        file = folder / f"craft.{kind}"
        file.write_text(writer(rng, folder, halves[0], poses[0], probe))
        if "fromto" in file.read_text():
            poses[0] = _from_z(-poses[0][0].apply(AXES[2])), poses[0][1]
        write_urdf(read_urdf(file, tip="l4"), folder / "out", file_name="c.urdf", packages={})
        (folder / "bare.urdf").write_text(BARE)
        model = Model(
            directives=None, servicer=str(folder / "out/c.urdf"), end_effector="servicer::l4",
            debris=str(folder / "bare.urdf"),
        )  # fmt: skip
        clearance = Clearance(model)
        q = np.zeros(clearance.plant.num_positions())
        q[0] = 1.0
        found, right = clearance.nearest(q).distance, box_distance(halves, poses)
        if clearance.unmeasured or abs(found - right) > 1e-5:
            wrong.append((k, found, right, clearance.unmeasured))
    assert not wrong


VISUAL = '<visual><geometry><mesh filename="{}"/></geometry></visual>'


def with_unread(folder: Path, name: str, text: str | None, shape: str) -> Path:
    """A craft with a shape that cannot be measured."""
    if text is not None:
        (folder / name).write_text(text)
    rng = np.random.default_rng(2)
    mast = Rotation.identity(), np.zeros(3)
    (folder / "craft.urdf").write_text(urdf(rng, folder, 0.1 * np.ones(3), mast, shape))
    return folder / "craft.urdf"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("gone.stl", None),
        ("plan.step", "ISO-10303-21;"),
        ("up.dae", "<COLLADA><asset><up_axis>Y_UP</up_axis></asset></COLLADA>"),
        ("line.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        ("plane", None),
    ],
)
def test_what_cannot_be_measured_is_named(name: str, text: str | None, tmp_path: Path) -> None:
    plane = "<visual><geometry><plane/></geometry></visual>"
    file = with_unread(tmp_path, name, text, plane if name == "plane" else VISUAL.format(name))
    write_urdf(read_urdf(file, tip="l4"), tmp_path / "out", file_name="c.urdf", packages={})
    model = Model(
        directives=None, servicer=str(tmp_path / "out/c.urdf"), end_effector="servicer::l4"
    )
    (line,) = not_measured(dataclasses.replace(Scenario(), model=model))
    assert line.startswith(f"clearance cannot be computed: no shape of l4 ({name})")


@pytest.mark.long
def test_a_mission_with_an_unmeasured_shape_is_not_as_planned(tmp_path: Path) -> None:
    file = with_unread(tmp_path, "gone.stl", None, VISUAL.format("gone.stl"))
    found = CliRunner().invoke(main, ["new", str(tmp_path / "mine"), "--model", str(file)])
    assert found.exit_code == 3, found.output
    assert "not expected to go as planned" in found.output
    assert "no shape of l4 (gone.stl) can be measured" in found.output
