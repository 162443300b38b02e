"""Reading a URDF as a target: one rigid body with mass, and the frame where it is held."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.numbers import counted
from ffsm_drake.plugins.design.rounding import rounded
from ffsm_drake.plugins.new.urdf.elements import end_of, listed, name_of, origin_of
from ffsm_drake.plugins.new.urdf.formats import read_model
from ffsm_drake.plugins.new.urdf.formats.building import add_frame, add_link, add_visual, text
from ffsm_drake.plugins.new.urdf.servicer import Servicer
from ffsm_drake.spacecraft.checked_urdf import Faults, require
from ffsm_drake.spacecraft.inertia import SIX, read_inertia, read_mass, without_rounding

GRASP, SECOND = "grasp", "grasp_2"
# A frame where a target is held, by the suffix of its file: a URDF's, and others.
_FRAME = '<frame name="{name}" link="{body}" xyz="0 0 -0.5" rpy="0 0 0"/>'
_ADDED = {
    ".xml": '<site name="{name}" pos="0 0 -0.5"/>',
    ".sdf": '<frame name="{name}" attached_to="{body}"><pose>0 0 -0.5 0 0 0</pose></frame>',
}
_DENSITY, _MOST_DENSE = 100.0, 1000.0  # kg/m^3, of a cube whose side is not given


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """A URDF read as a target."""

    source: Path
    body: str
    grasp: str  # frame
    second: str | None = None  # frame of a second hand
    mass: float  # kg
    center_of_mass: tuple[float, ...]  # m, in the body's frame
    inertia: tuple[float, ...]  # kg m^2 about it: Ixx, Iyy, Izz, Ixy, Ixz, Iyz, in the body's axes
    root: Element  # the parsed file
    header: str  # the comments before its root element
    remarks: tuple[str, ...] = ()
    side: float | None = None  # m, of a cube

    @property
    def base_links(self) -> tuple[str, ...]:
        return (self.body,)

    @property
    def reach(self) -> float:
        return 0.0


def cube(mass: float | None, side: float | None, servicer: Servicer, *, share: float) -> Target:
    """Return a solid cube, held at the middle of a face.

    Args:
      mass: kg; None: a ``share`` of the mass of the base.
      side: m; None: from a density of 100 kg/m^3, at most the reach of the arm. If the mass is not
        given, the density is at most 1000 kg/m^3.
      servicer: servicer that holds the cube.
    """
    chosen = rounded(share * servicer.base_mass) if mass is None else mass
    if side is None:
        side = rounded(min((chosen / _DENSITY) ** (1.0 / 3.0), servicer.reach or np.inf))
        if mass is None:
            chosen = min(chosen, rounded(_MOST_DENSE * side**3))
    inertia, root = rounded(chosen * side * side / 6.0), Element("robot", name="target")
    link = add_link(root, "debris", chosen, (0, 0, 0), inertia * np.eye(3))
    add_visual(link, "box", RigidTransform(), None, size=text(3 * (side,)))
    add_frame(root, GRASP, "debris", RigidTransform([0.0, 0.0, -side / 2]))
    return Target(
        source=Path("cube.urdf"), body="debris", grasp=GRASP, mass=chosen,
        center_of_mass=(0.0, 0.0, 0.0), inertia=3 * (inertia,), root=root, header="", side=side,
    )  # fmt: skip


def read_target(
    path: Path, packages: Mapping[str, Path] | None = None, *, trust: bool = False
) -> Target:
    """Read and check a URDF, or a file of another format as a URDF.

    Links fixed to each other count as one body, with the name of the heaviest link.

    Args:
      trust: see ``read_urdf``.

    Raises ModelError: the file is not one rigid body with a grasp frame.
    """
    try:
        root, header, remarks = read_model(path, "its URDF", packages or {}, {}, trust=trust)
        links, faults = root.findall("link"), Faults()
        masses = dict[str, float]()
        for link in links:
            with faults:
                masses[name_of(link)] = read_mass(link)
            if link.find("inertial/mass") is not None and link.find("inertial/inertia") is None:
                faults.append(f"link '{name_of(link)}': has mass but no <inertia>; give it both")
        moving = [name_of(joint) for joint in root.findall("joint") if joint.get("type") != "fixed"]
        if moving:
            joints = f"joint '{moving[0]}' moves; make it fixed"
            if len(moving) > 1:
                joints = f"joints {', '.join(moving)} move; make them fixed"
            faults.append(f"a target is rigid, but {joints}")
        if not any(masses.values()):
            faults.append("one link must have the target's mass, not 0 (none)")
        frames = [name_of(frame) for frame in root.findall("frame")]
        body = max(masses, key=lambda name: masses[name], default="")
        if GRASP not in frames and len(frames) != 1 + (SECOND in frames):
            added = _ADDED.get(path.suffix, _FRAME).format(name=GRASP, body=body)
            found = f"{counted(len(frames), 'frame')} ({listed(frames)})" if frames else "no frame"
            faults.append(
                f"{found} where it could be held; {'name one' if frames else 'add'} {added}, on "
                "its surface, with z into the target"
            )
        faults.raise_all()
        center, tensor = _gathered(root, body)
        return Target(
            source=path,
            body=body,
            grasp=GRASP if GRASP in frames else next(each for each in frames if each != SECOND),
            second=SECOND if SECOND in frames else None,
            mass=sum(masses.values()),
            center_of_mass=tuple(center.tolist()),
            inertia=tuple(tensor[SIX].tolist()),
            root=root,
            header=header,
            remarks=tuple(remarks),
        )
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None


def _gathered(root: Element, body: str) -> tuple[np.ndarray, np.ndarray]:
    """Give one link the mass of all links that are fixed to it.

    Returns: the centre of mass (3), m, and the inertia (3, 3) about it, kg m^2, in the frame of the
    link.
    """
    joints = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    parts = list[tuple[float, np.ndarray, np.ndarray]]()
    for link in root.findall("link"):
        if not (mass := read_mass(link)):
            continue
        pose = _pose_of(body, joints).inverse() @ _pose_of(name_of(link), joints)
        inertial = link.find("inertial")
        place = pose @ origin_of(inertial)
        turn = place.rotation().matrix()
        parts.append((mass, place.translation(), turn @ read_inertia(link) @ turn.T))
        if name_of(link) != body and inertial is not None:
            link.remove(inertial)
    total = sum(mass for mass, _, _ in parts)
    center = sum((mass * at for mass, at, _ in parts), np.zeros(3)) / total
    tensor = np.zeros((3, 3))
    for mass, at, inertia in parts:
        arm = at - center
        tensor += inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    scale = max(float(np.abs(tensor).max()), 1e-300)
    # no products of 1e-16 in place of zeros
    tensor = without_rounding(scale * np.round(tensor / scale, 12) + 0.0)
    if len(parts) > 1:
        held = next(link for link in root.findall("link") if name_of(link) == body)
        for inertial in held.findall("inertial"):
            held.remove(inertial)
        merged = add_link(Element("robot"), body, total, center, tensor)
        held.insert(0, merged[0])
    return center, tensor


def _pose_of(link: str, joints: Mapping[str, Element]) -> RigidTransform:
    """Return the pose of a link in the root. ``joints``: fixed joints by child."""
    pose, seen = RigidTransform(), set[str]()
    while link in joints:
        require(link not in seen, f"link '{link}': its joints form a loop")
        seen.add(link)
        pose = origin_of(joints[link]) @ pose
        link = end_of(joints[link], "parent")
    return pose
