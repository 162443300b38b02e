"""The scenario's dataclasses: every key with its default, unit and meaning.

Values given per coordinate (gains, disturbances, joint angles) are mappings whose keys are ``all``, a group
(``base_rotation``, ``base_position``, ``joints``) or one coordinate's name; the more specific key wins, and a bare
number stands for ``{all: number}``.
"""

import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
from pydrake.systems.analysis import SimulatorConfig

PerCoordinate = dict[str, float]
BASE_ROTATIONS = ("eigenaxis", "rpy")
REFERENCE_KINDS = ("quintic", "septic", "optimal")
SHAPER_KINDS = ("zv", "zvd")
# What ``actuation.driven`` may name, together.
DRIVEN = (("base_rotation", "base_position", "joints"), ("base_rotation", "joints"), ("joints",))
FRAME_TASKS = ("pose", "position", "attitude", "none")
FRAME_PRIORITIES = ("hold", "frame")
FRAME_JOINTS = ("least", "target_posture")
ESTIMATOR_KINDS = ("one_sample", "kalman", "coupled")
CAPTURE_AXES = ("target", "world")
SERVICER_MOTIONS = ("rest", "track_joints", "track_all", "given")
GOALS = ("target_posture", "stop")
GRASPING_JOINTS = ("free", "braked")
MODULATORS = ("sigma_delta", "pulse_width", "pwpf")
THRUSTER_FAILURES = ("stuck_off", "stuck_on")
FLEXIBLE_KINDS = ("panel", "beam", "mass", "pendulum", "joint", "gear")


def _published(**values: float) -> PerCoordinate:
    return dataclasses.field(default_factory=lambda: dict(values))


@dataclasses.dataclass
class Flexible:
    """A part of the true spacecraft that moves on its own, and that the controller takes for rigid.

    The mass of a panel, a beam, a sloshing mass or a pendulum is part of the body that carries it.
    """

    # "panel": plates on hinges; "beam": bending modes of a uniform cantilever; "mass": a point mass on a spring, such
    # as slosh; "pendulum": a point mass on a rod; "joint": a joint of the model that a spring holds and no drive
    # moves; "gear": a spring between the rotor of a joint's drive (actuation.drives.rotor_inertia) and its link
    kind: str = "panel"
    body: str = "servicer::base"  # that carries it, for panel, beam, mass and pendulum: scoped name
    joint: str | None = None  # of the model, for joint and gear
    # m; of the hinge, the root, the pendulum's pivot, or the mass at rest, in the body's frame
    position: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    # from the hinge, root or pivot outwards, or along which the mass moves, in the body's frame; of any length
    direction: list[float] = dataclasses.field(default_factory=lambda: [0.0, 1.0, 0.0])
    # of the hinge or of bending, across ``direction``, in the body's frame; of any length
    axis: list[float] = dataclasses.field(default_factory=lambda: [1.0, 0.0, 0.0])
    mass: float = 2.0  # kg; of the panel, the beam, the sloshing mass or the pendulum
    length: float = 3.0  # m; of the panel, the beam or the pendulum's rod
    width: float = 1.0  # m; of the panel, along the axis
    plates: int = 1  # of a panel: one behind the other, of equal length, each on a hinge
    # Hz; with the body held fast: of a panel its lowest; of a joint or gear in the zero posture; null with stiffness
    frequency: float | None = None
    frequencies: list[float] = dataclasses.field(default_factory=list)  # Hz; of a beam's first modes, its root held
    stiffness: float | None = None  # N m/rad, or N/m of a mass; of each hinge; null with frequency
    damping_ratio: float = 0.005  # of that frequency, of each mode of a beam


