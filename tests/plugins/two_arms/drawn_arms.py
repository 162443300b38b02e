"""Spacecraft whose arms hold a target together: two mirrored at the plane x = 0, or any."""

from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Arm:
    """Axes ("x", "y" or "z" of each joint), lengths of the links (m, along z, in a plane along y),
    joints in the initial posture (rad), place on the base and turn of its first joint."""

    axes: str
    lengths: Sequence[float]
    joints: Sequence[float]
    place: Sequence[float] | np.ndarray
    turn: Rotation = Rotation.identity()


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
      axes, lengths, joints, place: of the left arm, as in ``Arm``.
      moved: change of the left arm's joints to the target posture, rad.
      right: axes of the right arm, if others.
      overrides: further ones.
    """
    signs = {"x": 1.0, "y": -1.0, "z": -1.0}
    mirrored = [signs[axis] * angle for axis, angle in zip(axes, joints, strict=True)]
    others = right or axes
    arms = {
        "left": Arm(axes, lengths, joints, place),
        "right": Arm(
            others, lengths[: len(others)], mirrored[: len(others)], np.multiply(place, [-1, 1, 1])
        ),
    }
    return held_together(folder, arms, moved=moved, overrides=overrides)


def held_together(
    folder: Path, arms: dict[str, Arm], *, moved: float, overrides: Sequence[str] = ()
) -> Scenario:
    """A scenario of a spacecraft with any arms around its target; ``moved`` turns the first arm."""
    urdf = [f'<robot name="servicer"><link name="base">{inertial(100, 20)}</link>']
    hands = {}
    for side, arm in arms.items():
        along = np.array([0.0, 1.0, 0.0] if set(arm.axes) == {"z"} else [0.0, 0.0, 1.0])
        parent, turn, where = "base", arm.turn, np.array(arm.place)
        at, rpy = where, turn.as_euler("xyz")
        for k, (axis, length) in enumerate(zip(arm.axes, arm.lengths, strict=True)):
            unit = np.array([axis == each for each in "xyz"], dtype=float)
            urdf.append(
                f'<link name="{side}{k}">{inertial(2, 0.02, along * length / 2)}</link>'
                f'<joint name="{side}_{k + 1}" type="continuous">'
                f'<parent link="{parent}"/><child link="{side}{k}"/>'
                f'<origin xyz="{text(at)}" rpy="{text(rpy)}"/>'
                f'<axis xyz="{text(unit)}"/></joint>'
            )
            turn = turn * Rotation.from_rotvec(unit * arm.joints[k])
            parent, at, rpy = f"{side}{k}", along * length, np.zeros(3)
            where = where + turn.apply(at)
        urdf.append(f'<frame name="{side}_hand" link="{parent}" xyz="{text(at)}" rpy="0 0 0"/>')
        hands[side] = where, turn.as_euler("xyz")
    middle = np.mean([where for where, _ in hands.values()], axis=0)
    target = [f'<robot name="debris"><link name="debris">{inertial(20, 2)}</link>']
    for side, (where, rpy) in hands.items():
        pose = f'xyz="{text(where - middle)}" rpy="{text(rpy)}"'
        target.append(f'<frame name="{side}_grasp" link="debris" {pose}/>')
    for name, lines in (("servicer", urdf), ("debris", target)):
        (folder / f"{name}.urdf").write_text("\n".join([*lines, "</robot>"]))
    first, others = next(iter(arms)), dict.fromkeys([f"joint_{k}" for k in range(1, 6)])
    postures = [
        others
        | {
            f"{side}_{k + 1}": float(angle) + change * (side == first)
            for side, arm in arms.items()
            for k, angle in enumerate(arm.joints)
        }
        for change in (0.0, moved)
    ]
    given = {
        "model": {
            "directives": None,
            "servicer": str(folder / "servicer.urdf"),
            "debris": str(folder / "debris.urdf"),
            "end_effector": f"servicer::{first}_hand",
            "grasp": f"debris::{first}_grasp",
        },
        "contacts": {
            side: {"effector": f"servicer::{side}_hand", "frame": f"debris::{side}_grasp"}
            for side in arms
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
