"""Captures from a posture near the posture at the grasp, so that a few seconds are enough."""

_PLACE = "base_position: [0.1, 0.3, -0.2], base_rpy: [0.11, 0.08, -0.1]"
_NEAR = "{joint_1: 0.15, joint_2: 0.33, joint_3: 1.1, joint_4: 0.5, joint_5: -0.75}"
_GOAL = "{joint_1: 0.2, joint_2: 0.35, joint_3: 0.95, joint_4: 0.8, joint_5: -0.6}"
TO_GOAL = f"target_posture={{{_PLACE}, joints: {_GOAL}}}"


def approach(duration):
    """An override of ``tumbling_capture``: an approach that lasts this long, s."""
    return f"capture.approach={{duration: {duration}, posture: {{{_PLACE}, joints: {_NEAR}}}}}"


SHORT = ["reference.duration=3", approach(2), TO_GOAL]