@dataclasses.dataclass
class Model:
    """The models of servicer and target, and the frames that reports refer to.

    Files are package:// addresses or paths; relative paths start at the scenario file's folder.
    """

    directives: str | None = "package://ffsm_drake/postcapture.dmd.yaml"  # model directives; or give servicer
    servicer: str | None = None  # instead of directives: URDF of base and arm, model instance "servicer"
    debris: str = "package://ffsm_drake/urdf/debris.urdf"  # with servicer: URDF of the target, instance "debris"
    end_effector: str = "servicer::end_effector"  # frame that holds the target; its origin is reported
    grasp: str = "debris::grasp"  # with servicer: the target's frame that is welded to end_effector
    packages: dict[str, str] = dataclasses.field(default_factory=dict)  # package:// name -> folder, for meshes
    # by name: what moves besides base and joints, of which the controller knows nothing
    flexible: dict[str, Flexible] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass
class MassProperties:
    """Mass properties of the payload body, in its own frame P."""

    mass: float = 100.0  # kg; mass
    # m; position p_PScm_P of the centre of mass
    center_of_mass: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    # kg m^2; about the centre of mass, axes of P: [Ixx, Iyy, Izz] or [Ixx, Iyy, Izz, Ixy, Ixz, Iyz]
    inertia: list[float] = dataclasses.field(default_factory=lambda: [16.7, 16.7, 16.7])


@dataclasses.dataclass
class Payload:
    """The captured body: its true mass properties, and the nominal ones, which the controller works with."""

    body: str = "debris::debris"  # scoped name of the captured body in the model
    truth: MassProperties = dataclasses.field(default_factory=MassProperties)
    nominal: MassProperties = dataclasses.field(
        default_factory=lambda: MassProperties(mass=80.0, inertia=[12.0, 12.0, 12.0])
    )


@dataclasses.dataclass
class Posture:
    """A configuration of base and arm."""

    base_position: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])  # m; position p_WB
    # rad; roll, pitch, yaw of R_WB: rotations about the world's x, y, z axes in that order
    base_rpy: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    joints: PerCoordinate = _published(all=0.0)  # rad or m; positions, by joint name


@dataclasses.dataclass
class Approach:
    """The servicer's motion up to the grasp, without the target: from rest to ``initial_posture``."""

    duration: float = 20.0  # s; the run begins with it; a whole number of control samples
    posture: Posture = dataclasses.field(default_factory=Posture)  # where the servicer starts, at rest


@dataclasses.dataclass
class Compliance:
    """The gripper as springs and dampers, for the force and the time of the grasp; the run takes the plastic grasp."""

    stiffness: float = 5e4  # N/m; of the spring at the grasp
    damping: float = 1e3  # N s/m; of the damper beside it
    rotational_stiffness: float = 1e4  # N m/rad; likewise, against turning
    rotational_damping: float = 500.0  # N m s/rad; likewise


@dataclasses.dataclass
class Capture:
    """The grasp of a moving target, in ``initial_posture``, after which the run is what follows from it."""

    # rad/s; angular velocity of the target before the grasp
    rate: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    # m/s; velocity of the target's centre of mass before the grasp
    velocity: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    axes: str = "target"  # of rate and velocity: "target", those of the payload body, or "world"
    # how the servicer moves at the grasp: "rest"; "track_joints" or "track_all": its joints, or base and joints, follow
    # the grasp frame in weighted least squares; "given": at servicer_velocity
    servicer: str = "rest"
    servicer_velocity: PerCoordinate = _published(all=0.0)  # rad/s or m/s; at the grasp, with servicer "given"
    tracking_length: float = 1.0  # m; tracking weighs 1 rad/s beside the grasp frame as this length times 1 m/s
    tracking_cost: PerCoordinate = _published(all=1.0)  # s/rad or s/m; of rates that track alike, those of least cost
    # how the joints meet the target: "free", or "braked", which stops them at the grasp
    joints: str = "free"
    compliance: Compliance | None = None  # of the gripper, for the force of the grasp; null: it is not computed
    approach: Approach | None = None  # the motion up to the grasp; null: the run begins with the grasp
    # rad or m; how far base_rotation and base_position, where nothing drives them, may go from where they are at the
    # grasp: what is told is when that is used up; null: nothing is said
    accepted_drift: PerCoordinate | None = None


