"""Flexible parts of the true spacecraft: panels, beams, slosh, passive joints, flexible gears.

``model.flexible`` names them. Each adds hidden coordinates to the true plant, held by
springs and dampers; with them locked at zero it is the rigid spacecraft of the controller's model.
A beam is represented by the equivalent masses of its cantilever modes: mode i is a point mass m_i,
sliding across the beam at the distance h_i from the root, with the same force and moment at the
root as the bending mode (modal effective masses; the rest is rigid).
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from pydrake.geometry import Box, Shape, Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ForceElementIndex,
    ModelInstanceIndex,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError, choices
from ffsm_drake.scenario import Flexible, Model
from ffsm_drake.spacecraft.coordinates import HIDDEN, StateSplit, joints_of
from ffsm_drake.spacecraft.inertia import spatial_inertia_about

_INSTANCE = "flexible"  # the model instance of the bodies
_COLOR = np.array([0.16, 0.33, 0.72, 0.85])
_OF_A_JOINT = ("joint", "gear")
# Bending of a uniform cantilever: roots of 1 + cos(x) cosh(x) = 0.
_CANTILEVER = (
    1.8751040687119611,
    4.694091132974174,
    7.854757438237613,
    10.995540734875467,
    14.137168391046471,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BeamMode:
    """Equivalent mass of a bending mode of a uniform cantilever, as fractions of the beam's."""

    mass: float  # share of the beam's mass
    distance: float  # from the root, of the beam's length


def cantilever_modes(count: int) -> list[BeamMode]:
    """The first bending modes of a uniform cantilever (at most 5).

    With the shape phi and the beam of unit mass and length, mass = (int phi)^2 / int phi^2 and
    distance = int x phi / int phi (in closed form: int x phi = 2 / x_i^2, int phi = 2 sigma / x_i,
    int phi^2 = 1).
    """
    modes = []
    for root in _CANTILEVER[:count]:
        sigma = (math.sinh(root) - math.sin(root)) / (math.cosh(root) + math.cos(root))
        modes.append(BeamMode(mass=(2.0 * sigma / root) ** 2, distance=1.0 / (sigma * root)))
    return modes


def labels_of(name: str, part: Flexible) -> list[str]:
    """Names of a part's hidden coordinates: its own, numbered where there are several."""
    count = (
        len(part.frequencies) if part.kind == "beam" else part.plates if part.kind == "panel" else 1
    )
    return [name] if count == 1 else [f"{name}_{i + 1}" for i in range(count)]


def add_flexible(plant: MultibodyPlant, model: Model) -> None:
    """Add the hidden coordinates to a plant that holds servicer and target, before it is finalized.

    Raises ModelError: a body or joint does not exist, or cannot be made flexible.
    """
    if not model.flexible:
        return
    if plant.HasModelInstanceNamed(_INSTANCE):
        raise ModelError(f"model.flexible: a model is named '{_INSTANCE}' already; rename it")
    instance = plant.AddModelInstance(_INSTANCE)
    # Drake takes no joint away once there are springs.
    loose = {
        name: _loosen(plant, name, part)
        for name, part in model.flexible.items()
        if part.kind in _OF_A_JOINT
    }
    for joint in loose.values():
        plant.AddForceElement(RevoluteSpring(joint, 0.0, 0.0))
    for name, part in model.flexible.items():
        if part.kind in _OF_A_JOINT:
            continue
        at, X_AB = _body(plant, name, part).body_frame(), RigidTransform(_axes(part), part.position)
        for label, added in zip(labels_of(name, part), _bodies(part), strict=True):
            link = plant.AddRigidBody(label, instance, added.inertia)
            place = plant.AddFrame(FixedOffsetFrame(f"{label}_place", at, X_AB @ added.place))
            frames = f"{HIDDEN}{label}", place, link.body_frame()
            if added.stiffness is None:
                hinge = plant.AddJoint(RevoluteJoint(*frames, [1.0, 0.0, 0.0]))
                plant.AddForceElement(RevoluteSpring(hinge, 0.0, 0.0))
            else:
                slide = plant.AddJoint(PrismaticJoint(*frames, [0.0, 0.0, 1.0]))
                plant.AddForceElement(PrismaticSpring(slide, 0.0, added.stiffness))
            if plant.geometry_source_is_registered():
                plant.RegisterVisualGeometry(
                    link, added.drawn_at, added.drawn, f"{label}_visual", _COLOR
                )
            if added.carries_next:
                at, X_AB = link.body_frame(), RigidTransform()


