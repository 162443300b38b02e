"""The sections ``reference`` and ``planning``: the planned motion."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import (
    PerCoordinate,
    choice_of,
    undriven_problems,
    unitless,
    vector_in,
)

BASE_ROTATIONS = ("eigenaxis", "rpy")
REFERENCE_KINDS = ("quintic", "septic", "optimal")
GOALS = ("target_posture", "stop")


@dataclass
class Shaper:
    """An input shaper: a sum of delayed copies of the motion, whose vibrations cancel."""

    kind: str = choice_of(
        "zv",
        'kind of shaper: "zv", exact at ``frequencies``, or "zvd", twice as long and robust to '
        "frequency errors",
        "zv",
        "zvd",
    )
    frequencies: list[float] = setting(
        [],
        "Hz",
        "frequencies of the vibrations with fixed controlled coordinates; each one uses half a "
        "period of ``reference.duration``, or a whole period with zvd",
        above=0,
        most=1000,
        size=(1, 4),
    )
    damping_ratio: float = unitless(0.005, "damping ratio of the vibrations", least=0, below=1)

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the reference is not a plan."""
        if scenario.reference.kind == "optimal":
            yield key, "has no effect on a plan; set kind: quintic or septic, or shaper: null"


@dataclass
class FrameGoal:
    """A frame with a prescribed pose. The joints follow by the generalized Jacobian.

    The origin moves along a line, and the attitude turns about the eigenaxis. A frame does not
    change the motion of driven base coordinates.
    """

    frame: str | None = unitless(
        None, "scoped name of the prescribed frame; null: ``model.end_effector``"
    )
    task: str = choice_of(
        "pose",
        'prescribed motion of the frame: "pose", "position", "attitude", or "none": the joints '
        "move to target_posture.joints as far as ``hold`` allows",
        "pose",
        "position",
        "attitude",
        "none",
    )
    position: list[float] | None = vector_in(
        None, "m", "final position of the frame's origin in the world; null: the initial position"
    )
    rpy: list[float] | None = vector_in(
        None,
        "rad",
        "final roll, pitch, yaw of the frame in the world; null: the initial attitude",
    )
    hold: list[str] = unitless(
        [],
        "undriven base coordinates, or groups of them, that stay at rest while the joints move "
        "(reaction null space)",
    )
    priority: str = choice_of(
        "hold",
        'priority if ``hold`` and the frame are not both possible: "hold" or "frame"',
        "hold",
        "frame",
    )
    joints: str = choice_of(
        "least",
        'motion of redundant joints: "least", with the smallest rates, or "target_posture", '
        "towards that posture",
        "least",
        "target_posture",
    )
    damping: float = unitless(
        0.05,
        "singular value of the task Jacobian, with 1 rad counted as 1 m, below which joint rates "
        "are damped; rates are then at most 1.09/damping times the twist, and the frame leaves "
        "its path",
        above=0,
    )
    feedback: float = setting(
        2.0, "1/s", "rate at which the plan corrects deviations from the path", least=0, most=100
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the goal is compatible with the task, the reference's goal and the driven
        coordinates.
        """
        reference = scenario.reference
        for name, other in (("position", "attitude"), ("rpy", "position")):
            if getattr(self, name) is None:
                continue
            if self.task in (other, "none"):
                yield f"{key}.{name}", f"has no effect with task: {self.task}; remove it"
            if reference.goal == "stop":
                yield (
                    f"{key}.{name}",
                    "has no effect with goal: stop, which has no final pose; remove it",
                )
        undriven = [
            name
            for group in scenario.undriven
            for name in (group, *(f"{group}_{axis}" for axis in "xyz"))
        ]
        for name in self.hold:
            yield from undriven_problems(name, f"{key}.hold", undriven)


@dataclass
class Reference:
    """The planned motion: a polynomial from the initial to the target posture, or a plan from a
    file.
    """

    kind: str = choice_of(
        "quintic",
        'kind of motion: "quintic", polynomial of fifth order; "septic", of seventh order, without '
        'jerk at the ends; "optimal", the file ``plan`` from `ffsm plan`',
        *REFERENCE_KINDS,
    )
    duration: float | None = setting(
        20.0,
        "s",
        "time to the final posture, which is then held; for `ffsm plan`, the longest duration; "
        "auto or null: the shortest duration within all limits of actuators and joints, with the "
        "nominal payload",
        above=0,
    )
    reserve: float = unitless(
        0.3,
        "share of every force and velocity limit that is kept free if ``duration`` is auto",
        least=0,
        below=1,
    )
    goal: str = choice_of(
        "target_posture",
        'end of the motion: "target_posture", or "stop", where the velocity after the grasp is '
        "removed with the least effort; without a capture, ``initial_velocity`` is removed",
        *GOALS,
    )
    base_rotation: str = choice_of(
        "eigenaxis",
        'rotation of the base: "eigenaxis", the shorter rotation about one fixed axis, or "rpy", '
        "one polynomial for each of roll, pitch and yaw, as in the paper",
        *BASE_ROTATIONS,
    )
    shaper: Shaper | None = unitless(None, "input shaper for the motion; null: no shaper")
    frame: FrameGoal | None = unitless(
        None, "frame with a prescribed pose, which replaces target_posture.joints; null: none"
    )
    plan: str | None = unitless(
        None,
        "file of the plan for kind optimal: a package:// address, or a path relative to the "
        "scenario file; null: none",
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that a plan is named where one is followed, and that the rotation can begin with a
        velocity.
        """
        turning = scenario.stops_from_start and any(
            number and (name == "all" or name.startswith("base_rotation"))
            for name, number in scenario.initial_velocity.items()
        )
        if turning and self.base_rotation == "rpy":
            yield (
                f"{key}.base_rotation",
                "must be eigenaxis: roll, pitch and yaw begin at rest (goal: stop, with an "
                "initial_velocity of the base's rotation)",
            )
        if self.kind == "optimal" and not self.plan:
            yield (
                f"{key}.plan",
                "name the plan's file, such as mine.plan.yaml, which 'ffsm plan' writes, or set "
                "reference.kind to quintic",
            )


@dataclass
class Planning:
    """Settings of `ffsm plan`, which plans a motion to rest at ``reference.goal`` within every
    limit.

    The motion starts at the initial posture and velocity. The limits are ``actuation.limit``, the
    position, velocity and effort limits of the URDFs, ``clearance`` and the limits below. The plan
    minimises time_weight * duration + effort_weight * integral of the squared force, with the
    nominal payload.
    """

    time_weight: float = setting(
        1.0,
        "1/s",
        "weight of the duration in the cost; 0: the motion lasts ``reference.duration``",
        least=0,
    )
    effort_weight: float = setting(
        1e-4,
        "1/(N^2 m^2 s)",
        "weight of the integral of the squared force in the cost; a small weight avoids forces "
        "that do not shorten the motion",
        least=0,
    )
    reserve: float = unitless(
        0.4,
        "share of the force limits that the plan leaves to the controller, for noise, disturbances "
        "and the error of the nominal payload",
        least=0,
        below=1,
    )
    end_rate: float = setting(
        0.0,
        "rad/s or m/s",
        "largest rate at the end of the plan; the controller removes it afterwards",
        least=0,
    )
    velocity_limit: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "largest planned rate, in addition to the limits of the URDFs; null: none",
        above=0,
    )
    impulse_limit: PerCoordinate | None = setting(
        None,
        "N m s or N s",
        "largest time integral of the magnitude of each force; null: none",
        above=0,
    )
    base_attitude_limit: float | None = setting(
        None, "rad", "largest rotation of the base from its initial attitude; null: none", above=0
    )
    segments: int = unitless(
        24,
        "number of spline segments of the plan; more segments come closer to the limits and take "
        "longer to compute",
        least=4,
        most=100,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that there is a cost to minimise."""
        if self.time_weight + self.effort_weight == 0:
            yield f"{key}.time_weight", "must be > 0 where effort_weight is 0"