@dataclasses.dataclass
class Shaper:
    """An input shaper: the motion as a sum of delayed copies of itself whose vibrations cancel."""

    kind: str = "zv"  # "zv", exact at its frequencies, or "zvd", twice as long and good near them too
    # Hz; of the vibrations, with the controlled coordinates held; half a period of each, with zvd a whole one, of
    # ``reference.duration`` is the shaper's
    frequencies: list[float] = dataclasses.field(default_factory=list)
    damping_ratio: float = 0.005  # of the vibrations


@dataclasses.dataclass
class FrameGoal:
    """A frame whose pose the planned motion prescribes; the joints follow by the generalized Jacobian.

    The origin goes along a line, the attitude about the eigenaxis. Base coordinates that are driven move as without it.
    """

    frame: str | None = None  # scoped name; null: ``model.end_effector``
    # what of the frame is prescribed: "pose", "position", "attitude", or "none", which leaves the joints to
    # target_posture.joints, as far as ``hold`` lets them
    task: str = "pose"
    position: list[float] | None = None  # m; goal of its origin, world frame; null: where it starts
    # rad; goal of its attitude: roll, pitch, yaw in the world frame; null: as it starts
    rpy: list[float] | None = None
    # base coordinates that are not driven, or groups of them, which the joints then do not move: reaction null space
    hold: list[str] = dataclasses.field(default_factory=list)
    priority: str = "hold"  # which comes first where not both are possible: "hold", or "frame"
    # what the joints do with the freedom that is left: "least", least rates, or "target_posture": they go towards it
    joints: str = "least"
    # singular value of the task's Jacobian, radians of the frame counted as metres, below which joints are damped: no
    # twist takes more than 1.09/damping times its size in joint rates, and the path is missed instead
    damping: float = 0.05
    feedback: float = 2.0  # 1/s; at which the plan takes back what it has missed of the path


@dataclasses.dataclass
class Reference:
    """The planned motion: from the initial to the target posture by a polynomial, or a plan from a file."""

    # "quintic", fifth order; "septic", seventh, without jerk at the ends; or "optimal": what ``plan`` holds, which
    # 'ffsm plan' has computed as ``planning`` says
    kind: str = "quintic"
    # s; the posture at its end is held afterwards; a plan may take no longer; auto (or null): the shortest that all the
    # limits of actuators and joints allow with the nominal payload
    duration: float | None = 20.0
    reserve: float = 0.3  # with duration auto: the share of every force and velocity limit that the motion leaves free
    # where it ends: "target_posture", or "stop", wherever the motion from the velocity at the start is cheapest
    goal: str = "target_posture"
    # how the base turns: "eigenaxis", the shorter way about one fixed axis, or "rpy", roll, pitch and yaw each a
    # polynomial, as in the paper
    base_rotation: str = "eigenaxis"
    shaper: Shaper | None = None  # of a polynomial; null: it is not shaped
    frame: FrameGoal | None = None  # whose pose is prescribed, in place of target_posture.joints; null: none
    # with optimal: file of the plan, a path from the scenario file's folder or a package:// address
    plan: str | None = None


