"""Reading a URDF as a free-flying base with joints, and finding the frame that holds the target."""

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.numbers import short
from ffsm_drake.plugins.new.urdf.elements import (
    WORLD,
    Joint,
    check_kind,
    name_of,
    read_joint,
    vector,
)
from ffsm_drake.plugins.new.urdf.formats import read_model
from ffsm_drake.plugins.new.urdf.mounting import Bus, mount
from ffsm_drake.plugins.new.urdf.simplifying import fix_followers, free_base, vague_limits
from ffsm_drake.spacecraft.checked_urdf import DRAKE, Faults, require
from ffsm_drake.spacecraft.coordinates import BASE_POSITION, BASE_ROTATION, GROUPS
from ffsm_drake.spacecraft.inertia import read_inertia, read_mass

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
    normal: int | None  # axis of the base (0, 1, 2) normal to the plane that it slid in
    total_mass: float  # kg
    joints: tuple[Joint, ...]  # the moving ones, in the file's order
    tip: Tip
    second: Tip | None  # tip of a second hand on the target
    other_tips: tuple[Tip, ...]
    remarks: tuple[str, ...]  # about the model itself, one line each
    root: Element  # the parsed file
    header: str  # the comments before its root element (licences)

    @property
    def reach(self) -> float:
        """Reach of the arm that holds the target, m; with two arms, the shorter reach."""
        return min(tip.reach for tip in (self.tip, self.second) if tip is not None)

    @property
    def other_frames(self) -> list[str]:
        """Frames that could hold the target in place of the tip: other tips, named frames, and
        links that carry no other link, such as the links of a fork.
        """
        carrying = {parent.get("link") for parent in self.root.iterfind("joint/parent")}
        frames = [
            name_of(frame)
            for frame in self.root.findall("frame")
            if frame.get("link") not in self.base_links
        ]
        ends = [joint.child for joint in self.joints if joint.child not in carrying]
        found = dict.fromkeys([*(tip.frame for tip in self.other_tips), *frames, *ends])
        return [name for name in found if name != self.tip.frame]

    @property
    def drives(self) -> dict[str, dict[str, float]]:
        """Drives with the damping and friction of the moving joints, as in a scenario; empty if
        there are none.
        """
        found: dict[str, dict[str, float]] = {}
        moving = {joint.name for joint in self.joints}
        for joint in self.root.findall("joint"):
            if (name := name_of(joint)) not in moving:
                continue
            for element in joint.findall("dynamics"):
                for key, own in (("coulomb_friction", "friction"), ("viscous_friction", "damping")):
                    if (size := float(element.get(own, "0"))) > 0.0:
                        found.setdefault(key, {})[name] = size
        return found

    @property
    def half_side(self) -> float:
        """Half the side of the cube with the mean inertia of the heaviest link of the base, m."""
        links = [link for link in self.root.findall("link") if name_of(link) in self.base_links]
        link = max(links, key=read_mass)
        return 0.5 * math.sqrt(2.0 * float(np.trace(read_inertia(link))) / read_mass(link))


def read_urdf(
    path: Path,
    *,
    tip: str | None = None,
    second: str | None = None,
    bus: Bus | None = None,
    packages: Mapping[str, Path] | None = None,
    arguments: Mapping[str, str] | None = None,
    trust: bool = False,
) -> Servicer:
    """Read and check a URDF, or a file of another format as a URDF.

    Args:
      path: the file.
      bus: bus on which an arm without a base is mounted.
      tip: link or frame that holds the target; None: the end of the longest chain.
      second: link or frame of a second hand.
      packages: folders of the packages that the file names.
      arguments: values of the arguments of a xacro file.
      trust: allow a xacro file to read files outside its folder.

    Raises:
      ModelError: the file is not a model of a free base with single-degree joints and physical
        masses.
    """
    try:
        root, header, left_out = read_model(
            path, "the URDF of base and arm", packages or {}, arguments or {}, trust=trust
        )
        if bus is not None:
            mount(root, bus)
        faults, followers, vague = Faults(), dict[str, str](), list[str]()
        axis: np.ndarray | None = None
        with faults:
            axis = free_base(root)
        with faults:
            followers = fix_followers(root)
        with faults:
            vague = [*vague_limits(root)]
        tree = _Tree(root, followers, faults)
        chosen, *others = tree.tips(tip)
        other = None if second is None else tree.tips(second)[0]
        hands = [chosen] if other is None else [chosen, other]
        _check_hands(hands, followers)
        tree.check_masses(*hands)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None
    base_links = tuple(tree.rigid_group(tree.base))
    base_mass, total = sum(tree.masses[name] for name in base_links), sum(tree.masses.values())
    return Servicer(
        source=path,
        base=tree.base,
        base_links=base_links,
        base_mass=base_mass,
        normal=_normal(axis),
        total_mass=total,
        joints=tuple(joint for joint in tree.joints if joint.moves),
        tip=chosen,
        second=other,
        other_tips=tuple(each for each in others if each.frame != second),
        remarks=(*left_out, *vague, *_remarks(tree.base, axis, followers, base_mass, total)),
        root=root,
        header=header,
    )


