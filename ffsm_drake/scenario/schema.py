"""The scenario's dataclasses: every key as a setting (see ``common.settings``).

Values given per coordinate (gains, disturbances, joint angles) are mappings whose keys are ``all``,
a group (``base_rotation``, ``base_position``, ``joints``) or one coordinate's name; the more
specific key wins, and a bare number stands for ``{all: number}``.
"""

import functools
import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml
from pydrake.systems.analysis import SimulatorConfig

from ffsm_drake.common.errors import did_you_mean
from ffsm_drake.common.settings import Problems, setting, unknown

PerCoordinate = dict[str, float]
BASE_ROTATIONS = ("eigenaxis", "rpy")
REFERENCE_KINDS = ("quintic", "septic", "optimal")
ESTIMATOR_KINDS = ("one_sample", "kalman", "coupled")
CAPTURE_AXES = ("target", "world")
GOALS = ("target_posture", "stop")
# What ``actuation.driven`` may name, together.
DRIVEN = (("base_rotation", "base_position", "joints"), ("base_rotation", "joints"), ("joints",))
FIXED_STEP_SCHEMES = ("explicit_euler", "runge_kutta2", "semi_explicit_euler")  # no error estimate
MAX_SAMPLES = 10_000_000
MAX_STEPS = 1_000_000_000  # of the integrator; hours
_BYTES_PER_SAMPLE = 4000  # of a run's logs and record, for the estimate in an error
_NAME = re.compile(r"[^\W\d]\w*|[^\W\d]\w*(\.\w+)*:[^\W\d]\w*(\.\w+)*")  # or module:attribute
_ORIGIN, _X = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]
_ZERO = {"all": 0.0}


def _unitless(default: Any, meaning: str, **limits: Any) -> Any:
    return setting(default, "", meaning, **limits)


def _choice(default: str | None, meaning: str, *one_of: str) -> Any:
    return _unitless(default, meaning, one_of=one_of)


def _samples(default: Any, meaning: str, least: int = 0) -> Any:
    return setting(default, "control samples", meaning, least=least, most=1000)


def _vector(default: list[float] | None, unit: str, meaning: str, **limits: Any) -> Any:
    return setting(default, unit, meaning, size=(3, 3), **limits)