@dataclasses.dataclass
class Planning:
    """What 'ffsm plan' looks for: a motion from the initial posture and velocity to ``reference.goal``, at rest, within
    every limit.

    The limits are those of ``actuation.limit``, the URDFs' of position, velocity and effort, ``clearance`` and the ones
    here. It minimises time_weight * duration + effort_weight * integral of the squared force, with the nominal payload.
    """

    time_weight: float = 1.0  # 1/s; weight of the duration; 0: the motion takes reference.duration
    # 1/(N^2 m^2 s); weight of the integral of the squared force; a little keeps out forces that shorten nothing
    effort_weight: float = 1e-4
    # share of the force limits that is left to the controller: for noise, disturbances, and what the true payload takes
    # beyond the nominal one
    reserve: float = 0.4
    end_rate: float = 0.0  # rad/s or m/s; every rate at the end is at most this, and then dies away
    velocity_limit: PerCoordinate | None = None  # rad/s or m/s; largest rate, beside the URDFs'; null: none
    impulse_limit: PerCoordinate | None = None  # N m s or N s; largest integral of a force's size, each; null: none
    base_attitude_limit: float | None = None  # rad; largest turn of the base from its first attitude; null: none
    segments: int = 24  # of the spline: more follow the limits closer and take longer


@dataclasses.dataclass
class Estimator:
    """How the controller estimates the lumped uncertainty N of equation (2)."""

    # the paper's (5); "kalman", by coordinate; or "coupled", the same with one filter for attitude and joints
    kind: str = "one_sample"
    # rad/s^2 or m/s^2 per sqrt(s); kalman, and coupled for the base's position: N's random walk, its standard
    # deviation after one second
    walk: PerCoordinate = _published(base_position=1e-3, base_rotation=1e-3, joints=1e-2)
    # N m or N per sqrt(s); coupled only: random walk of the generalized force that stands for N in attitude and joints
    force_walk: PerCoordinate = _published(all=0.2)
    # rad or m; not for one_sample: standard deviation that it assumes of the positions; null: that of ``sensing``
    position_noise: PerCoordinate | None = None
    # rad/s or m/s; not for one_sample: standard deviation that it assumes of the velocities; null: that of ``sensing``
    velocity_noise: PerCoordinate | None = None
    # rad/s or m/s per sqrt(s); kalman only: random walk of a bias of the velocities that it estimates with N, its
    # standard deviation after one second; 0: no bias is estimated
    velocity_bias_walk: PerCoordinate = _published(all=0.0)
    # control samples; kalman only: age of the measurements that it assumes in place of ``sensing.delay``; null: that
    delay: int | None = None


@dataclasses.dataclass
class CommandFilter:
    """Filters of the force that the control law commands, before any actuator; stability and noise include them."""

    low_pass: PerCoordinate = _published(all=0.0)  # Hz; cut-off of a first-order low-pass filter; 0: none
    notch: PerCoordinate = _published(all=0.0)  # Hz; frequency that a notch takes out; 0: none
    notch_width: PerCoordinate = _published(all=0.5)  # of its frequency; the notch's width at half power


@dataclasses.dataclass
class Harmonic:
    """One coordinate's disturbance, ``amplitude * sin(frequency * t + phase) + bias``."""

    amplitude: float = 0.0  # N m or N; amplitude
    frequency: float = 0.0  # rad/s; angular frequency
    phase: float = 0.0  # rad; phase
    bias: float = 0.0  # N m or N; constant part


@dataclasses.dataclass
class Disturbance:
    """External generalized force tau_d on the plant (Table 1)."""

    amplitude_scale: float = 1.0  # multiplies amplitudes and biases
    frequency_scale: float = 1.0  # multiplies frequencies
    harmonics: dict[str, Harmonic] = dataclasses.field(default_factory=dict)  # harmonics, by coordinate or group


@dataclasses.dataclass
class SolarPressure:
    """The force of sunlight on the base, constant in the world frame: -pressure * coefficient * area along ``sun``."""

    area: float = 10.0  # m^2; that faces the sun
    coefficient: float = 1.3  # of the pressure: 1 absorbs all light, 2 reflects it back
    pressure: float = 4.56e-6  # N/m^2; of sunlight, here at the Earth's distance
    sun: list[float] = dataclasses.field(default_factory=lambda: [1.0, 0.0, 0.0])  # towards it, world axes; any length
    # m; where the force acts, in the base's frame
    center_of_pressure: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])