def _normal(axis: np.ndarray | None) -> int | None:
    """The axis of the base (0, 1, 2) that is normal to a plane; None if none is."""
    if axis is None or np.abs(axis).max() <= 0.999:
        return None
    return int(np.abs(axis).argmax())


def _remarks(
    base: str, axis: np.ndarray | None, followers: Mapping[str, str], mass: float, total: float
) -> Iterator[str]:
    """Remarks on the base and its mass (of a total, kg), its plane, and joints that are fixed."""
    if axis is not None:
        kept = "; its plane is not one of two axes, so motion and disturbance leave it"
        if _normal(axis) is not None:
            kept = ", and its motion and disturbance stay in it"
        yield f"the base '{base}' slides in a plane: it is free here{kept}"
    if followers:
        told = (f"{follower} (follows {leader})" for follower, leader in followers.items())
        yield f"joints that follow others are fixed: {', '.join(told)}"
    if mass < 0.5 * total:
        yield (
            f"the base '{base}' has {short(mass)} of {short(total)} kg; if it is the foot of an "
            "arm, mount it on a bus with --bus-mass KG"
        )


def _check_hands(hands: Sequence[Tip], followers: Mapping[str, str]) -> None:
    """Raise ModelError if two tips are on one arm, or a joint that is fixed follows one that moves
    a tip.
    """
    for first, second in itertools.combinations(hands, 2):
        require(
            first.frame != second.frame,
            f"both tips are '{first.frame}'; name the hands of two arms",
        )
        one, other = set(first.joints), set(second.joints)
        require(
            not (one <= other or other <= one),
            f"the tips '{first.frame}' and '{second.frame}' are on one arm; name the hands of two",
        )
    for (follower, leader), hand in itertools.product(followers.items(), hands):
        require(
            leader not in hand.joints,
            f"joint '{follower}' follows '{leader}' (<mimic>), which moves the tip; remove "
            "<mimic>, and it is controlled on its own",
        )