def flexible_bodies(plant: MultibodyPlant, model: Model) -> Iterator[tuple[RigidBody, bool]]:
    """The bodies that ``add_flexible`` added, each with whether it is a panel's plate."""
    if plant.HasModelInstanceNamed(_INSTANCE):
        instance = plant.GetModelInstanceByName(_INSTANCE)
        for name, part in model.flexible.items():
            if part.kind not in _OF_A_JOINT:
                for label in labels_of(name, part):
                    yield plant.GetBodyByName(label, instance), part.kind == "panel"


def lock_joints(plant: MultibodyPlant, model: Model) -> None:
    """Fix the joints that only the true plant has, at zero, before it is finalized.

    Raises ModelError: a joint does not exist, or cannot be fixed.
    """
    for name, part in model.flexible.items():
        if part.kind == "joint":
            joint = _joint(plant, name, part)
            parent, child = joint.frame_on_parent(), joint.frame_on_child()
            plant.RemoveJoint(joint)
            plant.AddJoint(WeldJoint(f"{HIDDEN}{name}", parent, child, RigidTransform()))


def set_flexible(plant: MultibodyPlant, context: Context, model: Model) -> None:
    """Subtract the parts' masses from their bodies, and set springs and dampers, in one context.

    Call it once for a context, after the masses of the bodies are set; all coordinates must be
    zero.

    Raises ModelError: a body has less mass or inertia than its flexible parts.
    """
    if not model.flexible:
        return
    for name in dict.fromkeys(
        part.body for part in model.flexible.values() if part.kind not in _OF_A_JOINT
    ):
        take_masses(plant, context, model, body=name)
    springs = {spring.joint().index(): spring for spring in _springs(plant)}
    matrix = plant.CalcMassMatrix(context)  # at rest: the inertia on the springs
    for name, part in model.flexible.items():
        joints = [plant.GetJointByName(f"{HIDDEN}{label}") for label in labels_of(name, part)]
        rows = [joint.velocity_start() for joint in joints]
        held = float(np.linalg.eigvalsh(matrix[np.ix_(rows, rows)])[-1])
        for i, (joint, row) in enumerate(zip(joints, rows, strict=True)):
            own = float(matrix[row, row]) if part.kind == "beam" else held
            frequency = part.frequencies[i] if part.kind == "beam" else part.frequency
            stiffness = (
                part.stiffness if frequency is None else (2.0 * math.pi * frequency) ** 2 * own
            )
            joint.SetDampingVector(
                context, [2.0 * part.damping_ratio * math.sqrt((stiffness or 0.0) * own)]
            )
            if joint.index() in springs:
                springs[joint.index()].SetStiffness(context, stiffness or 0.0)


def take_masses(plant: MultibodyPlant, context: Context, model: Model, *, body: str) -> None:
    """Subtract the masses of a body's (scoped name) flexible parts from its own, in one context.

    Raises ModelError: the body has less mass or inertia than its flexible parts.
    """
    carrier, carried = None, list[SpatialInertia]()
    for name, part in model.flexible.items():
        if part.kind in _OF_A_JOINT or part.body != body:
            continue
        carrier = _body(plant, name, part)
        X_BA = RigidTransform(_axes(part), part.position)
        for added in _bodies(part):
            X_BF = X_BA @ added.place
            carried.append(added.inertia.ReExpress(X_BF.rotation()).Shift(-X_BF.translation()))
            if added.carries_next:
                X_BA = X_BF
    if carrier is None:
        return
    total = carrier.CalcSpatialInertiaInBodyFrame(context)
    try:
        carrier.SetSpatialInertiaInBodyFrame(context, _less(total, carried))
    except (RuntimeError, ValueError, SystemExit) as error:
        mass = sum(each.get_mass() for each in carried)
        raise ModelError(
            f"model.flexible: {mass:g} kg of the {total.get_mass():g} kg of '{body}' are on "
            "springs, and the rest has no physical inertia; make the parts lighter or shorter"
        ) from error


@dataclasses.dataclass(frozen=True, kw_only=True)
class VibrationMode:
    """A mode of vibration of the hidden coordinates, near one posture at rest, without damping."""

    frequency: float  # Hz; of the free spacecraft
    clamped_frequency: float  # Hz; of the same shape with all known coordinates held
    damping_ratio: float  # free mode, without coupling to others
    shape: np.ndarray  # (nh) of the hidden coordinates, the largest 1
    share: np.ndarray  # (nv) fraction of each known coordinate's inertia that the mode carries