@dataclasses.dataclass
class Environment:
    """Forces of a circular orbit on every body; the world frame falls freely with a point of it and does not turn."""

    altitude: float | None = 400e3  # m; of the orbit above the Earth's equator; null with ``mean_motion``
    mean_motion: float | None = None  # rad/s; the orbit's angular rate, about any body, without an altitude
    # rad; roll, pitch, yaw of Hill's frame in the world at the start: x away from the Earth, y along the flight, z
    # along the orbit's normal, about which it turns
    hill_rpy: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])
    gravity_gradient: bool = True  # difference of gravity from the spacecraft's centre of mass to each part of a body
    tidal: bool = True  # difference of gravity from the world's origin to the spacecraft's centre of mass
    solar_pressure: SolarPressure | None = None  # null: none


@dataclasses.dataclass
class Sensing:
    """What the sensors make of the true state: bias, noise, quantisation, sampling and delay, in that order."""

    # rad/s or m/s; standard deviation of the velocities' noise, independent for each coordinate and control sample
    velocity_noise: PerCoordinate = _published(all=1e-6)
    # rad or m; standard deviation of the positions' noise, likewise; the same for the three base rotations
    position_noise: PerCoordinate = _published(all=0.0)
    velocity_bias: PerCoordinate = _published(all=0.0)  # rad/s or m/s; constant error of the velocities
    # rad or m; constant error of the positions; base rotations: a rotation vector in the world frame
    position_bias: PerCoordinate = _published(all=0.0)
    # rad/s or m/s per sqrt(s); random walk of the velocities' bias (a gyro's rate random walk), its standard deviation
    # after one second
    velocity_bias_walk: PerCoordinate = _published(all=0.0)
    # rad/s or m/s; standard deviation of noise of the velocities that is correlated in time, beside the white noise
    velocity_correlated_noise: PerCoordinate = _published(all=0.0)
    # rad or m; likewise of the positions; the same for the three base rotations
    position_correlated_noise: PerCoordinate = _published(all=0.0)
    correlation_time: PerCoordinate = _published(all=1.0)  # s; time constant of the correlated noise, first order
    velocity_quantization: PerCoordinate = _published(all=0.0)  # rad/s or m/s; step of the velocities; 0: none
    # rad or m; step of the positions, not for base rotations; 0: none
    position_quantization: PerCoordinate = _published(all=0.0)
    velocity_period: PerCoordinate = _published(all=1.0)  # control samples; between two measurements of the velocities
    # control samples; between two measurements of the positions; the same for the three base rotations
    position_period: PerCoordinate = _published(all=1.0)
    delay: int = 0  # control samples; age of a measurement when the controller first reads it
    velocity_delay: PerCoordinate = _published(all=0.0)  # control samples; further age of the velocities, beyond delay
    # control samples; further age of the positions, beyond delay; the same for the three base rotations
    position_delay: PerCoordinate = _published(all=0.0)


@dataclasses.dataclass
class Thruster:
    """An on/off thruster, fixed to the base."""

    position: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 0.0])  # m; in the base's frame
    # of its force on the base, against its plume, in the base's frame; of any length
    direction: list[float] = dataclasses.field(default_factory=lambda: [1.0, 0.0, 0.0])
    force: float = 5.0  # N; when it is open
    specific_impulse: float = 226.1  # s; impulse per weight of propellant on Earth


@dataclasses.dataclass
class Pwpf:
    """The pulse-width pulse-frequency modulator: a first-order filter before a Schmitt trigger, of each thruster."""

    gain: float = 10.0  # of the filter, k_m; its input is the wanted share of the thruster's force, less 1 while open
    time_constant: float = 0.2  # s; of the filter
    on: float = 0.25  # output of the filter at which the thruster opens
    off: float = 0.15  # output of the filter at which it closes


