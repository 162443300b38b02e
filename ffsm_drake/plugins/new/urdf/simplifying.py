"""Simplification of a URDF: bases held by joints become free, following joints become fixed, and
ranges of zero are removed.
"""

import math
from collections.abc import Iterator, Mapping
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform

from ffsm_drake.plugins.new.urdf.elements import (
    WORLD,
    end_of,
    listed,
    name_of,
    origin_of,
    read_joint,
    roots_of,
    vector,
)
from ffsm_drake.plugins.new.urdf.formats.building import set_origin
from ffsm_drake.spacecraft.checked_urdf import number, require
from ffsm_drake.spacecraft.inertia import read_mass

_BASES = {  # kinds of the joints between the world and a base -> kind of base
    ("floating",): "free",
    ("planar",): "planar",
    ("prismatic", "prismatic", "turn"): "planar",
    ("prismatic", "prismatic", "prismatic", "turn", "turn", "turn"): "free",
}
_NO_LIMIT = 1e16  # what SDFormat writes; others write the largest number, which overflows
_FAR = 1e4  # rad or m, in place of such a limit where the other side has a limit
_DEGREES = (20.0, 720.0)  # a range (upper less lower) between these is not in radians


def free_base(root: Element) -> np.ndarray | None:
    """Remove the joints between a floating or sliding base and the world or a massless root, with
    the massless links between them.

    Returns: the normal (3) of the plane of a planar base, in the axes of the base with the joints
    at zero; None for other bases.

    Raises ModelError: one of the joints has a rotor, whose inertia no body has.
    """
    joints = root.findall("joint")
    links = {name_of(link): link for link in root.findall("link")}
    for ground in (WORLD, *roots_of(root)):
        chain, here = list[Element](), ground
        while len(chain) < len(joints) and not (here in links and read_mass(links[here])):
            onward = [joint for joint in joints if end_of(joint, "parent") == here]
            if len(onward) != 1 or onward[0].get("type") == "fixed":
                break
            chain.append(onward[0])
            here = end_of(onward[0], "child")
        turns = {"revolute": "turn", "continuous": "turn"}
        kinds = [turns.get(joint.get("type", ""), joint.get("type", "")) for joint in chain]
        base = _BASES.get(tuple(sorted(kinds)))
        if base is None:
            continue
        names = [name_of(joint) for joint in chain]
        rotors = [name for name in names if rotor_of(root, name)]
        require(
            not rotors,
            f"joints {', '.join(rotors)} of the base have an armature, an inertia of no body; set "
            "it to 0",
        )
        for joint in chain:
            root.remove(joint)
            if (link := links.get(end_of(joint, "parent"))) is not None:
                root.remove(link)
        return _normal(chain, kinds) if base == "planar" else None
    return None


def _normal(chain: list[Element], kinds: list[str]) -> np.ndarray:
    """The axis (3) of the turn of a planar base, or of its planar joint, in the base's axes."""
    at = next(k for k, kind in enumerate(kinds) if kind in ("turn", "planar"))
    axis = vector(chain[at].find("axis"), "xyz", "1 0 0" if kinds[at] == "turn" else "0 0 1")
    for joint in chain[at + 1 :]:
        axis = origin_of(joint).rotation().matrix().T @ axis
    normal: np.ndarray = axis / max(float(np.linalg.norm(axis)), 1e-12)
    return normal


def rotor_of(root: Element, joint: str) -> float:
    """The inertia that rotors add to a joint, kg m^2 or kg, as given for Drake."""
    total = 0.0
    for transmission in root.findall("transmission"):
        if any(name_of(each) == joint for each in transmission.findall("joint")):
            found = {
                element.tag.rpartition("}")[2]: float(element.attrib["value"])
                for actuator in transmission.findall("actuator")
                for element in actuator
                if "value" in element.attrib
            }
            total += found.get("rotor_inertia", 0.0) * found.get("gear_ratio", 1.0) ** 2
    return total