def modes_of(plant: MultibodyPlant, context: Context, split: StateSplit) -> list[VibrationMode]:
    """The modes of vibration in a plant's present configuration, the slowest first.

    They solve (H_uu - H_ua H_aa^-1 H_au) q_u'' + K q_u = 0, of known (a) and hidden (u)
    coordinates.
    """
    known, hidden = split.known, split.hidden
    mass_matrix = plant.CalcMassMatrix(context)
    own, across = mass_matrix[np.ix_(hidden, hidden)], mass_matrix[np.ix_(known, hidden)]
    free = own - across.T @ np.linalg.solve(mass_matrix[np.ix_(known, known)], across)
    joints = {joint.velocity_start(): joint for joint in joints_of(plant)}
    springs = {spring.joint().index(): spring.GetStiffness(context) for spring in _springs(plant)}
    for spring in _springs(plant, PrismaticSpring):
        springs[spring.joint().index()] = spring.stiffness()
    stiffness = np.array([springs[joints[row].index()] for row in hidden])
    damping = np.array([joints[row].GetDampingVector(context)[0] for row in hidden])
    # Symmetric in the coordinates sqrt(k) q_u: the eigenvalues are 1 / w^2.
    scale = 1.0 / np.sqrt(stiffness)
    inverse, vectors = np.linalg.eigh(scale[:, None] * free * scale)
    modes = []
    for value, vector in zip(inverse[::-1], vectors.T[::-1], strict=True):
        shape = scale * vector
        shape = shape / shape[np.argmax(np.abs(shape))]
        energy, w = float(shape**2 @ stiffness), 1.0 / math.sqrt(value)
        held = float(shape @ own @ shape)
        modes.append(
            VibrationMode(
                frequency=w / (2.0 * math.pi),
                clamped_frequency=math.sqrt(energy / held) / (2.0 * math.pi),
                damping_ratio=float(shape**2 @ damping) * w / (2.0 * energy),
                shape=shape,
                share=(across @ shape) ** 2 / (held * np.diagonal(mass_matrix)[known]),
            )
        )
    return modes


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Added:
    """A body that a part adds; its frame F has x along the axis of hinge or bending, y outwards."""

    inertia: SpatialInertia  # M_FFo_F
    drawn: Shape
    drawn_at: RigidTransform = dataclasses.field(default_factory=RigidTransform)  # X_FG
    # X_AF on the carrying body
    place: RigidTransform = dataclasses.field(default_factory=RigidTransform)
    stiffness: float | None = None  # N/m; it slides along z; None: it is hinged about x
    carries_next: bool = False  # the next body of the part


def _bodies(part: Flexible) -> Iterator[_Added]:
    """The bodies that a part adds, from the root outward."""
    if part.kind == "mass":
        stiffness = part.stiffness
        if part.frequency is not None:
            stiffness = (2.0 * math.pi * part.frequency) ** 2 * part.mass
        yield _Added(inertia=_point(part.mass), drawn=Sphere(0.12), stiffness=stiffness)
    elif part.kind == "beam":
        modes = cantilever_modes(len(part.frequencies))
        for mode, frequency in zip(modes, part.frequencies, strict=True):
            mass = mode.mass * part.mass
            yield _Added(
                inertia=_point(mass),
                drawn=Sphere(0.06),
                place=RigidTransform([0.0, mode.distance * part.length, 0.0]),
                stiffness=(2.0 * math.pi * frequency) ** 2 * mass,
            )
    elif part.kind == "pendulum":
        end = np.array([0.0, part.length, 0.0])
        yield _Added(
            inertia=_point(part.mass, end), drawn=Sphere(0.12), drawn_at=RigidTransform(end)
        )
    else:
        length = part.length / part.plates
        for k in range(part.plates):
            yield _Added(
                inertia=_plate(part.mass / part.plates, length, part.width),
                drawn=Box(part.width, length, 0.03),
                drawn_at=RigidTransform([0.0, 0.5 * length, 0.0]),
                place=RigidTransform([0.0, length if k else 0.0, 0.0]),
                carries_next=True,
            )


def _point(mass: float, place: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)) -> SpatialInertia:
    return SpatialInertia(
        mass=mass, p_PScm_E=np.array(place), G_SP_E=UnitInertia.PointMass(p_FQ=np.array(place))
    )