@dataclasses.dataclass
class Thrusters:
    """On/off thrusters that give the base's force and torque, in place of an ideal wrench."""

    # of the shipped ones: "12x1N", "12x5N" or "16x22N"; null with ``units``
    layout: str | None = "12x5N"
    units: dict[str, Thruster] = dataclasses.field(default_factory=dict)  # own thrusters, by name, without a layout
    # name -> "stuck_off" or "stuck_on"; the allocation knows of it
    failures: dict[str, str] = dataclasses.field(default_factory=dict)
    minimum_on_time: float = 0.02  # s; a thruster that opens stays open for at least this long
    rise_time: float = 0.0  # s; time constant of the force after it opens; 0: at once
    fall_time: float = 0.0  # s; likewise after it closes
    # how the wanted force becomes pulses: "sigma_delta", whole frames; "pulse_width", a part of each frame; or "pwpf"
    modulator: str = "sigma_delta"
    # sigma_delta only: share of its force from which a thruster opens; 0.5 owes least, more wastes less on noise
    threshold: float = 0.8
    frame: int = 2  # control samples; from one allocation to the next, and of sigma_delta the shortest pulse
    pwpf: Pwpf = dataclasses.field(default_factory=Pwpf)


@dataclasses.dataclass
class Wheel:
    """A reaction wheel in the base: balanced, symmetric about its axis, its mass and inertia part of the base's."""

    axis: list[float] = dataclasses.field(default_factory=lambda: [0.0, 0.0, 1.0])  # in the base's frame; any length
    inertia: float = 0.08  # kg m^2; about its axis
    torque_limit: float = 0.2  # N m; of its motor, either way
    speed_limit: float = 628.0  # rad/s; relative to the base, either way
    initial_momentum: float = 0.0  # N m s; about its axis, at the start
    coulomb_friction: float = 0.0  # N m; of its bearings; below 0.1 rad/s it fades
    viscous_friction: float = 0.0  # N m s; of its bearings


@dataclasses.dataclass
class Wheels:
    """Reaction wheels that give the base's torque; thrusters, where there are any, unload them."""

    units: dict[str, Wheel] = dataclasses.field(default_factory=dict)  # by name
    desaturate_above: float = 0.8  # of a wheel's speed_limit: from there on thrusters unload the wheels
    desaturate_below: float = 0.2  # of every wheel's speed_limit: until then
    desaturation_time: float = 20.0  # s; time constant of unloading
    # times the motors' torque; what is wanted beyond it is asked of thrusters; null: nothing
    assist_above: float | None = None


@dataclasses.dataclass
class Drives:
    """Drives of the joints: motor, gear and friction, all as seen at the joint. Force limit and step: ``actuation``."""

    gear_ratio: PerCoordinate = _published(all=1.0)  # turns of the motor per turn of the joint; prismatic: rad per m
    # kg m^2; of the motor about its axis, gear_ratio^2 times which adds to the joint's; null: as the URDF has it
    rotor_inertia: PerCoordinate | None = None
    nominal_rotor_inertia: PerCoordinate | None = None  # kg m^2; as the controller's model has it; null: as it is
    # rad/s or m/s; of the joint, from which on a drive gives no force that accelerates it; null: none
    rate_limit: PerCoordinate | None = None
    # share of rate_limit up to which a drive gives all of its actuation.limit, which then falls linearly to nothing
    knee: PerCoordinate = _published(all=0.9)
    coulomb_friction: PerCoordinate = _published(all=0.0)  # N m or N; against the motion, of any rate
    # N m or N; friction as the joint breaks away, above coulomb_friction; null: the same
    static_friction: PerCoordinate | None = None
    stribeck_rate: PerCoordinate = _published(
        all=0.01
    )  # rad/s or m/s; within which friction falls from static to Coulomb
    viscous_friction: PerCoordinate = _published(all=0.0)  # N m s/rad or N s/m; grows with the rate
    # rad/s or m/s; within which friction changes its sign, as tanh(rate / smoothing_rate)
    smoothing_rate: PerCoordinate = _published(all=1e-3)


