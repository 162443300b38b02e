"""Reading a URDF as a free-flying base with joints, and finding the frame that holds the target."""

import dataclasses
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.elements import (
    WORLD,
    Joint,
    check_kind,
    name_of,
    read_joint,
    read_mass,
    vector,
)
from ffsm_drake.plugins.new.urdf.mounting import Bus, mount
from ffsm_drake.spacecraft.checked_urdf import DRAKE, parse, require
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, GROUPS

_RESERVED = ("all", *GROUPS, *BASE_ROTATION, *BASE_POSITION)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tip:
    """A frame at the end of a chain that starts at the base."""

    frame: str
    joints: tuple[str, ...]  # the joints that move it, from the base outward
    reach: float  # length of the stretched chain from its first joint, m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Servicer:
    """A URDF read as a free-flying base with joints."""

    source: Path
    base: str
    base_links: tuple[str, ...]  # the base and the links fixed to it
    base_mass: float  # mass of these bodies, kg
    total_mass: float  # kg
    joints: tuple[Joint, ...]  # the moving ones, in the file's order
    tip: Tip
    other_tips: tuple[Tip, ...]
    remarks: tuple[str, ...]  # about the model itself, one line each
    root: Element  # the parsed file
    header: str  # the comments before its root element (licences)

    @property
    def reach(self) -> float:
        """Reach of the arm that holds the target, m."""
        return self.tip.reach


def read_urdf(path: Path, *, tip: str | None = None, bus: Bus | None = None) -> Servicer:
    """Read and check a URDF.

    Args:
      path: the file.
      bus: the bus to mount it on, if it is an arm without a base.
      tip: name of the link or frame that holds the target; None for the end of the longest chain.

    Raises:
      ModelError: the file is not a URDF of a free base with single-degree joints and physical
        masses.
    """
    try:
        root, header = parse(path)
        if bus is not None:
            mount(root, bus)
        tree = _Tree(root)
        tree.check_names_and_kinds()
        chosen, *others = tree.tips(tip)
        tree.check_masses(chosen)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None
    base_links = tuple(tree.rigid_group(tree.base))
    base_mass, total = sum(tree.masses[name] for name in base_links), sum(tree.masses.values())
    remarks = []
    if base_mass < 0.5 * total:
        remarks.append(
            f"the base '{tree.base}' has {base_mass:.3g} of {total:.3g} kg: if it is the arm's "
            "foot, join it to a link for the spacecraft by a fixed joint, or mount it on a bus "
            "with --bus-mass KG"
        )
    return Servicer(
        source=path,
        base=tree.base,
        base_links=base_links,
        base_mass=base_mass,
        total_mass=total,
        joints=tuple(joint for joint in tree.joints if joint.moves),
        tip=chosen,
        other_tips=tuple(others),
        remarks=tuple(remarks),
        root=root,
        header=header,
    )


