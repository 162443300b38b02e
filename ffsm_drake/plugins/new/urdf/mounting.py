"""Mounting an arm on a bus: a box of uniform density, with the arm on its +z face."""

import copy
import dataclasses
import math
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import short
from ffsm_drake.plugins.new.urdf.elements import WORLD, end_of, name_of, origin_of, roots_of
from ffsm_drake.plugins.new.urdf.formats.building import (
    add_joint,
    add_link,
    add_visual,
    set_origin,
    text,
)
from ffsm_drake.plugins.new.urdf.simplifying import free_base
from ffsm_drake.spacecraft.checked_urdf import require
from ffsm_drake.spacecraft.inertia import read_mass

DENSITY = 50.0  # kg/m^3, of a bus without a size, as of the shipped servicer
_NAME, _MOUNT = "bus", "bus_mount"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bus:
    """A box-shaped spacecraft."""

    mass: float  # kg
    size: tuple[float, float, float]  # m, along x, y, z

    @property
    def inertia(self) -> tuple[float, float, float]:
        """Principal moments about its centre, kg m^2."""
        x, y, z = (side * side for side in self.size)
        return self.mass * (y + z) / 12.0, self.mass * (x + z) / 12.0, self.mass * (x + y) / 12.0


def make_bus(mass: float, size: tuple[float, ...] | None = None) -> Bus:
    """A bus of given mass, kg, and size, m (side of a cube, or three); default: a cube of DENSITY.

    Raises ScenarioError for values that are not positive.
    """
    if not (math.isfinite(mass) and mass > 0.0):
        raise ScenarioError("--bus-mass", f"must be > 0 kg, not {mass:g}")
    sides = size if size is not None else (round((mass / DENSITY) ** (1.0 / 3.0), 2) or 0.01,)
    if len(sides) not in (1, 3) or not all(math.isfinite(side) and side > 0.0 for side in sides):
        raise ScenarioError(
            "--bus-size",
            f"must be one side or three, > 0 m, not {','.join(f'{s:g}' for s in sides)}",
        )
    x, y, z = sides if len(sides) == 3 else 3 * sides
    bus = Bus(mass=mass, size=(x, y, z))
    if not all(0.0 < moment < math.inf for moment in bus.inertia):
        raise ScenarioError("--bus-size", f"gives {mass:g} kg no usable inertia; use another size")
    return bus


def mount(root: Element, bus: Bus) -> str:
    """Join the arm of a parsed URDF to a new base link; links fixed to the world move to its +z
    face.

    Returns: the link of the bus.

    Raises ModelError: the foot of the arm is ambiguous, or the model is a spacecraft.
    """
    _check_is_arm(root)
    links = [name_of(link) for link in root.findall("link")]
    for joint in root.findall("joint[@type='floating']"):
        if joint.find(f"parent[@link='{WORLD}']") is not None:
            root.remove(joint)
    joints = root.findall("joint")
    name, mount_name = _free(_NAME, links), _free(_MOUNT, [name_of(joint) for joint in joints])
    standing = [joint for joint in joints if end_of(joint, "parent") == WORLD]
    roots = roots_of(root)
    require(
        len(roots) + bool(standing) == 1,
        f"one link must be the arm's foot, without a parent, not {len(roots)} "
        f"({', '.join(roots) or 'none'})"
        + (" that are not fixed to the world" if standing else ""),
    )
    face = RigidTransform(np.array([0.0, 0.0, 0.5 * bus.size[2]]))
    for joint in standing:  # its origin lies on the face
        for parent in joint.findall("parent"):
            parent.set("link", name)
        set_origin(joint, face @ origin_of(joint))
    if not standing:
        add_joint(root, mount_name, "fixed", (name, roots[0]), face)
    link = add_link(root, name, bus.mass, (0.0, 0.0, 0.0), np.diag(bus.inertia))
    add_visual(link, "box", RigidTransform(), None, size=text(bus.size))
    return name


def _check_is_arm(root: Element) -> None:
    """Raise ModelError if a free root has half of the mass or more, so that it is a spacecraft."""
    free = copy.deepcopy(root)
    free_base(free)
    joints = free.findall("joint")
    masses = {name_of(link): read_mass(link) for link in free.findall("link")}
    roots = roots_of(free)
    if len(roots) != 1 or any(end_of(joint, "parent") == WORLD for joint in joints):
        return
    group, fixed = roots.copy(), [each for each in joints if each.get("type") == "fixed"]
    for name in group:  # grows during the loop
        group += [end_of(each, "child") for each in fixed if end_of(each, "parent") == name]
    own, total = sum(masses.get(name, 0.0) for name in group), sum(masses.values())
    require(
        own < 0.5 * total or own == total,  # all of it: there is no arm, which is an error later
        f"has a free base, '{roots[0]}' with {short(own, 4)} of {short(total, 4)} kg; leave "
        f"out --bus-mass, or join an arm to a link '{WORLD}' by a fixed joint",
    )


def _free(name: str, taken: list[str]) -> str:
    while name in taken:
        name += "_"
    return name