@dataclasses.dataclass
class Actuation:
    """How the actuators change the commanded force: saturation, quantisation, delay, then drives, wheels, thrusters."""

    # groups of coordinates that actuators move and that are tracked: all; [base_rotation, joints], where wheels hold
    # the attitude; or [joints]; no force acts on the others, which conservation of momentum moves
    driven: list[str] = dataclasses.field(default_factory=lambda: ["all"])
    limit: PerCoordinate | None = None  # N m or N; largest force either way; null: unlimited
    quantization: PerCoordinate = _published(all=0.0)  # N m or N; step of the force; 0: none
    delay: int = 0  # control samples; age of a command when it acts
    thrusters: Thrusters | None = None  # that give the base's force and torque; null: they act as commanded
    wheels: Wheels | None = None  # that give the base's torque in place of thrusters; null: none
    drives: Drives | None = None  # of the joints; null: without inertia, friction and a limit of their rate


@dataclasses.dataclass
class Block:
    """What fills a block of the closed loop; a text stands for ``{system: text}``."""

    SHORTHAND: ClassVar[str] = "system"  # the field that a text alone gives

    system: str = ""  # module:attribute, or the name of an installed one: a factory (BlockSetup -> Drake system)
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)  # passed to the factory unchanged


@dataclasses.dataclass
class Blocks:
    """User-supplied blocks in place of the scenario's own, which its section of the same name describes."""

    reference: Block | None = None  # the planned motion
    sensing: Block | None = None  # what the controller reads of the state
    actuation: Block | None = None  # from the commanded to the applied force
    # by name: external forces, summed; ``disturbance`` and ``environment`` replace the scenario's sections of those
    # names, any other name adds to them
    forces: dict[str, Block] = dataclasses.field(default_factory=dict)


def _default_simulator_config() -> SimulatorConfig:
    return SimulatorConfig(
        integration_scheme="runge_kutta3", max_step_size=0.01, accuracy=1e-10, use_error_control=False
    )


