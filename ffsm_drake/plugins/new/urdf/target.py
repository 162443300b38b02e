"""Reading a URDF as a target: one rigid body with mass, and the frame where it is held."""

import dataclasses
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RollPitchYaw

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.new.urdf.elements import (
    name_of,
    read_inertia,
    read_mass,
    vector,
)
from ffsm_drake.spacecraft.checked_urdf import parse, require

GRASP = "grasp"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """A URDF read as a target."""

    source: Path
    body: str
    grasp: str  # frame
    mass: float  # kg
    center_of_mass: tuple[float, ...]  # m, in the body's frame
    inertia: tuple[float, ...]  # kg m^2 about it: Ixx, Iyy, Izz, Ixy, Ixz, Iyz, in the body's axes
    root: Element  # the parsed file
    header: str  # the comments before its root element

    @property
    def base_links(self) -> tuple[str, ...]:
        return (self.body,)

    @property
    def reach(self) -> float:
        return 0.0


def read_target(path: Path) -> Target:
    """Read and check a URDF. Raises ModelError unless it is one rigid body with a grasp frame."""
    try:
        root, header = parse(path, "its URDF")
        links = root.findall("link")
        heavy = [link for link in links if read_mass(link)]
        names = ", ".join(name_of(link) for link in heavy) or "none"
        require(
            len(heavy) == 1, f"one link must have the target's mass, not {len(heavy)} ({names})"
        )
        moving = [name_of(joint) for joint in root.findall("joint") if joint.get("type") != "fixed"]
        require(
            not moving, f"a target is rigid, but joint '{', '.join(moving)}' moves; make it fixed"
        )
        body = name_of(heavy[0])
        frames = [name_of(frame) for frame in root.findall("frame")]
        require(
            GRASP in frames or len(frames) == 1,
            f"{'more than one frame' if frames else 'no frame'} where it could be held; add "
            f'<frame name="{GRASP}" link="{body}" xyz="0 0 -0.5" rpy="0 0 0"/>, on its surface, '
            "with z into the target",
        )
        origin, place = heavy[0].find("inertial/origin"), f"link '{body}'"
        require(
            heavy[0].find("inertial/inertia") is not None,
            f"{place}: has mass but no <inertia>; give it both",
        )
        tensor = read_inertia(heavy[0])
        rotation = RollPitchYaw(vector(origin, "rpy", place)).ToRotationMatrix().matrix()
        tensor = rotation @ tensor @ rotation.T
        scale = max(float(np.abs(tensor).max()), 1e-300)
        # no products of 1e-16 in place of zeros
        tensor = scale * np.round(tensor / scale, 12) + 0.0
        return Target(
            source=path,
            body=body,
            grasp=GRASP if GRASP in frames else frames[0],
            mass=read_mass(heavy[0]),
            center_of_mass=tuple(vector(origin, "xyz", place).tolist()),
            inertia=tuple(
                float(tensor[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
            ),
            root=root,
            header=header,
        )
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None
