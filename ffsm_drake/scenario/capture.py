"""The section ``capture``: the grasp of a moving target, and the approach to it."""

import math
from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import (
    ORIGIN,
    ZERO,
    PerCoordinate,
    choice_of,
    sample_problems,
    undriven_problems,
    unitless,
    vector_in,
)
from ffsm_drake.scenario.model import Posture
from ffsm_drake.scenario.target_sensing import Measured

CAPTURE_AXES = ("target", "world")


@dataclass
class Approach:
    """The servicer's motion from rest to ``initial_posture`` at the grasp, without the target."""

    duration: float = setting(
        20.0,
        "s",
        "time from the start of the approach to the grasp; a whole number of control samples",
        above=0,
    )
    posture: Posture = unitless(Posture(), "initial posture of the servicer, at rest")
    start: str = choice_of(
        "given",
        'initial posture: "given", as in posture, or "clear": base near the grasp, joints as in '
        "posture or at the grasp, so that the planned approach keeps clear of the tumbling target",
        "given",
        "clear",
    )
    margin: float = setting(
        0.0,
        "m",
        'extra clearance for "clear" starts and retries, to cover navigation error',
        least=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for whole samples, time left after the approach, every coordinate driven, no frame
        and a rigid target.
        """
        for name, part in scenario.model.flexible.items():
            if part.kind not in ("joint", "gear") and part.body == scenario.payload.body:
                yield (
                    f"model.flexible.{name}.body",
                    f"'{part.body}' is the target, which must be rigid before the grasp; remove "
                    f"{key}",
                )
        if scenario.undriven:
            yield key, "needs all coordinates driven; set actuation.driven: [all], or remove it"
        if scenario.reference.frame is not None:
            yield key, "is not compatible with reference.frame; set one of them to null"
        yield from sample_problems(self.duration, scenario.sample_time, f"{key}.duration")
        if scenario.grasp_time > scenario.duration - scenario.sample_time:
            yield (
                f"{key}.duration",
                f"must leave time for the stop before the run ends at {scenario.duration:g} s; "
                "lengthen duration",
            )


@dataclass
class Compliance:
    """Springs and dampers in place of the rigid gripper. They give the force and duration of the
    grasp; the run uses the plastic grasp.
    """

    stiffness: float = setting(5e4, "N/m", "stiffness of the spring at the grasp", above=0)
    damping: float = setting(1e3, "N s/m", "damping of the damper beside it", above=0)
    rotational_stiffness: float = setting(1e4, "N m/rad", "likewise, against rotation", above=0)
    rotational_damping: float = setting(500.0, "N m s/rad", "likewise", above=0)


@dataclass
class Closing:
    """The gripper's jaws as they close on the target, at the end of the approach.

    Springs and dampers (``capture.compliance``) draw the grasp frames together. Their force is at
    most what preloaded jaws hold by friction, and grows with the preload while the jaws close.
    """

    time: float = setting(0.5, "s", "time in which the jaws close and the preload grows", above=0)
    hold: float = setting(
        0.5,
        "s",
        "time with closed jaws before the grasp is made, unless the target has slipped",
        above=0,
    )
    preload: float = setting(500.0, "N", "preload of each of the two closed jaws", above=0)
    friction: float = setting(0.3, "1", "friction coefficient between jaws and target", above=0)
    radius: float = setting(
        0.1, "m",
            "radius over which the load of each jaw is spread; lever of the friction against "
            "rotation",
        above=0,
    )  # fmt: skip
    axis: list[float] = vector_in(
        [0.0, 0.0, 1.0], "1", "direction in which the palm pushes, end-effector axes"
    )
    joints: str = choice_of(
        "limp",
        'mode of the arm while the jaws close: "limp", motors keep their last force and damp, or '
        '"controlled", by a law without a model of the target',
        "limp",
        "controlled",
    )
    joint_damping: float = setting(
        2.0,
        "N m s/rad or N s/m",
        "damping of a limp joint, relative to its rate at the first contact",
        least=0,
    )
    rest: float = setting(
        0.01,
        "m/s or rad/s",
        "the target is held if its motion in the gripper is slower than this at the end",
        above=0,
    )

    @property
    def duration(self) -> float:
        """Time from the first contact to the grasp, s."""
        return self.time + self.hold

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for a longer approach, whole samples and a nonzero axis."""
        approach = scenario.capture.approach
        if approach is None or self.duration >= approach.duration:
            yield key, "needs a capture.approach that lasts longer than time and hold together"
        for _, problem in sample_problems(self.duration, scenario.sample_time, key):
            yield key, f"time and hold together {problem}"
        if not any(self.axis):
            yield f"{key}.axis", "must not be zero"


@dataclass
class Retreat:
    """The motion away from a target that the closing gripper failed to capture."""

    tries: int = setting(
        2, "1", "attempts to capture the target, including the first", least=1, most=20
    )
    distance: float = setting(
        2.0,
        "m",
        "distance of the base's straight motion away from the target",
        above=0,
    )
    duration: float = setting(
        20.0,
        "s",
        "duration of the retreat, in which the arm returns to capture.approach.posture",
        above=0,
    )


@dataclass
class Envelope:
    """The largest miss at the end of an approach at which the gripper still holds the target.

    The defaults of position, angle and velocity are the largest misalignment, angle and closing
    rate in the initial contact conditions that the International Docking System Standard recommends
    (interface definition document, revision E, table 3.3.1.1-2). They are those of docking ports,
    not of a gripper; see docs/capture.md.
    """

    position: float | None = setting(
        0.1, "m", "largest distance of the grasp frame from the target's; null: any", above=0
    )
    angle: float | None = setting(
        0.07, "rad", "largest angle between the two frames; null: any", above=0
    )
    velocity: float | None = setting(
        0.1,
        "m/s",
        "largest velocity of the target relative to the end effector; null: any",
        above=0,
    )
    angular_velocity: float | None = setting(
        None,
        "rad/s",
        "largest angular velocity of the target relative to the end effector; null: any",
        above=0,
    )


@dataclass
class Capture:
    """The grasp of a moving target, in ``initial_posture``; the run continues from the state after
    the grasp.
    """

    rate: list[float] = vector_in(
        ORIGIN, "rad/s", "angular velocity of the target before the grasp"
    )
    velocity: list[float] = vector_in(
        ORIGIN, "m/s", "velocity of the target's centre of mass before the grasp"
    )
    axes: str = choice_of(
        "target",
        'axes of rate and velocity: "target", those of the payload body, or "world"',
        *CAPTURE_AXES,
    )
    servicer: str = choice_of(
        "rest",
        'motion of the servicer at the grasp: "rest"; "track_joints" or "track_all": its joints, '
        'or base and joints, follow the grasp frame in weighted least squares; "detumble": as '
        "track_all, with the opposite of the target's angular momentum, so that the stack has "
        'none; "given": at servicer_velocity',
        "rest",
        "track_joints",
        "track_all",
        "detumble",
        "given",
    )
    servicer_velocity: PerCoordinate = setting(
        ZERO, "rad/s or m/s", 'velocity at the grasp, with servicer "given"'
    )
    tracking_length: float = setting(
        1.0,
        "m",
        "length by which angular rates are multiplied in the tracking error",
        above=0,
    )
    tracking_cost: PerCoordinate = setting(
        {"all": 1.0},
        "s/rad or s/m",
        "weight of each rate; among equally good solutions the smallest rates are taken",
        above=0,
    )
    joints: str = choice_of(
        "free",
        'joints at the contact: "free", or "braked", stopped at the grasp',
        "free",
        "braked",
    )
    compliance: Compliance | None = unitless(
        None,
        "compliance of the gripper, for the force of the grasp; null: the force is not computed",
    )
    approach: Approach | None = unitless(
        None, "motion up to the grasp; null: the run begins with the grasp"
    )
    closing: Closing | None = unitless(
        None, "closing of the gripper over time; null: it closes at once and always holds"
    )
    retreat: Retreat | None = unitless(
        None, "retreat after a missed grasp, and further attempts; null: the run ends"
    )
    measured: Measured | None = unitless(
        None, "sensing of the target during the approach; null: its motion is known"
    )
    envelope: Envelope = setting(Envelope())
    accepted_drift: PerCoordinate | None = setting(
        None,
        "rad or m",
        "largest drift of undriven base_rotation and base_position after the grasp; the time at "
        "which it is exceeded is reported; null: no limit",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for speeds below the divergence limit, settings without effect, and time to follow
        a measured target.
        """
        if self.retreat is not None and self.closing is None:
            yield f"{key}.retreat", "has no effect without capture.closing; add capture.closing"
        if self.measured is not None:
            if self.closing is None:
                yield (
                    f"{key}.measured",
                    f"needs {key}.closing, because the gripper meets the target off the plan; "
                    "add it",
                )
            if scenario.blocks.reference is not None:
                yield (
                    f"{key}.measured",
                    "has no effect with blocks.reference; remove one of them",
                )
            lasts = self.measured.last + (0.0 if self.closing is None else self.closing.duration)
            if self.closing and self.approach and lasts >= self.approach.duration:
                yield (
                    f"{key}.measured.last",
                    f"must leave time to follow the target in {key}.approach.duration",
                )
        for name in ("rate", "velocity"):
            fastest = max(map(abs, getattr(self, name)))
            if fastest > scenario.divergence_speed:
                bound = f"divergence_speed ({scenario.divergence_speed:g})"
                yield f"{key}.{name}", f"must be within {bound}, not {fastest:g}"
        if self.servicer != "given" and any(self.servicer_velocity.values()):
            yield (
                f"{key}.servicer_velocity",
                f"has no effect with servicer: {self.servicer}; set servicer: given",
            )
        if scenario.reference.base_rotation != "eigenaxis":
            yield (
                "reference.base_rotation",
                f"must be eigenaxis with capture, not {scenario.reference.base_rotation}, because "
                "the base may turn at the start",
            )
        for group, number in (self.accepted_drift or {}).items():
            place = f"{key}.accepted_drift.{group}"
            yield from undriven_problems(group, place, scenario.undriven)
            if group == "base_rotation" and number >= math.pi:
                yield place, f"must be > 0, below pi, not {number:g}"
