"""A URDF put together from bodies and joints."""

from collections.abc import Iterator, Mapping
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from ffsm_drake.plugins.new.urdf.elements import WORLD, end_of, listed, name_of
from ffsm_drake.spacecraft.checked_urdf import DRAKE, require

_ZERO = 1e-14  # relative; products of inertia below it come from rounding


def text(values: object) -> str:
    """Return numbers as text without loss."""
    return " ".join(f"{value + 0.0!r}" for value in np.ravel(np.asarray(values, float)).tolist())


def place(pose: RigidTransform) -> dict[str, str]:
    """The attributes of a pose."""
    rpy = pose.rotation().ToRollPitchYaw().vector()
    return {"xyz": text(pose.translation()), "rpy": text(rpy)}


def set_origin(element: Element, pose: RigidTransform) -> None:
    """Put a joint or a visual at a pose."""
    for origin in element.findall("origin"):
        element.remove(origin)
    SubElement(element, "origin", place(pose))


def add_frame(root: Element, name: str, link: str, pose: RigidTransform) -> None:
    """Add a frame at a pose in a link."""
    SubElement(root, "frame", {"name": name, "link": link, **place(pose)})


def add_link(root: Element, name: str, mass: float, center: object, inertia: np.ndarray) -> Element:
    """Return a link with a mass (kg), its centre (3, m), and the inertia (3, 3, kg m^2) about the
    centre, in the axes of the link.
    """
    link = SubElement(root, "link", name=name)
    if mass or inertia.any():
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=text(center), rpy="0 0 0")
        SubElement(inertial, "mass", value=text(mass))
        tensor = np.where(np.abs(inertia) < _ZERO * np.abs(inertia).max(), 0.0, inertia)
        moments = {
            f"i{'xyz'[i]}{'xyz'[j]}": text(tensor[i, j]) for i in range(3) for j in range(i, 3)
        }
        SubElement(inertial, "inertia", moments)
    return link


def add_joint(
    root: Element,
    name: str,
    kind: str,
    ends: tuple[str, str],
    pose: RigidTransform,
    *,
    axis: object = (0.0, 0.0, 1.0),
    limits: Mapping[str, float] | None = None,
    rotor: float = 0.0,
    damping: float = 0.0,
    friction: float = 0.0,
) -> Element:
    """Return a joint between a parent and a child, at a pose in the parent.

    Args:
      limits: attributes of <limit>.
      rotor: inertia (kg m^2 or kg) that the rotor of the drive adds.
      damping: N m s or N s/m.
      friction: N m or N.
    """
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=ends[0])
    SubElement(joint, "child", link=ends[1])
    set_origin(joint, pose)
    if kind != "fixed":
        SubElement(joint, "axis", xyz=text(axis))
        known = {key: text(value) for key, value in (limits or {}).items() if np.isfinite(value)}
        SubElement(joint, "limit", known)
    if rotor:
        add_rotor(root, name, rotor)
    if damping or friction:
        SubElement(joint, "dynamics", damping=text(damping), friction=text(friction))
    return joint


def add_mimic(joint: Element, leader: str, multiplier: float, offset: float) -> None:
    """Let a joint follow another: at multiplier x + offset, rad or m."""
    SubElement(joint, "mimic", joint=leader, multiplier=text(multiplier), offset=text(offset))


def add_rotor(root: Element, joint: str, inertia: float) -> None:
    """Add the inertia of a drive's rotor (kg m^2 or kg) to a joint, in Drake's form."""
    transmission = SubElement(root, "transmission", name=f"{joint}_transmission")
    SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    SubElement(transmission, "joint", name=joint)
    actuator = SubElement(transmission, "actuator", name=f"{joint}_drive")
    SubElement(actuator, f"{DRAKE}rotor_inertia", value=text(inertia))
    SubElement(actuator, f"{DRAKE}gear_ratio", value="1")


def add_visual(
    link: Element, kind: str, pose: RigidTransform, color: ArrayLike | None, **size: str
) -> None:
    """A shape of a link: its kind (an element of <geometry>), and that element's attributes."""
    visual = SubElement(link, "visual")
    set_origin(visual, pose)
    SubElement(SubElement(visual, "geometry"), kind, size)
    if color is not None:
        rgba = text(np.round(np.asarray(color), 4))
        color_visual(visual, rgba, rgba)


def color_visual(visual: Element, name: str, rgba: str) -> None:
    """Add a material that is defined in place: its name and colour."""
    SubElement(SubElement(visual, "material", name=name), "color", rgba=rgba)


def passed_over(parts: list[str]) -> Iterator[str]:
    """A remark on parts of a file, if there are any."""
    if parts:
        yield f"passed over, of no effect in free flight: {', '.join(parts)}"


def keep_servicer(root: Element) -> Iterator[str]:
    """Remove the bodies that are not on a free body with moving joints, and their frames; yield a
    remark on their roots.

    If no free body has moving joints, bodies held by the world stay.
    """
    joints = {end_of(joint, "child"): joint for joint in root.findall("joint")}
    links = {name_of(link): link for link in root.findall("link")}

    def stem_of(name: str) -> str:
        """The root above a link, or the link that the world holds."""
        seen = set[str]()
        while name in joints and (above := end_of(joints[name], "parent")) != WORLD:
            require(name not in seen, f"link '{name}': its joints form a loop; remove one of them")
            seen.add(name)
            name = above
        return name

    stems = {name: stem_of(name) for name in links}
    arms = {stems[name] for name, joint in joints.items() if joint.get("type") != "fixed"}
    free = arms & {stem for stem in stems.values() if stem not in joints}
    kept = free or arms or set(stems.values())
    lone = dict.fromkeys(stem for stem in stems.values() if stem not in kept)
    for name, stem in stems.items():
        if stem in lone:
            root.remove(links[name])
            if name in joints:
                root.remove(joints[name])
    for frame in root.findall("frame"):
        if stems.get(frame.get("link", "")) in lone:
            root.remove(frame)
    if lone:
        yield f"bodies left out, which are not part of the servicer: {listed([*lone])}"


def without_pictures(root: Element) -> str:
    """Return the text of a URDF without its visuals."""
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    return ElementTree.tostring(root, encoding="unicode")
