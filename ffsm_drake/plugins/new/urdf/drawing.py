"""Plain shapes for links without visuals, so that base and arm are visible without meshes."""

from collections.abc import Collection, Iterator
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from ffsm_drake.plugins.new.urdf.elements import end_of, name_of, read_joint, vector
from ffsm_drake.plugins.new.urdf.formats.building import add_visual
from ffsm_drake.spacecraft.clearance import INVENTED, UNMEASURED
from ffsm_drake.spacecraft.inertia import read_inertia, read_mass

_COLORS = {
    "box": (0.83, 0.62, 0.2, 1.0),
    "cylinder": (0.92, 0.92, 0.94, 1.0),
    "sphere": (0.48, 0.5, 0.54, 1.0),
}


def draw_bare_links(root: Element, *, base_links: Collection[str], radius: float) -> list[str]:
    """Draw the links of a URDF that have no visual; return their names.

    A link of the base becomes the box with its moments of inertia. Any other link becomes a ball at
    its joint, with rods of the given radius (m). The rods end at the joints and frames on the link,
    over the stroke of a sliding joint, or past the centre of mass at the end of a chain, so that
    bodies touch from joint to joint. Shapes of the base do not count for clearances, because its
    mass says little about its size.
    """
    drawn = list[str]()
    given = {name_of(link): link.findall("visual") for link in root.findall("link")}
    pictured = {name for name, visuals in given.items() if not all(map(_is_mark, visuals))}
    carriers = {  # between a joint and a link with a picture
        end_of(joint, "parent")
        for joint in root.findall("joint[@type='fixed']")
        if end_of(joint, "child") in pictured
    }
    for link in root.findall("link"):
        is_massless = link.find("inertial") is None
        if name_of(link) in pictured or (is_massless and name_of(link) in carriers):
            continue
        name, has_mass = name_of(link), link.find("inertial") is not None
        start, ends = np.zeros(3), list(_held_points(root, name))
        center = vector(link.find("inertial/origin"), "xyz")
        if name in base_links:
            box = _equivalent_box(link)
            if box is not None:
                _add(link, "box", RigidTransform(center), size=box)
                start, ends = center, [start, *ends]
        elif ends or has_mass:
            _add(link, "sphere", RigidTransform(start), radius=f"{1.3 * radius:.4g}")
            ends = [*(ends or [2.0 * center]), *_stroke(root, name)]
        for end in ends:
            if np.linalg.norm(end - start) > 0.1 * radius:
                _add_rod(link, start, end, radius)
        made = [visual for visual in link.findall("visual") if visual not in given[name]]
        for k, visual in enumerate(made if name in base_links else ()):
            visual.set("name", f"{INVENTED}_{k}")
        if made:
            drawn.append(name)
    return drawn


def _is_mark(visual: Element) -> bool:
    """Whether a visual stands for one that cannot be drawn."""
    return visual.get("name", "").startswith(UNMEASURED)


def _held_points(root: Element, link: str) -> Iterator[np.ndarray]:
    """The origins (3), in m, of the joints and frames that a link holds."""
    for joint in root.findall("joint"):
        if end_of(joint, "parent") == link:
            yield vector(joint.find("origin"), "xyz")
    for frame in root.findall("frame"):
        if frame.get("link") == link:
            yield vector(frame, "xyz")


def _stroke(root: Element, link: str) -> Iterator[np.ndarray]:
    """Ends (3) of a sliding link's stroke in its frame: one or both limits."""
    for element in root.findall("joint"):
        joint = read_joint(element)
        if joint.child == link and joint.unit == "m" and joint.is_limited:
            axis = vector(element.find("axis"), "xyz", "1 0 0")
            yield from (
                -limit * axis / np.linalg.norm(axis) for limit in (joint.lower, joint.upper)
            )


def _add_rod(link: Element, start: np.ndarray, end: np.ndarray, radius: float) -> None:
    length = float(np.linalg.norm(end - start))
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(end - start, 2), 0.5 * (start + end))
    _add(link, "cylinder", pose, radius=f"{radius:.4g}", length=f"{length:.6g}")


def _add(link: Element, kind: str, pose: RigidTransform, **size: str) -> None:
    add_visual(link, kind, pose, _COLORS[kind], **size)


def _equivalent_box(link: Element) -> str | None:
    """Sides of the solid box with a link's moments of inertia, m; None if there is no such box."""
    mass = read_mass(link)
    if not mass:
        return None
    moments = np.diagonal(read_inertia(link))
    squares = (moments.sum() - 2.0 * moments) * 6.0 / mass
    return " ".join(f"{side:.4g}" for side in np.sqrt(squares)) if min(squares) > 0.0 else None