def fix_followers(root: Element) -> dict[str, str]:
    """Fix the joints that follow others (<mimic>) at the rest positions of their leaders.

    Returns: follower -> leader.
    """
    joints = {name_of(joint): joint for joint in root.findall("joint")}
    found = dict[str, str]()
    _check_leaders(joints)
    for name, joint in joints.items():
        mimic, place = joint.find("mimic"), f"joint '{name}'"
        if mimic is None:
            continue
        leader = mimic.get("joint", "")
        require(leader in joints, f"{place}: follows '{leader}', which does not exist")
        value = number(mimic, "multiplier", place, "1") * read_joint(joints[leader]).rest
        value += number(mimic, "offset", place, "0")
        axis = vector(joint.find("axis"), "xyz", "1 0 0")
        axis /= max(float(np.linalg.norm(axis)), 1e-12)
        pose = origin_of(joint) @ (
            RigidTransform(value * axis)
            if joint.get("type") == "prismatic"
            else RigidTransform(AngleAxis(value, axis), np.zeros(3))
        )
        if value:
            set_origin(joint, pose)
        for element in (*joint.findall("mimic"), *joint.findall("limit")):
            joint.remove(element)
        joint.set("type", "fixed")
        found[name] = leader
    return found


def _check_leaders(joints: Mapping[str, Element]) -> None:
    """Raise ModelError where joints follow each other in a circle."""
    leaders = {
        name: mimic for name, joint in joints.items() if (mimic := joint.find("mimic")) is not None
    }
    for first in leaders:
        chain = [first]
        while (leader := leaders.get(chain[-1])) is not None:
            chain.append(leader.get("joint", ""))
            require(
                chain[-1] != first,
                f"joints {listed(chain[:-1])} follow each other (<mimic>, or an equality in MJCF); "
                "let one of them lead",
            )
            if chain[-1] in chain[:-1]:
                break


def vague_limits(root: Element) -> Iterator[str]:
    """Remove ranges of 0 to 0; yield remarks on limits that are useless, or in degrees."""
    unknown: dict[str, list[str]] = {"effort": [], "velocity": [], "range": []}
    degrees, beyond = list[str](), list[str]()
    for joint in root.findall("joint"):
        limit, name = joint.find("limit"), name_of(joint)
        if limit is None or joint.get("type") not in ("revolute", "continuous", "prismatic"):
            continue
        given = {
            key: float(limit.attrib[key])
            for key in ("lower", "upper", "effort", "velocity")
            if key in limit.attrib
        }
        huge = [key for key, value in given.items() if abs(value) >= _NO_LIMIT]
        beyond += [f"{key} of {name}" for key in huge if abs(given[key]) > _NO_LIMIT]
        for key in huge:
            if key in ("lower", "upper") and not {"lower", "upper"} <= {*huge}:
                given[key] = math.copysign(_FAR, given[key])
                limit.set(key, f"{given[key]}")
            else:
                del limit.attrib[key], given[key]
        for key in ("effort", "velocity"):
            unknown[key] += [name] if given.get(key) == 0.0 else []
        if joint.get("type") == "continuous" or not given.keys() & {"lower", "upper"}:
            continue
        lower, upper = given.get("lower", 0.0), given.get("upper", 0.0)
        if lower == upper == 0.0:
            unknown["range"].append(name)
            for key in ("lower", "upper"):
                limit.attrib.pop(key, None)
        if joint.get("type") == "revolute" and _DEGREES[0] <= upper - lower <= _DEGREES[1]:
            degrees.append(f"{name} {lower:g} to {upper:g} rad")
    told = [f"{key} of {listed(names)}" for key, names in unknown.items() if names]
    if told:
        yield f"limits of 0 say nothing and do not limit: {'; '.join(told)}"
    if beyond:
        yield f"limits beyond {_NO_LIMIT:g} do not limit: {listed(beyond)}"
    if degrees:
        yield (
            f"limits of many turns, perhaps in degrees, where a URDF has radians: "
            f"{listed(degrees)}; the velocity limits too?"
        )