@dataclass
class Flexible:
    """A flexible part of the true spacecraft, which the controller's model treats as rigid.

    The mass of a panel, a beam, a sloshing mass or a pendulum is part of the body that carries it.
    """

    kind: str = _choice(
        "panel",
        '"panel": plates on hinges; "beam": bending modes of a uniform cantilever; "mass": a point '
        'mass on a spring, such as slosh; "pendulum": a point mass on a rod; "joint": a joint of '
        'the model that a spring holds and no drive moves; "gear": a spring between the rotor of a '
        "joint's drive (actuation.drives.rotor_inertia) and its link",
        "panel",
        "beam",
        "mass",
        "pendulum",
        "joint",
        "gear",
    )
    body: str = _unitless(
        "servicer::base", "scoped name of the body that carries a panel, beam, mass or pendulum"
    )
    joint: str | None = _unitless(None, "the model's joint, for joint and gear")
    position: list[float] = _vector(
        _ORIGIN,
        "m",
        "position of the hinge, the root, the pendulum's pivot, or the mass at rest, in the body's "
        "frame",
    )
    direction: list[float] = _vector(
        [0.0, 1.0, 0.0],
        "",
        "from the hinge, root or pivot outwards, or along which the mass moves, in the body's "
        "frame; of any length",
        nonzero=True,
    )
    axis: list[float] = _vector(
        _X,
        "",
        "axis of the hinge or of bending, across ``direction``, in the body's frame; of any length",
        nonzero=True,
    )
    mass: float = setting(
        2.0, "kg", "of the panel, the beam, the sloshing mass or the pendulum", above=0
    )
    length: float = setting(3.0, "m", "of the panel, the beam or the pendulum's rod", above=0)
    width: float = setting(1.0, "m", "of the panel, along the axis", above=0)
    plates: int = _unitless(
        1,
        "number of plates of a panel, in a row, of equal length, each on a hinge",
        least=1,
        most=10,
    )
    frequency: float | None = setting(
        None,
        "Hz",
        "natural frequency with the body held: of a panel its lowest; of a joint or gear in the "
        "zero posture; null with stiffness",
        above=0,
    )
    frequencies: list[float] = setting(
        [],
        "Hz",
        "natural frequencies of a beam's first modes, its root held",
        above=0,
        size=(0, 5),
    )
    stiffness: float | None = setting(
        None,
        "N m/rad or N/m",
        "of each hinge, or of the mass's spring; null with frequency",
        above=0,
    )
    damping_ratio: float = _unitless(
        0.005, "at the frequency, or of each mode of a beam", least=0, below=1
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """One stiffness, and only what the kind uses."""
        of_joint = self.kind in ("joint", "gear")
        along, axis = (np.divide(v, np.linalg.norm(v)) for v in (self.direction, self.axis))
        if not of_joint and self.kind != "mass" and abs(along @ axis) >= 1e-6:
            yield f"{key}.axis", f"must be across direction {self.direction}, not {self.axis}"
        if of_joint != (self.joint is not None):
            unused = f"has no effect on a {self.kind}; leave it out"
            yield f"{key}.joint", "name the joint of the model" if of_joint else unused
        given = (self.frequency is not None) + (self.stiffness is not None)
        if self.kind == "beam":
            if given:
                yield f"{key}.frequency", "a beam takes frequencies, of its modes; leave it out"
            if not self.frequencies:
                yield f"{key}.frequencies", "give the frequencies of 1 to 5 modes, Hz"
        else:
            if self.frequencies:
                yield f"{key}.frequencies", f"are of a beam; a {self.kind} takes frequency"
            if given != 1:
                yield f"{key}.frequency", "give either frequency (Hz) or stiffness"
        if scenario.grasp_time > 0 and not of_joint and self.body == scenario.payload.body:
            yield (
                f"{key}.body",
                f"'{self.body}' is the target, which cannot be flexible before it is held; leave "
                "capture.approach out",
            )
        drives = scenario.actuation.drives
        rotors = {} if drives is None else drives.rotor_inertia or {}
        rotor = next((rotors[key] for key in (self.joint, "joints", "all") if key in rotors), 0.0)
        if self.kind == "gear" and rotor == 0:
            yield (
                "actuation.drives.rotor_inertia",
                f"give that of {self.joint}, > 0 kg m^2: the drive turns it against the spring of "
                f"'{key.rpartition('.')[2]}'",
            )


@dataclass
class Model:
    """The models of servicer and target, and the frames that reports refer to.

    Files are package:// addresses or paths; relative paths start at the scenario file's folder.
    """

    directives: str | None = _unitless(
        "package://ffsm_drake/postcapture.dmd.yaml", "model directives; null with servicer"
    )
    servicer: str | None = _unitless(
        None, 'URDF of base and arm, model instance "servicer", in place of directives'
    )
    debris: str = _unitless(
        "package://ffsm_drake/urdf/debris.urdf",
        'with servicer: URDF of the target, model instance "debris"',
    )
    end_effector: str = _unitless(
        "servicer::end_effector", "frame that holds the target; its origin is reported"
    )
    grasp: str = _unitless(
        "debris::grasp", "with servicer: the target's frame that is welded to end_effector"
    )
    packages: dict[str, str] = _unitless({}, "package:// name -> folder, for meshes")
    flexible: dict[str, Flexible] = _unitless(
        {}, "by name: flexible parts, which are rigid in the controller's model"
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """One source of the model."""
        if (self.servicer is None) == (self.directives is None):
            yield key, "give either directives or servicer (a URDF), not both and not neither"
        yield from _identifiers(f"{key}.flexible", self.flexible, "a part's")


@dataclass
class MassProperties:
    """Mass properties of the payload body, in its own frame P."""

    mass: float = setting(100.0, "kg", "mass", above=0)
    center_of_mass: list[float] = _vector(_ORIGIN, "m", "position p_PScm_P of the centre of mass")
    inertia: list[float] = setting(
        [16.7, 16.7, 16.7],
        "kg m^2",
        "about the centre of mass, axes of P: [Ixx, Iyy, Izz] or [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]",
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """The inertia of a rigid body."""
        key = f"{key}.inertia"
        if len(self.inertia) not in (3, 6):
            yield (
                key,
                "must hold three moments [Ixx, Iyy, Izz], or those and three products [Ixy, Ixz, "
                "Iyz]",
            )
            return
        try:
            with np.errstate(all="ignore"):
                principal = np.linalg.eigvalsh(inertia_matrix(self))
        except np.linalg.LinAlgError:
            principal = np.full(3, np.nan)
        if not np.isfinite(principal).all():
            yield key, f"has no principal moments: {self.inertia}"
        elif principal[0] <= 0:
            yield key, "must be positive definite"
        elif principal[0] + principal[1] < principal[2] * (1 - 1e-12):
            yield (
                key,
                f"principal moments {np.round(principal, 6).tolist()} violate the triangle "
                "inequality (the largest must not exceed the sum of the others)",
            )


@dataclass
class Payload:
    """The captured body: its true mass properties, and the nominal ones, which the controller works
    with.
    """

    body: str = _unitless("debris::debris", "scoped name of the captured body in the model")
    truth: MassProperties = setting(MassProperties())
    nominal: MassProperties = setting(MassProperties(mass=80.0, inertia=[12.0, 12.0, 12.0]))


@dataclass
class Posture:
    """A configuration of base and arm."""

    base_position: list[float] = _vector(_ORIGIN, "m", "position p_WB")
    base_rpy: list[float] = _vector(
        _ORIGIN,
        "rad",
        "roll, pitch, yaw of R_WB: rotations about the world's x, y, z axes in that order",
    )
    joints: PerCoordinate = setting(_ZERO, "rad or m", "positions, by joint name")


@dataclass
class Approach:
    """The servicer's motion up to the grasp, without the target: from rest to
    ``initial_posture``.
    """

    duration: float = setting(
        20.0, "s", "the run begins with it; a whole number of control samples", above=0
    )
    posture: Posture = _unitless(Posture(), "where the servicer starts, at rest")

    def check(self, key: str, scenario: "Scenario") -> Problems:
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
class Envelope:
    """The largest miss with which the gripper still holds the target at the end of an approach.

    Position and angle by default, and the velocity, are what a docking mechanism takes at first
    contact (International Docking System Standard, interface definition document, revision E,
    initial contact conditions; there 0.2 deg/s of relative rate too).
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

    rate: list[float] = _vector(_ORIGIN, "rad/s", "angular velocity of the target before the grasp")
    velocity: list[float] = _vector(
        _ORIGIN, "m/s", "velocity of the target's centre of mass before the grasp"
    )
    axes: str = _choice(
        "target",
        'axes of rate and velocity: "target", those of the payload body, or "world"',
        *CAPTURE_AXES,
    )
    servicer: str = _choice(
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
        _ZERO, "rad/s or m/s", 'at the grasp, with servicer "given"'
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
    joints: str = _choice(
        "free",
        'how the joints meet the target: "free", or "braked", which stops them at the grasp',
        "free",
        "braked",
    )
    compliance: Compliance | None = _unitless(
        None, "of the gripper, for the force of the grasp; null: it is not computed"
    )
    approach: Approach | None = _unitless(
        None, "the motion up to the grasp; null: the run begins with the grasp"
    )
    envelope: Envelope = setting(Envelope())
    accepted_drift: PerCoordinate | None = setting(
        None,
        "rad or m",
        "largest drift of base_rotation and base_position from the grasp on, where they are not "
        "driven: the time at which it is exceeded is reported; null: no limit",
        above=0,
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Speeds that do not count as divergence, and settings that have an effect."""
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
            yield from _undriven(group, place, scenario.undriven)
            if group == "base_rotation" and number >= math.pi:
                yield place, f"must be > 0, below pi, not {number:g}"


@dataclass
class Shaper:
    """An input shaper: the motion as a sum of delayed copies of itself whose vibrations cancel."""

    kind: str = _choice(
        "zv",
        '"zv", exact at its frequencies, or "zvd", twice as long and robust to errors of them',
        "zv",
        "zvd",
    )
    frequencies: list[float] = setting(
        [],
        "Hz",
        "of the vibrations, with the controlled coordinates held; the shaper takes half a period "
        "of each out of ``reference.duration``, with zvd a whole one",
        above=0,
        most=1000,
        size=(1, 4),
    )
    damping_ratio: float = _unitless(0.005, "of the vibrations", least=0, below=1)

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Not of a plan."""
        if scenario.reference.kind == "optimal":
            yield key, "has no effect on a plan; take kind quintic or septic, or shaper: null"


@dataclass
class FrameGoal:
    """A frame whose pose the planned motion prescribes; the joints follow by the generalized
    Jacobian.

    The origin goes along a line, the attitude about the eigenaxis. Base coordinates that are driven
    move as without it.
    """

    frame: str | None = _unitless(None, "scoped name; null: ``model.end_effector``")
    task: str = _choice(
        "pose",
        'what is prescribed: the frame\'s "pose", "position" or "attitude", or "none", where the '
        "joints go to target_posture.joints as far as ``hold`` allows",
        "pose",
        "position",
        "attitude",
        "none",
    )
    position: list[float] | None = _vector(
        None, "m", "goal of its origin, world frame; null: where it starts"
    )
    rpy: list[float] | None = _vector(
        None, "rad", "goal of its attitude: roll, pitch, yaw in the world frame; null: as it starts"
    )
    hold: list[str] = _unitless(
        [],
        "undriven base coordinates, or groups of them, which the joints' motion must leave at "
        "rest: reaction null space",
    )
    priority: str = _choice(
        "hold", 'which comes first where not both are possible: "hold", or "frame"', "hold", "frame"
    )
    joints: str = _choice(
        "least",
        'what redundant joints do: "least", least rates, or "target_posture", move towards it',
        "least",
        "target_posture",
    )
    damping: float = _unitless(
        0.05,
        "singular value of the task's Jacobian, radians of the frame counted as metres, below "
        "which joints are damped: no twist takes more than 1.09/damping times its size in joint "
        "rates, and the frame leaves the path instead",
        above=0,
    )
    feedback: float = setting(
        2.0, "1/s", "rate at which the plan corrects deviations from the path", least=0, most=100
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A goal that the task, the reference's goal and the driven coordinates have a use for."""
        reference = scenario.reference
        if reference.kind == "optimal":
            yield key, "has no effect on a plan; take kind quintic or septic, or frame: null"
        for name, other in (("position", "attitude"), ("rpy", "position")):
            if getattr(self, name) is None:
                continue
            if self.task in (other, "none"):
                yield f"{key}.{name}", f"has no effect with task: {self.task}; leave it out"
            if reference.goal == "stop":
                yield (
                    f"{key}.{name}",
                    "has no effect with goal: stop, which ends wherever it can; leave it out",
                )
        undriven = [
            name
            for group in scenario.undriven
            for name in (group, *(f"{group}_{axis}" for axis in "xyz"))
        ]
        for name in self.hold:
            yield from _undriven(name, f"{key}.hold", undriven)


@dataclass
class Reference:
    """The planned motion: from the initial to the target posture by a polynomial, or a plan from a
    file.
    """

    kind: str = _choice(
        "quintic",
        '"quintic", fifth order; "septic", seventh order, without jerk at the ends; or "optimal", '
        "the plan in ``plan``, which 'ffsm plan' computed with the settings of ``planning``",
        *REFERENCE_KINDS,
    )
    duration: float | None = setting(
        20.0,
        "s",
        "the posture at its end is held afterwards; a plan may take no longer; auto (or null): the "
        "shortest that all limits of actuators and joints allow with the nominal payload",
        above=0,
    )
    reserve: float = _unitless(
        0.3,
        "with duration auto: share of every force and velocity limit that the motion leaves free",
        least=0,
        below=1,
    )
    goal: str = _choice(
        "target_posture",
        'where it ends: "target_posture", or "stop", the cheapest place to stop from the velocity '
        "at the start",
        *GOALS,
    )
    base_rotation: str = _choice(
        "eigenaxis",
        'how the base turns: "eigenaxis", the shorter way about one fixed axis, or "rpy", roll, '
        "pitch and yaw each a polynomial, as in the paper",
        *BASE_ROTATIONS,
    )
    shaper: Shaper | None = _unitless(None, "of a polynomial; null: it is not shaped")
    frame: FrameGoal | None = _unitless(
        None, "frame whose pose is prescribed, in place of target_posture.joints; null: none"
    )
    plan: str | None = _unitless(
        None,
        "with optimal: file of the plan, a path from the scenario file's folder or a package:// "
        "address",
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A plan where it is followed."""
        if self.kind == "optimal" and not self.plan:
            yield (
                f"{key}.plan",
                "name the plan's file, such as mine.plan.yaml, which 'ffsm plan' writes, or set "
                "reference.kind to quintic",
            )


@dataclass
class Planning:
    """How 'ffsm plan' plans: a motion from the initial posture and velocity to
    ``reference.goal``, at rest, within every limit.

    The limits are those of ``actuation.limit``, the URDFs' of position, velocity and effort,
    ``clearance`` and the ones here. It minimises time_weight * duration + effort_weight * integral
    of the squared force, with the nominal payload.
    """

    time_weight: float = setting(
        1.0, "1/s", "weight of the duration; 0: the motion takes reference.duration", least=0
    )
    effort_weight: float = setting(
        1e-4,
        "1/(N^2 m^2 s)",
        "weight of the integral of the squared force; a small one avoids forces that do not "
        "shorten the motion",
        least=0,
    )
    reserve: float = _unitless(
        0.4,
        "share of the force limits that is left to the controller: for noise, disturbances, and "
        "the error of the nominal payload",
        least=0,
        below=1,
    )
    end_rate: float = setting(
        0.0,
        "rad/s or m/s",
        "every rate at the end is at most this, and then dies away",
        least=0,
    )
    velocity_limit: PerCoordinate | None = setting(
        None, "rad/s or m/s", "largest rate, beside the URDFs'; null: none", above=0
    )
    impulse_limit: PerCoordinate | None = setting(
        None, "N m s or N s", "largest integral of each force's size; null: none", above=0
    )
    base_attitude_limit: float | None = setting(
        None, "rad", "largest rotation of the base from its first attitude; null: none", above=0
    )
    segments: int = _unitless(
        24,
        "of the spline: more segments follow the limits closer and take longer to compute",
        least=4,
        most=100,
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Something to minimise."""
        if self.time_weight + self.effort_weight == 0:
            yield f"{key}.time_weight", "must be > 0 where effort_weight is 0"


@dataclass
class Estimator:
    """How the controller estimates the lumped uncertainty N of equation (2)."""

    kind: str = _choice(
        "one_sample",
        '"one_sample", the paper\'s (5); "kalman", a filter for each coordinate; or "coupled", '
        "the same with one filter for attitude and joints",
        *ESTIMATOR_KINDS,
    )
    walk: PerCoordinate = setting(
        {"base_position": 1e-3, "base_rotation": 1e-3, "joints": 1e-2},
        "rad/s^2 or m/s^2 per sqrt(s)",
        "kalman, and coupled for the base's position: N's random walk, its standard deviation "
        "after one second",
        above=0,
    )
    force_walk: PerCoordinate = setting(
        {"all": 0.2},
        "N m or N per sqrt(s)",
        "coupled only: random walk of the generalized force that stands for N in attitude and "
        "joints",
        above=0,
    )
    position_noise: PerCoordinate | None = setting(
        None,
        "rad or m",
        "not for one_sample: standard deviation that it assumes of the positions; null: that of "
        "``sensing``",
        least=0,
    )
    velocity_noise: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "not for one_sample: standard deviation that it assumes of the velocities; null: that of "
        "``sensing``",
        least=0,
    )
    velocity_bias_walk: PerCoordinate = setting(
        _ZERO,
        "rad/s or m/s per sqrt(s)",
        "kalman only: random walk of a bias of the velocities that it estimates with N, its "
        "standard deviation after one second; 0: no bias is estimated",
        least=0,
    )
    delay: int | None = _samples(
        None, "kalman only: age of the measurements that it assumes; null: ``sensing.delay``"
    )


@dataclass
class CommandFilter:
    """Filters of the force that the control law commands, before any actuator; stability and noise
    include them.
    """

    low_pass: PerCoordinate = setting(
        _ZERO, "Hz", "cut-off of a first-order low-pass filter; 0: none", least=0
    )
    notch: PerCoordinate = setting(
        _ZERO, "Hz", "frequency that a notch takes out; 0: none", least=0
    )
    notch_width: PerCoordinate = _unitless(
        {"all": 0.5}, "the notch's width at half power, as a share of its frequency", above=0
    )


@dataclass
class Harmonic:
    """One coordinate's disturbance, ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = setting(0.0, "N m or N", "amplitude")
    frequency: float = setting(0.0, "rad/s", "angular frequency")
    phase: float = setting(0.0, "rad", "phase")
    bias: float = setting(0.0, "N m or N", "constant part")


@dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = _unitless(1.0, "multiplies amplitudes and biases")
    frequency_scale: float = _unitless(1.0, "multiplies frequencies", least=0)
    harmonics: dict[str, Harmonic] = _unitless({}, "harmonics, by coordinate or group")


@dataclass
class SolarPressure:
    """The force of sunlight on the base, constant in the world frame: -pressure * coefficient *
    area along ``sun``.
    """

    area: float = setting(10.0, "m^2", "area that faces the sun", least=0)
    coefficient: float = _unitless(
        1.3, "of the pressure: 1 absorbs all light, 2 reflects it back", least=0
    )
    pressure: float = setting(
        4.56e-6, "N/m^2", "pressure of sunlight, by default at the Earth's distance", least=0
    )
    sun: list[float] = _vector(
        _X, "", "direction towards the sun, world axes; of any length", nonzero=True
    )
    center_of_pressure: list[float] = _vector(
        _ORIGIN, "m", "where the force acts, in the base's frame"
    )


@dataclass
class Environment:
    """Forces of a circular orbit on every body; the world frame falls freely with a point of it and
    does not turn.
    """

    altitude: float | None = setting(
        400e3,
        "m",
        "of the orbit above the Earth's equator; null with ``mean_motion``",
        above=0,
        most=1e9,
    )
    mean_motion: float | None = setting(
        None,
        "rad/s",
        "the orbit's angular rate, about any body, in place of the altitude",
        above=0,
        most=0.01,  # an orbit of ten minutes, which no body that holds together has
    )
    hill_rpy: list[float] = _vector(
        _ORIGIN,
        "rad",
        "roll, pitch, yaw of Hill's frame in the world at the start: x away from the Earth, y "
        "along the flight, z along the orbit's normal, about which it turns",
    )
    gravity_gradient: bool = _unitless(
        True, "difference of gravity from the spacecraft's centre of mass to each part of a body"
    )
    tidal: bool = _unitless(
        True, "difference of gravity from the world's origin to the spacecraft's centre of mass"
    )
    solar_pressure: SolarPressure | None = _unitless(None, "null: none")

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """One way to give the orbit."""
        if self.mean_motion is None and self.altitude is None:
            yield f"{key}.altitude", "give a number of metres, or mean_motion"
        if self.mean_motion is not None and self.altitude is not None:
            yield f"{key}.altitude", "has no effect beside a mean_motion; set altitude: null"


@dataclass
class Sensing:
    """The sensors' errors, in this order: bias, noise, quantisation, sampling and delay."""

    velocity_noise: PerCoordinate = setting(
        {"all": 1e-6},
        "rad/s or m/s",
        "standard deviation of the velocities' noise, independent for each coordinate and control "
        "sample",
        least=0,
    )
    position_noise: PerCoordinate = setting(
        _ZERO,
        "rad or m",
        "standard deviation of the positions' noise, likewise; the same for the three base "
        "rotations",
        least=0,
    )
    velocity_bias: PerCoordinate = setting(
        _ZERO, "rad/s or m/s", "constant error of the velocities"
    )
    position_bias: PerCoordinate = setting(
        _ZERO,
        "rad or m",
        "constant error of the positions; base rotations: a rotation vector in the world frame",
    )
    velocity_bias_walk: PerCoordinate = setting(
        _ZERO,
        "rad/s or m/s per sqrt(s)",
        "random walk of the velocities' bias (a gyro's rate random walk), its standard deviation "
        "after one second",
        least=0,
    )
    velocity_correlated_noise: PerCoordinate = setting(
        _ZERO,
        "rad/s or m/s",
        "standard deviation of the velocities' noise that is correlated in time, beside the white "
        "noise",
        least=0,
    )
    position_correlated_noise: PerCoordinate = setting(
        _ZERO,
        "rad or m",
        "likewise of the positions; the same for the three base rotations",
        least=0,
    )
    correlation_time: PerCoordinate = setting(
        {"all": 1.0}, "s", "time constant of the correlated noise, first order", above=0
    )
    velocity_quantization: PerCoordinate = setting(
        _ZERO, "rad/s or m/s", "step of the velocities; 0: none", least=0
    )
    position_quantization: PerCoordinate = setting(
        _ZERO, "rad or m", "step of the positions, not for base rotations; 0: none", least=0
    )
    velocity_period: dict[str, int] = _samples(
        {"all": 1}, "between two measurements of the velocities", least=1
    )
    position_period: dict[str, int] = _samples(
        {"all": 1},
        "between two measurements of the positions; the same for the three base rotations",
        least=1,
    )
    delay: int = _samples(0, "age of a measurement when the controller first reads it")
    velocity_delay: dict[str, int] = _samples(
        {"all": 0}, "further age of the velocities, beyond delay"
    )
    position_delay: dict[str, int] = _samples(
        {"all": 0},
        "further age of the positions, beyond delay; the same for the three base rotations",
    )


@dataclass
class Thruster:
    """An on/off thruster, fixed to the base."""

    position: list[float] = _vector(_ORIGIN, "m", "in the base's frame")
    direction: list[float] = _vector(
        _X,
        "",
        "of its force on the base, against its plume, in the base's frame; of any length",
        nonzero=True,
    )
    force: float = setting(5.0, "N", "when it is open", above=0)
    specific_impulse: float = setting(
        226.1, "s", "impulse per weight of propellant on Earth", above=0
    )


@dataclass
class Pwpf:
    """The pulse-width pulse-frequency modulator of each thruster: a first-order filter before a
    Schmitt trigger.
    """

    gain: float = _unitless(
        10.0,
        "of the filter, k_m; its input is the wanted share of the thruster's force, less 1 while "
        "open",
        above=0,
    )
    time_constant: float = setting(0.2, "s", "of the filter", above=0)
    on: float = _unitless(0.25, "output of the filter at which the thruster opens", above=0)
    off: float = _unitless(0.15, "output of the filter at which it closes", least=0)

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A trigger that closes below where it opens."""
        if self.off >= self.on:
            yield f"{key}.off", f"must be from 0 to below on ({self.on:g}), not {self.off:g}"


@dataclass
class Thrusters:
    """On/off thrusters that give the base's force and torque, in place of an ideal wrench."""

    layout: str | None = _choice(
        "12x5N", "a shipped layout; null with ``units``", "12x1N", "12x5N", "16x22N"
    )
    units: dict[str, Thruster] = _unitless(
        {}, "user-supplied thrusters, by name, in place of a layout", size=(0, 24)
    )
    failures: dict[str, str] = _unitless(
        {},
        'thruster\'s name -> "stuck_off" or "stuck_on"; the allocation takes it into account',
        one_of=("stuck_off", "stuck_on"),
    )
    minimum_on_time: float = setting(
        0.02,
        "s",
        "a thruster that opens stays open for at least this long",
        least=0,
        most=1000,
    )
    rise_time: float = setting(
        0.0, "s", "time constant of the force after it opens; 0: at once", least=0, most=1000
    )
    fall_time: float = setting(0.0, "s", "likewise after it closes", least=0, most=1000)
    modulator: str = _choice(
        "sigma_delta",
        'how the wanted force becomes pulses: "sigma_delta", whole frames; "pulse_width", a part '
        'of each frame; or "pwpf"',
        "sigma_delta",
        "pulse_width",
        "pwpf",
    )
    threshold: float = _unitless(
        0.8,
        "sigma_delta only: share of its force from which on a thruster opens; 0.5 follows the "
        "wanted force closest, more wastes less on noise",
        least=0.5,
        below=1,
    )
    frame: int = _samples(
        2, "from one allocation to the next, and of sigma_delta the shortest pulse", least=1
    )
    pwpf: Pwpf = setting(Pwpf())

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Thrusters that exist, and pulses that they can give."""
        if self.layout is not None and self.units:
            yield f"{key}.units", "has no effect beside a layout; set layout: null"
        names = thrusters_of(self)
        if not names:
            yield (
                f"{key}.layout",
                f"choose one of {', '.join(thruster_layouts())}, or give units",
            )
        for name in self.failures:
            if name not in names:
                yield f"{key}.failures.{name}", unknown(name, names)
        least, sample_time = self.minimum_on_time, scenario.sample_time
        if self.modulator != "pwpf" and self.frame * sample_time < least * (1 - 1e-9):
            yield (
                f"{key}.frame",
                f"{self.frame} control samples are {self.frame * sample_time:g} s, shorter than "
                f"minimum_on_time, {least:g} s; take {math.ceil(least / sample_time - 1e-9)} or "
                "more",
            )


@dataclass
class Wheel:
    """A reaction wheel in the base: balanced, symmetric about its axis, its mass and inertia part
    of the base's.
    """

    axis: list[float] = _vector(
        [0.0, 0.0, 1.0], "", "in the base's frame; of any length", nonzero=True
    )
    inertia: float = setting(0.08, "kg m^2", "about its axis", above=0)
    torque_limit: float = setting(0.2, "N m", "of its motor, either way", above=0)
    speed_limit: float = setting(628.0, "rad/s", "relative to the base, either way", above=0)
    initial_momentum: float = setting(0.0, "N m s", "about its axis, at the start")
    coulomb_friction: float = setting(
        0.0, "N m", "of its bearings; below 0.1 rad/s it fades", least=0
    )
    viscous_friction: float = setting(0.0, "N m s", "of its bearings", least=0)

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A start within its speed limit."""
        largest = self.inertia * self.speed_limit
        if abs(self.initial_momentum) > largest:
            yield (
                f"{key}.initial_momentum",
                f"must be within inertia * speed_limit, {largest:.4g} N m s, not "
                f"{self.initial_momentum:g}",
            )


@dataclass
class Wheels:
    """Reaction wheels that give the base's torque; thrusters, where there are any, unload them."""

    units: dict[str, Wheel] = _unitless({}, "wheels, by name", size=(0, 24))
    desaturate_above: float = _unitless(
        0.8,
        "share of a wheel's speed_limit above which thrusters unload the wheels",
        above=0,
        most=1,
    )
    desaturate_below: float = _unitless(
        0.2, "share of every wheel's speed_limit at which unloading ends", least=0
    )
    desaturation_time: float = setting(20.0, "s", "time constant of unloading", above=0)
    assist_above: float | None = _unitless(
        None,
        "multiple of the motors' torque limit above which thrusters give the rest of the wanted "
        "torque; null: never",
        least=1,
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Wheels, and unloading that ends."""
        if not self.units:
            yield f"{key}.units", "give wheels by name, such as {z: {axis: [0, 0, 1]}}"
        above, below = self.desaturate_above, self.desaturate_below
        if below >= above:
            yield (
                f"{key}.desaturate_below",
                f"must be from 0 to below desaturate_above ({above:g}), not {below:g}",
            )


@dataclass
class Drives:
    """Drives of the joints: motor, gear and friction, all as seen at the joint. Force limit and
    step: ``actuation``.
    """

    gear_ratio: PerCoordinate = _unitless(
        {"all": 1.0}, "turns of the motor per turn of the joint; prismatic: rad per m", above=0
    )
    rotor_inertia: PerCoordinate | None = setting(
        None,
        "kg m^2",
        "of the motor about its axis; gear_ratio^2 times this is added to the joint's; null: as in "
        "the URDF",
        least=0,
    )
    nominal_rotor_inertia: PerCoordinate | None = setting(
        None, "kg m^2", "the same in the controller's model; null: rotor_inertia", least=0
    )
    rate_limit: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "of the joint; at and above it a drive gives no accelerating force; null: none",
        above=0,
    )
    knee: PerCoordinate = _unitless(
        {"all": 0.9},
        "share of rate_limit up to which a drive gives all of its actuation.limit, which then "
        "falls linearly to zero",
        least=0,
        below=1,
    )
    coulomb_friction: PerCoordinate = setting(
        _ZERO, "N m or N", "against the motion, at any rate", least=0
    )
    static_friction: PerCoordinate | None = setting(
        None,
        "N m or N",
        "friction as the joint breaks away, above coulomb_friction; null: the same",
        least=0,
    )
    stribeck_rate: PerCoordinate = setting(
        {"all": 0.01},
        "rad/s or m/s",
        "rate within which friction falls from static to Coulomb",
        above=0,
    )
    viscous_friction: PerCoordinate = setting(
        _ZERO, "N m s/rad or N s/m", "grows with the rate", least=0
    )
    smoothing_rate: PerCoordinate = setting(
        {"all": 1e-3},
        "rad/s or m/s",
        "rate within which friction changes its sign, as tanh(rate / smoothing_rate)",
        above=0,
    )


@dataclass
class Actuation:
    """How the actuators change the commanded force: saturation, quantisation, delay, then drives,
    wheels, thrusters.
    """

    driven: list[str] = _unitless(
        ["all"],
        "groups of coordinates that actuators move and that are tracked: all; [base_rotation, "
        "joints], where wheels hold the attitude; or [joints]; no force acts on the others, which "
        "move by conservation of momentum",
    )
    limit: PerCoordinate | None = setting(
        None, "N m or N", "largest force either way; null: unlimited", above=0
    )
    quantization: PerCoordinate = setting(_ZERO, "N m or N", "step of the force; 0: none", least=0)
    delay: int = _samples(0, "age of a command when it acts")
    thrusters: Thrusters | None = _unitless(
        None, "that give the base's force and torque; null: they act as commanded"
    )
    wheels: Wheels | None = _unitless(
        None, "that give the base's torque in place of thrusters; null: none"
    )
    drives: Drives | None = _unitless(
        None, "of the joints; null: without inertia, friction and rate limit"
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Groups that can be driven alone, with actuators and a target posture to match."""
        key, given, undriven = f"{key}.driven", self.driven, scenario.undriven
        distinct = len(set(given)) == len(given)
        if given != ["all"] and not (distinct and set(given) in map(set, DRIVEN)):
            choices = " or ".join(f"[{', '.join(groups)}]" for groups in DRIVEN[1:])
            yield key, f"must be all, {choices}, not {given}"
        for kind, group in (("thrusters", "base_position"), ("wheels", "base_rotation")):
            if getattr(self, kind) is not None and group in undriven:
                yield (
                    key,
                    f"leaves out {', '.join(undriven)}: {kind} cannot act; leave actuation.{kind} "
                    f"out, or have {group} driven",
                )
        first, last = scenario.initial_posture, scenario.target_posture
        for group, field in (("base_rotation", "base_rpy"), ("base_position", "base_position")):
            moved = group in undriven and getattr(first, field) != getattr(last, field)
            if moved and scenario.reference.goal != "stop":
                yield (
                    f"target_posture.{field}",
                    f"{group} is not driven (actuation.driven) and cannot be commanded: give the "
                    "initial posture's",
                )


@dataclass
class Block:
    """The system of a block of the closed loop; a text stands for ``{system: text}``."""

    SHORTHAND: ClassVar[str] = "system"  # the field that a text alone gives

    system: str = _unitless(
        "",
        "module:attribute, or the name of an installed one: a factory (BlockSetup -> Drake system)",
    )
    settings: dict[str, Any] = _unitless({}, "passed to the factory unchanged")

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A name that can be looked up."""
        yield from _named(self.system, f"{key}.system")


@dataclass
class Blocks:
    """User-supplied blocks, in place of those that the scenario's sections of the same names
    describe, or beside them.
    """

    reference: Block | None = _unitless(None, "the planned motion")
    sensing: dict[str, Block] = _unitless(
        {},
        "by name: further stages from the state to the controller's measurement of it, in a row "
        "after the section ``sensing``; one named ``sensing`` replaces that section; a block alone "
        "stands for {own: block}",
    )
    actuation: Block | None = _unitless(None, "from the commanded to the applied force")
    forces: dict[str, Block] = _unitless(
        {},
        "by name: external forces, summed; ``disturbance`` and ``environment`` replace the "
        "scenario's sections of those names, any other name adds to them",
    )

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """Names that the diagram can have."""
        yield from _identifiers(f"{key}.forces", self.forces, "a force's")
        yield from _identifiers(f"{key}.sensing", self.sensing, "a stage's")


@dataclass
class Scenario:
    """Everything that defines one run."""

    description: str = _unitless("", "title of plots and records")
    random_seed: int = _unitless(
        0,
        "seed of the measurement noise; the same seed gives the same bits",
        least=0,
        most=2**31 - 1,
    )
    duration: float = setting(
        20.0, "s", "the run ends at the last control sample within it", above=0
    )
    sample_time: float = setting(0.01, "s", "L, the controller's period and delay", above=0)
    divergence_speed: float = setting(
        10.0,
        "rad/s or m/s",
        "the run is stopped as diverging when a generalized velocity exceeds this",
        above=0,
    )
    tolerance: PerCoordinate = setting(
        {"all": 1e-3},
        "rad or m",
        "a run has settled when over its last second every error stays within this; 1e-3 for "
        "coordinates that are not given",
        above=0,
    )
    simulator_config: SimulatorConfig = setting(
        SimulatorConfig(
            integration_scheme="runge_kutta3",
            max_step_size=0.01,
            accuracy=1e-10,
            use_error_control=False,
        )
    )
    model: Model = setting(Model())
    payload: Payload = setting(Payload())
    initial_posture: Posture = setting(Posture())
    target_posture: Posture = setting(Posture())
    initial_velocity: PerCoordinate = setting(
        _ZERO,
        "rad/s or m/s",
        "at the start; base_rotation is the angular velocity in world axes. The reference starts "
        "at rest; with capture, at the velocity after a grasp of the nominal payload, and this is "
        "added to the true velocity.",
    )
    capture: Capture | None = _unitless(
        None, "the grasp of a moving target; null: the target is held and at rest at the start"
    )
    reference: Reference = setting(Reference())
    planning: Planning = setting(Planning())
    clearance: float = setting(
        0.01,
        "m",
        "least distance between parts: plans keep it; runs that come nearer are warned of",
        least=0,
    )
    controller: str = _unitless(
        "tde_aismc",
        "name of a shipped controller (`ffsm doctor` lists them) or of an installed one, or "
        "module:attribute",
    )
    controllers: dict[str, dict[str, PerCoordinate | None]] = _unitless(
        {},
        "gains: controller (its name, or what follows the colon) -> gain -> by coordinate; gains "
        "that are not given keep their defaults; null takes an upper bound away",
    )
    blocks: Blocks = setting(Blocks())
    python_path: list[str] = _unitless(
        [],
        "folders to look in for the modules of controllers and blocks, before Python's own; "
        "relative paths start at the scenario file's folder",
    )
    estimator: Estimator = setting(Estimator())
    command_filter: CommandFilter = setting(CommandFilter())
    disturbance: Disturbance = setting(Disturbance())
    environment: Environment | None = _unitless(
        None, "the orbit's forces, recorded as force_environment; null: none"
    )
    sensing: Sensing = setting(Sensing())
    actuation: Actuation = setting(Actuation())

    def check(self, key: str, scenario: "Scenario") -> Problems:
        """A run of at least one and not too many samples and steps."""
        samples, config = self.duration / self.sample_time, self.simulator_config
        if samples > MAX_SAMPLES:
            yield (
                "sample_time" if self.duration < 1000.0 else "duration",
                f"{self.duration:g} s in samples of {self.sample_time:g} s are {samples:.3g}, "
                f"about {samples * _BYTES_PER_SAMPLE / 1e9:.3g} GB; at most {MAX_SAMPLES} are run: "
                "shorten duration or lengthen sample_time",
            )
        elif self.num_control_periods < 1:
            yield "sample_time", f"must be at most duration ({self.duration} s)"
        if config.use_error_control and config.integration_scheme in FIXED_STEP_SCHEMES:
            yield (
                "simulator_config.use_error_control",
                f"{config.integration_scheme} has no error estimate; set false, or choose another "
                "integration_scheme",
            )
        if config.start_time != 0:
            yield (
                "simulator_config.start_time",
                "must be 0: every run starts there; leave it out",
            )
        steps = self.duration / config.max_step_size
        if steps > MAX_STEPS:
            yield (
                "simulator_config.max_step_size",
                f"{config.max_step_size:g} s gives {steps:.3g} steps in {self.duration:g} s; at "
                f"most {MAX_STEPS} are run",
            )
        for name, number in self.initial_velocity.items():
            if abs(number) > self.divergence_speed:
                yield (
                    f"initial_velocity.{name}",
                    f"must be within divergence_speed ({self.divergence_speed:g}), not {number}",
                )
        yield from _named(self.controller, "controller")

    @property
    def num_control_periods(self) -> int:
        """Number of whole control periods within the duration."""
        return math.floor(self.duration / self.sample_time + 1e-9)

    @property
    def driven(self) -> tuple[str, ...]:
        """The groups of coordinates that actuators move."""
        given = self.actuation.driven
        return tuple(group for group in DRIVEN[0] if group in given or "all" in given)

    @property
    def undriven(self) -> tuple[str, ...]:
        """The groups of coordinates that only conservation of momentum moves."""
        return tuple(group for group in DRIVEN[0] if group not in self.driven)

    @property
    def postures(self) -> dict[str, Posture]:
        """Every posture that the scenario gives, by key."""
        found = {"initial_posture": self.initial_posture, "target_posture": self.target_posture}
        if self.capture is not None and self.capture.approach is not None:
            found["capture.approach.posture"] = self.capture.approach.posture
        return found

    @property
    def wheels(self) -> Wheels | None:
        """The wheels of the scenario's own actuators."""
        return None if self.blocks.actuation else self.actuation.wheels

    @property
    def drives(self) -> Drives | None:
        """The drives of the scenario's own actuators."""
        return None if self.blocks.actuation else self.actuation.drives

    @property
    def grasp_time(self) -> float:
        """When the target is grasped, s; 0 where it is held from the start."""
        return (
            0.0
            if self.capture is None or self.capture.approach is None
            else self.capture.approach.duration
        )

    @property
    def planned_end(self) -> float | None:
        """When the planned motion ends, s; None where that is still to be found."""
        return (
            None if self.reference.duration is None else self.grasp_time + self.reference.duration
        )

    def tolerance_of(self, *names: str) -> float:
        """The tolerance of what goes by several names (a coordinate's own, its group's): that of
        the first known.
        """
        return next(
            (self.tolerance[name] for name in (*names, "all") if name in self.tolerance), 1e-3
        )


def from_grasp(scenario: Scenario) -> Scenario:
    """The scenario from the grasp on, without an approach; one without a capture as it is."""
    if scenario.capture is None or scenario.grasp_time == 0.0:
        return scenario
    held = replace(scenario.capture, approach=None)
    return replace(scenario, duration=scenario.duration - scenario.grasp_time, capture=held)


# What a planned motion with the nominal payload does not depend on.
_OF_THE_RUN = (
    "description",
    "random_seed",
    "tolerance",
    "simulator_config",
    "initial_velocity",
    "controller",
    "controllers",
    "python_path",
    "estimator",
    "command_filter",
    "disturbance",
    "environment",
    "sensing",
)


def planned_part(scenario: Scenario) -> Scenario:
    """The scenario with defaults for all that its planned motion does not depend on.

    Runs that differ in nothing else, such as those of several controllers, share what is computed
    from it.
    """
    plain, truth = Scenario(), MassProperties()
    # the target turns about its true centre of mass before the grasp
    if scenario.capture is not None:
        truth.center_of_mass = scenario.payload.truth.center_of_mass
    payload = replace(scenario.payload, truth=truth)
    changes = {name: getattr(plain, name) for name in _OF_THE_RUN}
    return replace(scenario, payload=payload, **changes)


def controller_key(controller: str) -> str:
    """The key in ``controllers`` of a controller: its name, or what follows the colon of
    ``module:attribute``.
    """
    return controller.rpartition(":")[2]


def inertia_matrix(body: MassProperties) -> np.ndarray:
    """Inertia about the centre of mass as a symmetric (3, 3) matrix, kg m^2."""
    ixx, iyy, izz, ixy, ixz, iyz = (*body.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])


@functools.cache
def thruster_layouts() -> dict[str, dict[str, Thruster]]:
    """The shipped layouts of thrusters: layout -> name -> thruster."""
    text = Path(__file__).with_name("thruster_layouts.yaml").read_text(encoding="utf-8")
    return {
        layout: {name: Thruster(**values) for name, values in units.items()}
        for layout, units in yaml.safe_load(text).items()
    }


def thrusters_of(settings: Thrusters) -> dict[str, Thruster]:
    """The thrusters that settings describe, by name."""
    return settings.units if settings.layout is None else thruster_layouts()[settings.layout]


def own_thrusters(scenario: Scenario) -> dict[str, Thruster]:
    """The thrusters of a scenario's own actuators, by name; empty where it has none, or a
    user-supplied block.
    """
    settings = scenario.actuation.thrusters
    return (
        {} if settings is None or scenario.blocks.actuation is not None else thrusters_of(settings)
    )


def _named(name: str, key: str) -> Problems:
    if not _NAME.fullmatch(name):
        yield key, f"'{name}' must be a name or module:attribute"


def _undriven(name: str, key: str, undriven: Collection[str]) -> Problems:
    if name not in undriven:
        close = did_you_mean(name, undriven)
        choice = f"choose one of {', '.join(undriven)}{close}" if undriven else "leave it out"
        yield key, f"'{name}' is no undriven base coordinate (actuation.driven); {choice}"


def _identifiers(key: str, names: Iterable[str], whose: str) -> Problems:
    for name in names:
        if not name.isidentifier():
            yield f"{key}.{name}", f"{whose} name must be letters, digits and underscores"
