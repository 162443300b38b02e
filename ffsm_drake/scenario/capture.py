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
    undriven_problems,
    unitless,
    vector_in,
)
from ffsm_drake.scenario.model import Posture
from ffsm_drake.scenario.target_sensing import Measured

CAPTURE_AXES = ("target", "world")


@dataclass
class Approach:
    """The servicer's motion up to the grasp, without the target: from rest to
    ``initial_posture``.
    """

    duration: float = setting(
        20.0, "s", "the run begins with it; a whole number of control samples", above=0
    )
    posture: Posture = unitless(Posture(), "where the servicer starts, at rest")
    start: str = choice_of(
        "given",
        'where the servicer starts: "given", in posture, or "clear": the base near the grasp, the '
        "joints as in posture or at the grasp, so that the planned approach keeps clear of the "
        "tumbling target",
        "given",
        "clear",
    )
    margin: float = setting(
        0.0,
        "m",
        'beyond clearance, that a "clear" start and the ways to a further try keep, for what the '
        "navigation is off",
        least=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Whole samples, and time left after it; every coordinate driven, no frame."""
        if scenario.undriven:
            yield key, "needs every coordinate driven (actuation.driven); leave it out"
        if scenario.reference.frame is not None:
            yield key, "needs reference.frame: null; leave one of them out"
        samples = self.duration / scenario.sample_time
        if samples < 0.5 or abs(samples - round(samples)) >= 1e-6:
            yield (
                f"{key}.duration",
                f"must be a whole number of control samples of {scenario.sample_time:g} s, not "
                f"{self.duration:g} s",
            )
        if self.duration > scenario.duration - scenario.sample_time:
            yield (
                f"{key}.duration",
                f"must leave time for the stop: the run ends at {scenario.duration:g} s; lengthen "
                "duration",
            )


@dataclass
class Compliance:
    """The gripper as springs and dampers, for the force and the duration of the grasp; the run
    takes the plastic grasp.
    """

    stiffness: float = setting(5e4, "N/m", "of the spring at the grasp", above=0)
    damping: float = setting(1e3, "N s/m", "of the damper beside it", above=0)
    rotational_stiffness: float = setting(1e4, "N m/rad", "likewise, against rotation", above=0)
    rotational_damping: float = setting(500.0, "N m s/rad", "likewise", above=0)


@dataclass
class Closing:
    """The gripper's jaws as they close on the target, at the end of the approach.

    Springs and dampers (``capture.compliance``) draw the grasp frames together. Their force is at
    most what preloaded jaws hold by friction, and grows with the preload while the jaws close.
    """

    time: float = setting(0.5, "s", "in which the jaws close and the preload grows", above=0)
    hold: float = setting(
        0.5, "s", "closed, until the grasp is made or the target has slipped", above=0
    )
    preload: float = setting(500.0, "N", "of each of the two jaws, closed", above=0)
    friction: float = setting(0.3, "1", "coefficient between jaws and target", above=0)
    radius: float = setting(
        0.1, "m", "lever of the friction against rotation: what each jaw bears is spread about it",
        above=0,
    )  # fmt: skip
    axis: list[float] = vector_in(
        [0.0, 0.0, 1.0], "1", "out of the gripper, in the end effector's axes: the palm pushes so"
    )
    joints: str = choice_of(
        "limp",
        'the arm meanwhile: "limp", its motors keep the force that they had and damp, or '
        '"controlled" as before, by a law that knows of no target yet',
        "limp",
        "controlled",
    )
    joint_damping: float = setting(
        2.0,
        "N m s/rad or N s/m",
        "of a limp joint, about its rate at the first contact",
        least=0,
    )
    rest: float = setting(
        0.01, "m/s or rad/s", "the target is held if it then moves less in the gripper", above=0
    )

    @property
    def duration(self) -> float:
        """From the first contact to the grasp, s."""
        return self.time + self.hold

    def check(self, key: str, scenario: Any) -> Problems:
        """An approach that is longer, whole samples, an axis."""
        approach = scenario.capture.approach
        if approach is None or self.duration >= approach.duration:
            yield key, "needs a capture.approach that lasts longer than time and hold together"
        samples = self.duration / scenario.sample_time
        if abs(samples - round(samples)) >= 1e-6:
            yield (
                key,
                f"time and hold together must be whole control samples of "
                f"{scenario.sample_time:g} s, not {self.duration:g} s",
            )
        if not any(self.axis):
            yield f"{key}.axis", "must not be zero"


@dataclass
class Retreat:
    """What follows when a closing gripper does not capture the target, which stays apart."""

    tries: int = setting(2, "1", "to capture the target, the first one included", least=1, most=20)
    distance: float = setting(
        2.0, "m", "by which the base moves straight away from the target", above=0
    )
    duration: float = setting(
        20.0, "s", "of that motion, in which the arm returns to capture.approach.posture", above=0
    )


@dataclass
class Envelope:
    """The largest miss with which the gripper still holds the target at the end of an approach.

    The defaults of position, angle and velocity are the largest misalignment, angle and closing
    rate in the initial contact conditions that the International Docking System Standard recommends
    (interface definition document, revision E, table 3.3.1.1-2). They are those of docking ports,
    not of a gripper; see docs/capture.md.
    """

    position: float | None = setting(
        0.1, "m", "distance of the grasp frame from the target's; null: any", above=0
    )
    angle: float | None = setting(0.07, "rad", "likewise, the angle between them", above=0)
    velocity: float | None = setting(
        0.1, "m/s", "velocity of the target from the end effector; null: any", above=0
    )
    angular_velocity: float | None = setting(
        None, "rad/s", "likewise, of its rotation; null: any", above=0
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
        'how the servicer moves at the grasp: "rest"; "track_joints" or "track_all": its joints, '
        'or base and joints, follow the grasp frame in weighted least squares; "given": at '
        "servicer_velocity",
        "rest",
        "track_joints",
        "track_all",
        "given",
    )
    servicer_velocity: PerCoordinate = setting(
        ZERO, "rad/s or m/s", 'at the grasp, with servicer "given"'
    )
    tracking_length: float = setting(
        1.0,
        "m",
        "tracking weighs 1 rad/s as much as this length times 1 rad/s",
        above=0,
    )
    tracking_cost: PerCoordinate = setting(
        {"all": 1.0},
        "s/rad or s/m",
        "weight of each rate; of rates that track equally well, the least are taken",
        above=0,
    )
    joints: str = choice_of(
        "free",
        'how the joints meet the target: "free", or "braked", which stops them at the grasp',
        "free",
        "braked",
    )
    compliance: Compliance | None = unitless(
        None, "of the gripper, for the force of the grasp; null: it is not computed"
    )
    approach: Approach | None = unitless(
        None, "the motion up to the grasp; null: the run begins with the grasp"
    )
    closing: Closing | None = unitless(
        None, "of the gripper, over a time; null: it closes at once and holds for good"
    )
    retreat: Retreat | None = unitless(
        None, "of a closing gripper that missed the target, and further tries; null: the run ends"
    )
    measured: Measured | None = unitless(
        None, "a target that is measured on the way to it; null: its motion is known"
    )
    envelope: Envelope = setting(Envelope())
    accepted_drift: PerCoordinate | None = setting(
        None,
        "rad or m",
        "largest drift of base_rotation and base_position from the grasp on, where they are not "
        "driven: the time at which it is exceeded is reported; null: no limit",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Speeds that do not count as divergence, and settings that have an effect."""
        if self.retreat is not None and self.closing is None:
            yield f"{key}.retreat", "has no effect without capture.closing; give that too"
        for name in ("rate", "velocity"):
            fastest = max(map(abs, getattr(self, name)))
            if fastest > scenario.divergence_speed:
                bound = f"divergence_speed ({scenario.divergence_speed:g})"
                yield f"{key}.{name}", f"must be within {bound}, not {fastest:g}"
        if self.servicer != "given" and any(self.servicer_velocity.values()):
            yield (
                f"{key}.servicer_velocity",
                f"has no effect with servicer: {self.servicer}; take servicer: given",
            )
        if scenario.reference.base_rotation != "eigenaxis":
            yield (
                "reference.base_rotation",
                f"must be eigenaxis with capture, not {scenario.reference.base_rotation}: the base "
                "may turn at the start",
            )
        for group, number in (self.accepted_drift or {}).items():
            place = f"{key}.accepted_drift.{group}"
            yield from undriven_problems(group, place, scenario.undriven)
            if group == "base_rotation" and number >= math.pi:
                yield place, f"must be > 0, below pi, not {number:g}"