@dataclasses.dataclass
class Scenario:
    """Everything that defines one run."""

    description: str = ""  # title of plots and records
    random_seed: int = 0  # seed of the measurement noise; the same seed gives the same bits
    duration: float = 20.0  # s; the run ends at the last control sample within it
    sample_time: float = 0.01  # s; L, the controller's period and delay
    # rad/s or m/s; the run is stopped as diverging when a generalized velocity exceeds this
    divergence_speed: float = 10.0
    # rad or m; a run has settled when over its last second every error stays within this; 1e-3 where it says nothing
    tolerance: PerCoordinate = _published(all=1e-3)
    simulator_config: SimulatorConfig = dataclasses.field(default_factory=_default_simulator_config)
    model: Model = dataclasses.field(default_factory=Model)
    payload: Payload = dataclasses.field(default_factory=Payload)
    initial_posture: Posture = dataclasses.field(default_factory=Posture)
    target_posture: Posture = dataclasses.field(default_factory=Posture)
    # At the start, rad/s or m/s; base_rotation is the angular velocity in world axes. The reference starts at rest;
    # with capture, at the velocity that the grasp leaves with the nominal payload. This is added to the true one.
    initial_velocity: PerCoordinate = _published(all=0.0)
    capture: Capture | None = None  # the grasp of a moving target; null: the target is held and at rest at the start
    reference: Reference = dataclasses.field(default_factory=Reference)
    planning: Planning = dataclasses.field(default_factory=Planning)
    clearance: float = 0.01  # m; a plan or run in which parts come nearer to each other is warned of, or not planned
    # name of a shipped controller (`ffsm doctor` lists them) or of an installed one, or module:attribute
    controller: str = "tde_aismc"
    # gains: controller (its name, or what follows the colon) -> gain -> by coordinate; what is not given keeps its
    # default; null takes an upper bound away
    controllers: dict[str, dict[str, PerCoordinate | None]] = dataclasses.field(default_factory=dict)
    blocks: Blocks = dataclasses.field(default_factory=Blocks)
    # folders to look in for the modules of controllers and blocks, before Python's own; relative paths start at the
    # scenario file's folder
    python_path: list[str] = dataclasses.field(default_factory=list)
    estimator: Estimator = dataclasses.field(default_factory=Estimator)
    command_filter: CommandFilter = dataclasses.field(default_factory=CommandFilter)
    disturbance: Disturbance = dataclasses.field(default_factory=Disturbance)
    environment: Environment | None = None  # the orbit's forces, recorded as force_environment; null: none
    sensing: Sensing = dataclasses.field(default_factory=Sensing)
    actuation: Actuation = dataclasses.field(default_factory=Actuation)

    @property
    def num_control_periods(self) -> int:
        """Number of whole control periods within the duration."""
        return math.floor(self.duration / self.sample_time + 1e-9)

    @property
    def driven(self) -> tuple[str, ...]:
        """The groups of coordinates that actuators move."""
        given = self.actuation.driven
        return DRIVEN[0] if "all" in given else tuple(group for group in DRIVEN[0] if group in given)

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
        return None if self.blocks.actuation is not None else self.actuation.wheels

    @property
    def drives(self) -> Drives | None:
        """The drives of the scenario's own actuators."""
        return None if self.blocks.actuation is not None else self.actuation.drives

    @property
    def grasp_time(self) -> float:
        """When the target is grasped, s; 0 where it is held from the start."""
        return 0.0 if self.capture is None or self.capture.approach is None else self.capture.approach.duration

    @property
    def planned_end(self) -> float | None:
        """When the planned motion ends, s; None where that is still to be found."""
        return None if self.reference.duration is None else self.grasp_time + self.reference.duration

    def tolerance_of(self, *names: str) -> float:
        """The tolerance of what goes by several names (a coordinate's own, its group's): that of the first known."""
        return next((self.tolerance[name] for name in (*names, "all") if name in self.tolerance), 1e-3)


def from_grasp(scenario: Scenario) -> Scenario:
    """The scenario from the grasp on, without an approach; one without a capture as it is."""
    if scenario.capture is None or scenario.grasp_time == 0.0:
        return scenario
    held = dataclasses.replace(scenario.capture, approach=None)
    return dataclasses.replace(scenario, duration=scenario.duration - scenario.grasp_time, capture=held)


# What a planned motion with the nominal payload does not depend on.
_OF_THE_RUN = (
    "description", "random_seed", "tolerance", "simulator_config", "initial_velocity", "controller",
    "controllers", "python_path", "estimator", "command_filter", "disturbance", "environment", "sensing",
)  # fmt: skip


def planned_part(scenario: Scenario) -> Scenario:
    """The scenario with defaults for all that its planned motion does not depend on.

    Runs that differ in nothing else, such as those of several controllers, share what is computed
    from it.
    """
    plain, truth = Scenario(), MassProperties()
    if scenario.capture is not None:  # the target turns about its true centre of mass before the grasp
        truth.center_of_mass = scenario.payload.truth.center_of_mass
    payload = dataclasses.replace(scenario.payload, truth=truth)
    changes = {name: getattr(plain, name) for name in _OF_THE_RUN}
    return dataclasses.replace(scenario, payload=payload, **changes)


def controller_key(controller: str) -> str:
    """The key in ``controllers`` of a controller: its name, or what follows the colon of ``module:attribute``."""
    return controller.rpartition(":")[2]


def inertia_matrix(body: MassProperties) -> np.ndarray:
    """Inertia about the centre of mass as a symmetric (3, 3) matrix, kg m^2."""
    ixx, iyy, izz, ixy, ixz, iyz = (*body.inertia, 0.0, 0.0, 0.0)[:6]
    return np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