def _plate(mass: float, length: float, width: float) -> SpatialInertia:
    """A thin plate that begins at its frame's origin and lies along y, its width along x."""
    about_x, about_y = mass * length**2 / 12.0, mass * width**2 / 12.0
    return SpatialInertia.MakeFromCentralInertia(
        mass=mass,
        p_PScm_E=[0.0, 0.5 * length, 0.0],
        I_SScm_E=RotationalInertia(Ixx=about_x, Iyy=about_y, Izz=about_x + about_y),
    )


def _axes(part: Flexible) -> RotationMatrix:
    """R_BF: x along the axis, y along the direction; of a mass, z along the direction."""
    along = np.array(part.direction, dtype=float) / np.linalg.norm(part.direction)
    if part.kind == "mass":
        return RotationMatrix.MakeFromOneVector(along, 2)
    x = np.array(part.axis, dtype=float) / np.linalg.norm(part.axis)
    return RotationMatrix(np.stack([x, along, np.cross(x, along)], axis=1))


def _less(total: SpatialInertia, parts: Iterable[SpatialInertia]) -> SpatialInertia:
    """A spatial inertia less some of its parts, all about the same point and in the same axes."""
    mass, moment = total.get_mass(), total.get_mass() * total.get_com()
    inertia = total.CalcRotationalInertia().CopyToFullMatrix3()
    for part in parts:
        mass, moment = mass - part.get_mass(), moment - part.get_mass() * part.get_com()
        inertia = inertia - part.CalcRotationalInertia().CopyToFullMatrix3()
    if not mass > 0.0:
        raise ValueError("no mass is left")
    return spatial_inertia_about(mass, moment / mass, inertia)


def _loosen(plant: MultibodyPlant, name: str, part: Flexible) -> RevoluteJoint:
    """The hidden joint in place of one of the model, or between it and its link."""
    joint = _joint(plant, name, part)
    parent, child, axis = joint.frame_on_parent(), joint.frame_on_child(), joint.revolute_axis()
    lower, upper = joint.position_lower_limit(), joint.position_upper_limit()
    label, damping = joint.name(), joint.default_damping()
    plant.RemoveJoint(joint)
    if part.kind == "gear":
        rotor = plant.AddRigidBody(
            f"{name}_rotor", plant.GetModelInstanceByName(_INSTANCE), SpatialInertia.Zero()
        )
        plant.AddJoint(
            RevoluteJoint(label, parent, rotor.body_frame(), axis, lower, upper, damping)
        )
        parent = rotor.body_frame()
    return plant.AddJoint(RevoluteJoint(f"{HIDDEN}{name}", parent, child, axis))


def _springs(plant: MultibodyPlant, kind: type = RevoluteSpring) -> list[Any]:
    elements = [
        plant.get_force_element(ForceElementIndex(i)) for i in range(plant.num_force_elements())
    ]
    return [each for each in elements if isinstance(each, kind)]


def spring_stiffness(plant: MultibodyPlant, context: Context) -> dict[str, float]:
    """Return the stiffness of each hinge spring by the name of its joint, N m/rad."""
    return {each.joint().name(): each.GetStiffness(context) for each in _springs(plant)}


def _body(plant: MultibodyPlant, name: str, part: Flexible) -> RigidBody:
    found = {
        str(plant.get_body(index).scoped_name()): plant.get_body(index)
        for instance in _instances(plant)
        for index in plant.GetBodyIndices(instance)
    }
    if part.body not in found:
        raise ModelError(
            f"model.flexible.{name}.body: no body '{part.body}'; choose one of "
            f"{choices(part.body, found)}"
        )
    return found[part.body]


def _joint(plant: MultibodyPlant, name: str, part: Flexible) -> RevoluteJoint:
    place = f"model.flexible.{name}.joint"
    joints = [
        plant.get_joint(index)
        for instance in _instances(plant)
        for index in plant.GetJointIndices(instance)
    ]
    found = {str(joint.name()): joint for joint in joints if isinstance(joint, RevoluteJoint)}
    if part.joint not in found:
        raise ModelError(
            f"{place}: no revolute joint '{part.joint}'; choose one of {choices(part.joint, found)}"
        )
    joint = found[part.joint]
    if any(
        actuator.joint() is joint
        for actuator in map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    ):
        raise ModelError(
            f"{place}: '{part.joint}' has an actuator in its URDF; take its <transmission> out"
        )
    return joint


def _instances(plant: MultibodyPlant) -> list[ModelInstanceIndex]:
    """The model instances of servicer and target."""
    indices = map(ModelInstanceIndex, range(2, plant.num_model_instances()))
    return [index for index in indices if plant.GetModelInstanceName(index) != _INSTANCE]