class _Tree:
    """Links and joints of a URDF as a tree from the base. Raises ModelError unless they form
    one.
    """

    def __init__(self, root: Element) -> None:
        self.links = _by_name("link", root.findall("link"))
        self.frames = _by_name("frame", root.findall("frame"))
        elements = (*root.findall("joint"), *root.findall(f"{DRAKE}joint"))
        joints = [read_joint(element) for element in _by_name("joint", elements).values()]
        self.joints = [joint for joint in joints if joint.parent != WORLD]
        self.links.pop(WORLD, None)
        for joint in joints:
            require(
                joint.parent != WORLD or joint.kind == "floating",
                f"the base '{joint.child}' is attached to the world; remove joint '{joint.name}' "
                f"and link '{WORLD}' from the URDF, so that the base is free, or mount it on a bus "
                "with --bus-mass KG",
            )
        for joint in self.joints:
            for role, link in (("parent", joint.parent), ("child", joint.child)):
                require(
                    link in self.links,
                    f"joint '{joint.name}': its {role} link '{link}' does not exist",
                )
        children = Counter(joint.child for joint in self.joints)
        for name, count in children.items():
            require(
                count == 1,
                f"link '{name}' is the child of {count} joints; a chain must not close on itself",
            )
        roots = [name for name in self.links if name not in children]
        found = f"{len(roots)} ({', '.join(roots)})" if roots else "none"
        require(
            len(roots) == 1,
            f"one link must be the base, without a parent, not {found}; join the others to it",
        )
        self.base = roots[0]
        self.above = {joint.child: joint for joint in self.joints}
        self.below = {
            name: [joint for joint in self.joints if joint.parent == name] for name in self.links
        }
        reached = {self.base, *(joint.child for joint in self.descend(self.base))}
        for name in self.links:
            require(
                name in reached,
                f"link '{name}' is not connected to the base '{self.base}': its joints form a loop",
            )
        self.masses = {name: read_mass(link) for name, link in self.links.items()}

    def descend(self, link: str) -> Iterator[Joint]:
        """All joints below a link."""
        for joint in self.below[link]:
            yield joint
            yield from self.descend(joint.child)

    def rigid_group(self, link: str) -> list[str]:
        """The link and the links fixed to it, outward."""
        fixed = [joint.child for joint in self.below[link] if not joint.moves]
        return [link, *(name for child in fixed for name in self.rigid_group(child))]

    def chain(self, frame: str) -> list[Joint]:
        """The joints from the base to a link or frame."""
        link = self.frames[frame].get("link", "") if frame in self.frames else frame
        joints = []
        while link != self.base:
            joints.append(self.above[link])
            link = self.above[link].parent
        return joints[::-1]

    def mass_below(self, link: str) -> float:
        return self.masses[link] + sum(self.masses[joint.child] for joint in self.descend(link))

    def check_names_and_kinds(self) -> None:
        for joint in self.joints:
            check_kind(joint)
        moving = [joint.name for joint in self.joints if joint.moves]
        require(
            moving,
            "has no joint that moves; a servicer needs an arm with revolute or prismatic joints",
        )
        for name in moving:
            require(
                name not in _RESERVED,
                f"joint '{name}': the name clashes with one that scenarios use for the base; "
                "rename the joint",
            )
        for name, frame in self.frames.items():
            link = frame.get("link", "")
            require(link in self.links, f"frame '{name}': its link '{link}' does not exist")
            require(
                name not in self.links, f"frame '{name}' has the name of a link; rename the frame"
            )

    def check_masses(self, tip: Tip) -> None:
        """Raise ModelError unless the base has mass, and every joint moves mass or the target."""
        base_mass = sum(self.masses[name] for name in self.rigid_group(self.base))
        require(
            base_mass,
            f"the base '{self.base}' has no mass; give it an <inertial> with mass and inertia",
        )
        for joint in self.joints:
            require(
                not joint.moves or joint.name in tip.joints or self.mass_below(joint.child),
                f"link '{joint.child}' moves but has no mass, and carries none; give it an "
                f"<inertial>, or make joint '{joint.name}' fixed",
            )

    def tips(self, chosen: str | None) -> list[Tip]:
        """The chosen tip (default: the longest chain's), then the others, longest chain first."""
        ends = sorted(self._ends(), key=lambda tip: (-len(tip.joints), -tip.reach))
        if chosen is None:
            return ends
        valid = [
            name
            for name in (*self.links, *self.frames)
            if any(joint.moves for joint in self.chain(name))
        ]
        known = chosen in self.links or chosen in self.frames
        fault = (
            f"tip '{chosen}' does not move relative to the base"
            if known
            else f"no link or frame '{chosen}' for the tip"
        )
        require(chosen in valid, f"{fault}; choose one of {', '.join(valid)}")
        return [self._tip(chosen), *(end for end in ends if end.frame != chosen)]

    def _tip(self, frame: str) -> Tip:
        chain = self.chain(frame)
        joints = tuple(joint.name for joint in chain if joint.moves)
        first = next((k for k, joint in enumerate(chain) if joint.moves), len(chain))
        reach = sum(joint.offset for joint in chain[first + 1 :])
        reach += sum(
            max(abs(j.lower), abs(j.upper))
            for j in chain
            if j.kind == "prismatic" and math.isfinite(j.upper)
        )
        reach += float(np.linalg.norm(vector(self.frames.get(frame), "xyz", f"frame '{frame}'")))
        return Tip(frame=frame, joints=joints, reach=reach)

    def _ends(self) -> list[Tip]:
        """The ends of the chains; for a gripper its palm or a link fixed there, not its fingers."""
        ends = []
        for head in (joint.child for joint in self.joints if joint.moves):
            # A rigid group counts once, by its outermost frame.
            group = self.rigid_group(head)
            onward = [joint for name in group for joint in self.below[name] if joint.moves]
            has_fingers = len(onward) > 1 and not any(
                j.moves for joint in onward for j in self.descend(joint.child)
            )
            if not onward or has_fingers:
                frames = [name for name, frame in self.frames.items() if frame.get("link") in group]
                leaves = [name for name in group if not self.below[name]]
                holders = sorted({joint.parent for joint in onward})
                ends.append(
                    max(map(self._tip, frames or leaves or holders), key=lambda tip: tip.reach)
                )
        palms = {tip.joints[-1] for tip in ends}
        return [tip for tip in ends if not palms & set(tip.joints[:-1])]


def _by_name(kind: str, elements: Iterable[Element]) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in elements:
        name = name_of(element)
        require(name not in found, f"more than one {kind} is called '{name}'; rename one of them")
        found[name] = element
    return found