class _Tree:
    """Links and joints of a URDF as a tree from the base. Raises ModelError, with all faults of
    links and joints, unless they form one.
    """

    def __init__(self, root: Element, followers: Collection[str], faults: Faults) -> None:
        self.followers = followers  # fixed joints of fingers
        self.links = _by_name("link", root.findall("link"), faults)
        self.frames = _by_name("frame", root.findall("frame"), faults)
        self.links.pop(WORLD, None)
        elements = (*root.findall("joint"), *root.findall(f"{DRAKE}joint"))
        self.joints, self.masses = list[Joint](), dict[str, float]()
        for element in _by_name("joint", elements, faults).values():
            with faults:
                self.joints.append(read_joint(element))
        if not faults:
            require(
                any(joint.kind != "fixed" for joint in self.joints) or not self.links,
                "has no joint that moves; a servicer needs an arm with revolute or prismatic "
                "joints",
            )
        for joint in self.joints:
            with faults:
                self._check_joint(joint)
        for name, link in self.links.items():
            with faults:
                self.masses[name] = read_mass(link)
        self._check_names(faults)
        children = Counter(joint.child for joint in self.joints if joint.parent != WORLD)
        roots = [name for name in self.links if name not in children]
        found = f"{len(roots)} ({', '.join(roots)})" if roots else "none"
        for name, count in children.items():
            if count > 1:
                faults.append(
                    f"link '{name}' is the child of {count} joints; a chain must not close on "
                    "itself"
                )
        if len(roots) != 1:
            faults.append(
                f"one link must be the base, without a parent, not {found}; join the others to it"
            )
        faults.raise_all()
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

    def _check_joint(self, joint: Joint) -> None:
        require(
            joint.parent != WORLD,
            f"the base '{joint.child}' is attached to the world; mount an arm on a bus with "
            f"--bus-mass KG, or remove joint '{joint.name}' and '{WORLD}' (MJCF: add <freejoint/>)",
        )
        for role, link in (("parent", joint.parent), ("child", joint.child)):
            require(
                link in self.links,
                f"joint '{joint.name}': its {role} link '{link}' does not exist",
            )
        check_kind(joint)
        require(
            not joint.moves or joint.lower < joint.upper,
            f"joint '{joint.name}': its limits leave it no motion; make it fixed",
        )
        require(
            not joint.moves or joint.name not in _RESERVED,
            f"joint '{joint.name}': the name clashes with one that scenarios use for the base; "
            "rename the joint",
        )

    def _check_names(self, faults: Faults) -> None:
        for name, frame in self.frames.items():
            link = frame.get("link", "")
            with faults:
                require(link in self.links, f"frame '{name}': its link '{link}' does not exist")
                require(
                    name not in self.links,
                    f"frame '{name}' has the name of a link; rename the frame",
                )

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

    def check_masses(self, *tips: Tip) -> None:
        """Raise ModelError unless the base has mass, and every joint moves mass or the target."""
        faults, loaded = Faults(), {name for tip in tips for name in tip.joints}
        if not sum(self.masses[name] for name in self.rigid_group(self.base)):
            faults.append(
                f"the base '{self.base}' has no mass; give it an <inertial> with mass and "
                "inertia, or mount the arm on a bus with --bus-mass KG"
            )
        for joint in self.joints:
            if joint.moves and joint.name not in loaded and not self.mass_below(joint.child):
                faults.append(
                    f"link '{joint.child}' moves but has no mass, and carries none; give it an "
                    f"<inertial>, or make joint '{joint.name}' fixed"
                )
        faults.raise_all()

    def tips(self, chosen: str | None) -> list[Tip]:
        """Return the chosen tip (default: end of the longest chain), then the others, longest chain
        first.
        """
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
        reach += float(np.linalg.norm(vector(self.frames.get(frame), "xyz")))
        return Tip(frame=frame, joints=joints, reach=reach)

    def _frames_on(self, links: Collection[str]) -> list[str]:
        return [name for name, frame in self.frames.items() if frame.get("link") in links]

    def _ends(self) -> list[Tip]:
        """Return the ends of the chains. The end of a gripper is its palm or a link fixed to the
        palm.
        """
        ends = []
        for head in (joint.child for joint in self.joints if joint.moves):
            # A rigid group counts once, by its outermost frame.
            group = [
                name
                for name in self.rigid_group(head)
                if not any(joint.name in self.followers for joint in self.chain(name))
            ]
            below = [joint for name in group for joint in self.below[name]]
            onward = [joint for joint in below if joint.moves]
            fingers = len(onward) + sum(joint.name in self.followers for joint in below)
            has_fingers = fingers > 1 and not any(
                j.moves for joint in onward for j in self.descend(joint.child)
            )
            frames = self._frames_on(group)
            if has_fingers and not frames:  # an only frame beyond is the hand's
                beyond = [
                    each.child for joint in onward for each in [joint, *self.descend(joint.child)]
                ]
                has_fingers = len(self._frames_on(beyond)) != 1
            if not onward or has_fingers:
                leaves = [name for name in group if not self.below[name]]
                holders = sorted({joint.parent for joint in below if joint.child not in group})
                ends.append(
                    max(map(self._tip, frames or leaves or holders), key=lambda tip: tip.reach)
                )
        palms = {tip.joints[-1] for tip in ends}
        return [tip for tip in ends if not palms & set(tip.joints[:-1])]


def _by_name(kind: str, elements: Iterable[Element], faults: Faults) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in elements:
        name = name_of(element)
        if name in found:
            faults.append(f"more than one {kind} is called '{name}'; rename one of them")
        found[name] = element
    return found
