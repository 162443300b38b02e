"""Spacecraft with two equal arms, mirrored at the plane x = 0, that hold a target together."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ffsm_drake import Scenario, load_scenario

# number of joints -> axes, lengths and joints of the left arm, its place on the base
ARMS = {
    3: ("zzz", (0.25, 0.18, 0.137), (np.pi / 3, -np.pi / 2, -np.pi / 3), (-0.16, 0.08, 0.0)),
    6: ("zyyxyx", (0.18, 0.62, 0.62, 0.12, 0.12, 0.12), (0.6, -0.6, 1.8, 0.5, 1.2, 0.2),
        (-0.6, 0.0, 1.0)),
    7: ("zyzyxyx", (0.18, 0.4, 0.4, 0.4, 0.12, 0.12, 0.12), (0.4, -1.2, 0.3, 1.9, 0.3, 1.0, 0.2),
        (-0.6, 0.0, 1.0)),
}  # fmt: skip


def two_arms(
    folder: Path,
    axes: str,
    lengths: Sequence[float],
    joints: Sequence[float],
    *,
    place: Sequence[float] = (-0.6, 0.0, 1.0),
    moved: float = 0.15,
    right: str | None = None,
    overrides: Sequence[str] = (),
) -> Scenario:
    """A scenario of a spacecraft whose arms have given joints.

    Args:
      folder: for the URDFs.
      axes: "x", "y" or "z" of each joint of the left arm; links extend along z, in a plane along y.
      lengths: of the links, m.
      joints: the left arm's, in the initial posture, rad.
      place: of the left arm on the base.
      moved: change of the left arm's joints to the target posture, rad.
      right: axes of the right arm, if others.
      overrides: further ones.
    """
    along = np.array([0.0, 1.0, 0.0] if set(axes) == {"z"} else [0.0, 0.0, 1.0])
    signs = {"x": 1.0, "y": -1.0, "z": -1.0}
    arms = {
        "left": (axes, np.array(place), list(joints)),
        "right": (
            right or axes,
            np.array(place) * [-1, 1, 1],
            [signs[axis] * angle for axis, angle in zip(axes, joints, strict=True)],
        ),
    }
    urdf = [f'<robot name="servicer"><link name="base">{inertial(100, 20)}</link>']
    hands = {}
    for side, (own, start, angles) in arms.items():
        parent, at, turn, where = "base", start, Rotation.identity(), np.zeros(3)
        for k, (axis, length) in enumerate(zip(own, lengths, strict=False)):
            unit = np.array([axis == each for each in "xyz"], dtype=float)
            urdf.append(
                f'<link name="{side}{k}">{inertial(2, 0.02, along * length / 2)}</link>'
                f'<joint name="{side}_{k + 1}" type="continuous">'
                f'<parent link="{parent}"/><child link="{side}{k}"/><origin xyz="{text(at)}"/>'
                f'<axis xyz="{text(unit)}"/></joint>'
            )
            where, parent = where + turn.apply(at), f"{side}{k}"
            turn = turn * Rotation.from_rotvec(unit * angles[k])
            at = along * length
        where = where + turn.apply(at)
        urdf.append(f'<frame name="{side}_hand" link="{parent}" xyz="{text(at)}" rpy="0 0 0"/>')
        hands[side] = where, turn
    middle = 0.5 * (hands["left"][0] + hands["right"][0])
    target = [f'<robot name="debris"><link name="debris">{inertial(20, 2)}</link>']
    for side, (where, turn) in hands.items():
        rpy = text(turn.as_euler("xyz"))
        target.append(
            f'<frame name="{side}_grasp" link="debris" xyz="{text(where - middle)}" rpy="{rpy}"/>'
        )
    for name, lines in (("servicer", urdf), ("debris", target)):
        (folder / f"{name}.urdf").write_text("\n".join([*lines, "</robot>"]))
    others = dict.fromkeys([f"joint_{k}" for k in range(1, 6)])
    postures = [
        others
        | {f"left_{k + 1}": angle + change for k, angle in enumerate(joints)}
        | {f"right_{k + 1}": float(arms["right"][2][k]) for k in range(len(right or axes))}
        for change in (0.0, moved)
    ]
    given = {
        "model": {
            "directives": None,
            "servicer": str(folder / "servicer.urdf"),
            "debris": str(folder / "debris.urdf"),
            "end_effector": "servicer::left_hand",
            "grasp": "debris::left_grasp",
        },
        "contacts": {
            side: {"effector": f"servicer::{side}_hand", "frame": f"debris::{side}_grasp"}
            for side in hands
        },
        "initial_posture": {"joints": postures[0]},
        "target_posture": {"joints": postures[1]},
        "disturbance": {"harmonics": others},
        "payload": {
            "truth": {"mass": 25.0, "inertia": [2.5, 2.5, 2.5]},
            "nominal": {"mass": 20.0, "inertia": [2.0, 2.0, 2.0]},
        },
        "reference": {"base_rotation": "eigenaxis"},
    }
    return load_scenario("postcapture", [given, *overrides])


def inertial(mass: float, inertia: float, place: Sequence[float] = (0.0, 0.0, 0.0)) -> str:
    moments = " ".join(f'i{axis}{axis}="{inertia}"' for axis in "xyz")
    return (
        f'<inertial><origin xyz="{text(np.array(place))}"/><mass value="{mass}"/>'
        f'<inertia {moments} ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def text(vector: np.ndarray) -> str:
    return " ".join(map(repr, np.asarray(vector).tolist()))
