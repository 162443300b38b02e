"""The elements of a URDF, read and checked one by one: names, numbers, joints, masses."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from ffsm_drake.spacecraft.checked_urdf import read_limits, require

WORLD = "world"
_MOVING = ("revolute", "continuous", "prismatic")
_TURN, _STROKE = 2.2, 0.5  # rad, m, from the resting position at most; m: without limits


@dataclasses.dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint of the URDF."""

    name: str
    kind: str  # revolute, continuous, prismatic, fixed
    parent: str
    child: str
    lower: float  # rad or m; minus infinity if unlimited
    upper: float
    effort: float  # N m or N; infinite if not given
    velocity: float  # rad/s or m/s; infinite if not given
    offset: float  # distance from the parent's origin, m

    @property
    def moves(self) -> bool:
        return self.kind in _MOVING

    @property
    def is_limited(self) -> bool:
        """True if its limits are meaningful; generators write huge ones for unknown limits."""
        return self.upper - self.lower < 20.0

    @property
    def _margin(self) -> float:
        """A tenth of the range, which a motion keeps to the limits, rad or m."""
        return 0.1 * (self.upper - self.lower) if self.is_limited else 0.0

    @property
    def rest(self) -> float:
        """Position nearest to 0 with the margin to the limits, rad or m."""
        return min(max(0.0, self.lower + self._margin), self.upper - self._margin)

    @property
    def range(self) -> tuple[float, float]:
        """Part of the range that a motion may use, rad or m."""
        way = _TURN
        if self.unit == "m":
            way = math.inf if self.is_limited else _STROKE
        return (
            max(self.lower + self._margin, self.rest - way),
            min(self.upper - self._margin, self.rest + way),
        )

    @property
    def unit(self) -> str:
        return "m" if self.kind == "prismatic" else "rad"


def name_of(element: Element) -> str:
    """Return the name of a link, joint or frame, which ``check`` has checked."""
    return element.get("name", "")


def listed(names: list[str]) -> str:
    """Return the first of some names, and the number of the others."""
    return ", ".join(names[:4]) + f" and {len(names) - 4} more" * (len(names) > 4)


def end_of(joint: Element, role: str) -> str:
    """Return the link that a joint names as its ``parent`` or ``child``."""
    end = joint.find(role)
    link = "" if end is None else end.get("link", "")
    require(link, f"joint '{name_of(joint)}': has no <{role} link=...>")
    return link


def roots_of(root: Element) -> list[str]:
    """Return the links of a URDF that are no joint's child, without the world."""
    held = {end_of(joint, "child") for joint in root.findall("joint")}
    links = map(name_of, root.findall("link"))
    return [link for link in links if link not in held and link != WORLD]


def vector(element: Element | None, attribute: str, default: str = "0 0 0") -> np.ndarray:
    """Return three numbers, which ``check`` has checked; the default if there is no element or no
    attribute.
    """
    text = default if element is None else element.get(attribute, default)
    return np.array(text.split(), dtype=float)


def origin_of(element: Element | None) -> RigidTransform:
    """Return the pose of the <origin> of a joint or an inertial; the identity without one."""
    origin = None if element is None else element.find("origin")
    return RigidTransform(RollPitchYaw(vector(origin, "rpy")), vector(origin, "xyz"))


def package_folders(package: str, source: Path, packages: Mapping[str, Path]) -> Iterator[Path]:
    """Return where the folder of a package may be: as given in ``packages``, else above a file
    ``source``.
    """
    if package in packages:
        yield packages[package]
    yield from (above if above.name == package else above / package for above in source.parents)


def found_file(
    address: str, source: Path, packages: Mapping[str, Path], *, is_model: bool = False
) -> Path | None:
    """Return the file of an address: a path relative to a file ``source``, or a URL. For the folder
    of a model in SDFormat, it is the file that the model names.
    """
    scheme, _, rest = address.rpartition("://")
    if scheme in ("", "file"):
        candidates = [source.parent / rest]
    else:
        package, _, inside = rest.partition("/")
        candidates = [folder / inside for folder in package_folders(package, source, packages)]
    if is_model:
        candidates = [each / "model.sdf" if each.is_dir() else each for each in candidates]
    return next((file.resolve() for file in candidates if file.is_file()), None)


def read_joint(element: Element) -> Joint:
    name = name_of(element)
    lower, upper, effort, velocity = read_limits(element)
    return Joint(
        name=name,
        kind=element.get("type", ""),
        parent=end_of(element, "parent"),
        child=end_of(element, "child"),
        lower=lower,
        upper=upper,
        effort=effort,
        velocity=velocity,
        offset=float(np.linalg.norm(vector(element.find("origin"), "xyz"))),
    )


def check_kind(joint: Joint) -> None:
    """Raise ModelError unless the joint has one degree of freedom or none."""
    require(
        joint.moves or joint.kind == "fixed",
        f"joint '{joint.name}' must be {', '.join(_MOVING)} or fixed, not '{joint.kind}'; replace "
        "it with single joints, and links without <inertial> between them",
    )
