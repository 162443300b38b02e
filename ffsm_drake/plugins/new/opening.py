"""Open hands around a target: before a capture, both arms move their hands back along z."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.pacing import SECONDS
from ffsm_drake.plugins.new.postures import Postures
from ffsm_drake.spacecraft.plant import base_body

# Distances between a hand and its place, as shares of the reach of its arm; the most is best.
_OPEN = (0.25, 0.17, 0.1, 0.05)
_PARTS, _STEPS, _REACHED = 20, 60, 1e-9  # parts of a way; steps of the inverse kinematics; rad, m
_SINGULAR = 0.02  # least singular value of an arm, with its reach as the unit of length
# s: in a longer approach more faces of the target pass the hands; a longer motion leaves the reach
_APPROACH, _MOTION = 2 * SECONDS, 3 * SECONDS


def openings(
    postures: Postures, joints: np.ndarray, hands: list[tuple[Frame, np.ndarray, float]]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield joints at the first grasp and at the start of the approach, the widest first.

    At the grasp, only the first hand is at its place.

    Args:
      postures: the positions of the joints.
      joints: all joints (n) with both hands on the target, rad or m.
      hands: frame of each hand, indices of the joints of its arm, and reach of the arm, m.
    """
    ways = [[_withdrawn(postures, joints, *hand, share) for share in _OPEN] for hand in hands]
    before: tuple[int, ...] = ()
    for k in range(len(_OPEN)):
        # the first feasible share from this one on, of each hand
        which = tuple(next((i for i in range(k, len(_OPEN)) if each[i] is not None), -1)
                      for each in ways)  # fmt: skip
        if -1 in which or which == before:
            continue
        before = which
        (first, second) = (each[i] for each, i in zip(ways, which, strict=True))
        assert first is not None
        assert second is not None
        grasp, start = joints.copy(), first.copy()
        arm = hands[1][1]
        grasp[arm] = start[arm] = second[arm]
        yield grasp, start


def open_capture(draft: Draft, grasp: dict[str, float], start: dict[str, float]) -> None:
    """Set a capture that begins with open hands; the second one closes some seconds later.

    Args:
      draft: the scenario to be changed.
      grasp: joints at the first grasp, by name, rad or m.
      start: joints at the start of the approach.
    """
    data: dict[str, Any] = draft.data
    data["initial_posture"]["joints"] = grasp
    second = list(data["contacts"])[1]
    data["contacts"][second]["closes"] = SECONDS
    data["reference"]["duration"] = min(data["reference"]["duration"], _MOTION)
    data["capture"].pop("tracking_length", None)
    approach = data["capture"]["approach"]
    approach |= {
        "duration": min(approach["duration"], _APPROACH),
        "start": "clear",
        "posture": {"base_rpy": list(data["initial_posture"]["base_rpy"]), "joints": start},
    }


def _withdrawn(
    postures: Postures, joints: np.ndarray, hand: Frame, arm: np.ndarray, reach: float, share: float
) -> np.ndarray | None:
    """Return the joints (n) with a hand moved back by a share of the reach; None: it cannot."""
    joints, base = joints.copy(), base_body(postures.plant).body_frame()
    postures.set(joints)
    begin = hand.CalcPose(postures.context, base)
    for k in range(_STEPS):
        part = share * reach * min(1.0, (k + 1) / _PARTS)
        goal = begin @ RigidTransform([0.0, 0.0, -part])
        now = hand.CalcPose(postures.context, base)
        turn = rotation_error(
            goal.rotation().ToQuaternion().wxyz(), now.rotation().ToQuaternion().wxyz()
        )
        off = np.concatenate([turn, goal.translation() - now.translation()])
        if k >= _PARTS and np.abs(off).max() < _REACHED:
            return joints
        least = postures.dexterity(joints, hand, arm, reach)[: min(arm.size, 6)].min()
        if least < _SINGULAR and arm.size >= 6:
            return None
        jacobian = postures.jacobian(hand, base)[:, arm]
        joints[arm] += np.linalg.lstsq(jacobian, off, rcond=1e-6)[0]
        if not ((joints >= postures.low) & (joints <= postures.high)).all():
            return None
        postures.set(joints)
    return None
