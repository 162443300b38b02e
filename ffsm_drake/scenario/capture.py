"""The section ``capture``: the grasp of a moving target, and the approach to it."""

import math
from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting, settings_of
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
    """The motion of the servicer from rest to ``initial_posture``, without the target."""

    duration: float = setting(
        20.0,
        "s",
        "time from the start of the approach to the grasp, a whole number of control samples",
        above=0,
    )
    posture: Posture = unitless(
        Posture(), "posture of the servicer at rest, at the start of the approach"
    )
    start: str = choice_of(
        "given",
        'start of the approach: "given": ``posture``; "clear": base near the grasp, joints as in '
        "``posture`` or at the grasp, such that the planned approach does not touch the target",
        "given",
        "clear",
    )
    margin: float = setting(
        0.0,
        "m",
        'distance added to ``clearance`` in "clear" starts and further attempts, for navigation '
        "error",
        least=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for whole samples, time left after the approach, and a rigid target."""
        for name, part in scenario.model.flexible.items():
            if part.kind not in ("joint", "gear") and part.body == scenario.payload.body:
                yield (
                    f"model.flexible.{name}.body",
                    f"'{part.body}' is the target, which must be rigid before the grasp; remove "
                    f"{key}",
                )
        yield from sample_problems(self.duration, scenario.sample_time, f"{key}.duration")
        if scenario.grasp_time > scenario.duration - scenario.sample_time:
            yield (
                f"{key}.duration",
                f"must leave time for the stop before the run ends at {scenario.duration:g} s; "
                "lengthen duration",
            )


@dataclass
class Compliance:
    """Springs and dampers of the gripper, from which the force and duration of a grasp are
    computed.

    The run itself uses the plastic grasp.
    """

    stiffness: float = setting(
        5e4, "N/m", "translational stiffness of the gripper at the grasp frame", above=0
    )
    damping: float = setting(
        1e3, "N s/m", "translational damping of the gripper at the grasp frame", above=0
    )
    rotational_stiffness: float = setting(
        1e4, "N m/rad", "rotational stiffness of the gripper at the grasp frame", above=0
    )
    rotational_damping: float = setting(
        500.0, "N m s/rad", "rotational damping of the gripper at the grasp frame", above=0
    )


@dataclass
class Closing:
    """The jaws of the gripper, which close on the target at the end of the approach.

    Springs and dampers (``capture.compliance``) pull the grasp frames together. Friction of the
    preloaded jaws bounds their force, which grows with the preload while the jaws close.
    """

    time: float = setting(
        0.5, "s", "time in which the jaws close and the preload grows to its value", above=0
    )
    hold: float = setting(
        0.5,
        "s",
        "time with closed jaws before the target counts as grasped, unless it has slipped",
        above=0,
    )
    preload: float = setting(
        500.0, "N", "force of each of the two closed jaws on the target", above=0
    )
    friction: float = setting(0.3, "1", "friction coefficient between jaws and target", above=0)
    radius: float = setting(
        0.1, "m",
            "radius of the contact area of each jaw, the lever arm of friction against rotation",
        above=0,
    )  # fmt: skip
    axis: list[float] = vector_in(
        [0.0, 0.0, 1.0], "1", "direction in which the palm pushes, in the axes of the end effector"
    )
    joints: str = choice_of(
        "limp",
        'arm while the jaws close: "limp": motors keep their last force and damp the joints; '
        '"controlled": by the law, with a model without the target',
        "limp",
        "controlled",
    )
    joint_damping: float = setting(
        2.0,
        "N m s/rad or N s/m",
        "damping of a limp joint on its rate relative to the first contact",
        least=0,
    )
    rest: float = setting(
        0.01,
        "m/s or rad/s",
        "largest rate of the target in the gripper at the end of the closing for which it is held",
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
    """The motion away from a target that the closing gripper did not capture."""

    tries: int = setting(
        2, "1", "largest number of attempts to capture the target", least=1, most=20
    )
    distance: float = setting(
        2.0,
        "m",
        "distance by which the base moves straight away from the target",
        above=0,
    )
    duration: float = setting(
        20.0,
        "s",
        "duration of the retreat, in which the arm returns to ``capture.approach.posture``",
        above=0,
    )


@dataclass
class Envelope:
    """The largest errors at the end of an approach for which the gripper still holds the target.

    The defaults of position, angle and velocity are the largest misalignment, angle and closing
    rate in the initial contact conditions that the International Docking System Standard recommends
    (interface definition document, revision E, table 3.3.1.1-2). Those are conditions for docking
    ports, not for a gripper. See docs/capture.md.
    """

    position: float | None = setting(
        0.1,
        "m",
        "largest distance between the grasp frames of end effector and target; null: any",
        above=0,
    )
    angle: float | None = setting(
        0.07,
        "rad",
        "largest angle between the grasp frames of end effector and target; null: any",
        above=0,
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

    def beyond(self, **misses: float) -> str:
        """Return the misses that exceed their bounds, in words; empty if none does."""
        bounds, known = vars(self), settings_of(Envelope)
        return ", ".join(
            f"{name} {miss:.3g} {known[name].unit} (capture.envelope.{name}: {bounds[name]:g})"
            for name, miss in misses.items()
            if bounds[name] is not None and not miss <= bounds[name]
        )


@dataclass
class Capture:
    """The grasp of a moving target in ``initial_posture``.

    The run continues with the state after the grasp.
    """

    rate: list[float] = vector_in(
        ORIGIN, "rad/s", "angular velocity of the target before the grasp"
    )
    velocity: list[float] = vector_in(
        ORIGIN, "m/s", "velocity of the target's centre of mass before the grasp"
    )
    axes: str = choice_of(
        "target",
        'axes of ``rate`` and ``velocity``: "target", the axes of the payload body, or "world"',
        *CAPTURE_AXES,
    )
    servicer: str = choice_of(
        "rest",
        'motion of the servicer at the grasp: "rest"; "track_joints" or "track_all": joints, or '
        'base and joints, follow the grasp frame in weighted least squares; "detumble": as '
        "track_all, with the opposite of the target's angular momentum, so the stack has no "
        "angular "
        'momentum; "given": ``servicer_velocity``',
        "rest",
        "track_joints",
        "track_all",
        "detumble",
        "given",
    )
    servicer_velocity: PerCoordinate = setting(
        ZERO, "rad/s or m/s", 'velocity of the servicer at the grasp if ``servicer`` is "given"'
    )
    tracking_length: float = setting(
        1.0,
        "m",
        "length by which angular rates are multiplied in the tracking error of track_joints, "
        "track_all and detumble",
        above=0,
    )
    tracking_cost: PerCoordinate = setting(
        {"all": 1.0},
        "s/rad or s/m",
        "weight of each rate in the choice among equally good solutions of track_joints, track_all "
        "and detumble",
        above=0,
    )
    joints: str = choice_of(
        "free",
        'joints at the contact: "free", or "braked", which the grasp stops',
        "free",
        "braked",
    )
    compliance: Compliance | None = unitless(
        None,
        "compliance of the gripper, from which the force of the grasp is computed; null: it is not "
        "computed",
    )
    approach: Approach | None = unitless(
        None, "motion up to the grasp; null: the run begins with the grasp"
    )
    closing: Closing | None = unitless(
        None, "closing of the gripper in time; null: it closes at once and always holds"
    )
    retreat: Retreat | None = unitless(
        None,
        "retreat after a grasp that failed, and further attempts; null: the run ends",
    )
    measured: Measured | None = unitless(
        None, "measurement of the target during the approach; null: its motion is known exactly"
    )
    envelope: Envelope = setting(Envelope())
    accepted_drift: PerCoordinate | None = setting(
        None,
        "rad or m",
        "largest drift of base_rotation and base_position after the grasp, if they are not driven; "
        "reports give the time at which it is exceeded; null: no limit",
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
