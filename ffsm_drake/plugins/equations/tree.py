"""The joint tree of a spacecraft, read from a finished plant of Drake: constants of its
code, and parameters of each copy.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ForceElementIndex,
    Frame,
    Joint,
    PrismaticSpring,
    RevoluteSpring,
    RigidBody,
)
from pydrake.systems.framework import Context

from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.inertia import SIX

_INERTIA = 10  # parameters of a body: mass, mass times centre of mass, inertia xx yy zz xy xz yz
_JOINT = 3  # parameters of a joint: damping, reflected inertia of its rotor, stiffness
_AXES = {"revolute": "revolute_axis", "prismatic": "translation_axis"}
_MOST_LINKS = 60  # whose code is made in 5 s
_EXACT = 1e-15  # entries of rotations nearer than this to -1, 0 or 1 are these


@dataclasses.dataclass(frozen=True, kw_only=True)
class Link:
    """A body with those welded to it, moved by a joint; its frame is the joint's frame M."""

    parent: int  # 0: the base, i: link i - 1
    slides: bool  # along the axis; else it turns about it
    axis: tuple[float, ...]  # (3) in the link's frame
    rotation: tuple[tuple[float, ...], ...]  # (3, 3) of the joint's frame F in the parent's
    place: tuple[float, ...]  # (3) of F's origin in the parent's frame, m
    position: int  # index in q
    velocity: int  # index in v
    rest: float | None  # position without a spring's force, rad or m; None: no spring


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tree:
    """A free base and its links; parents come first."""

    num_positions: int
    num_velocities: int
    base_position: int  # index in q of quaternion, position
    base_velocity: int  # index in v of angular velocity, velocity
    links: tuple[Link, ...]

    @property
    def num_parameters(self) -> int:
        """Number of parameters of a copy."""
        return _INERTIA * (len(self.links) + 1) + _JOINT * len(self.links)

    def inertia_rows(self, body: int) -> slice:
        """A body's rows among the parameters: 0 is the base."""
        return slice(_INERTIA * body, _INERTIA * (body + 1))

    def joint_rows(self, body: int) -> slice:
        """Rows of the joint that moves a body, among the parameters."""
        first = _INERTIA * (len(self.links) + 1) + _JOINT * (body - 1)
        return slice(first, first + _JOINT)


class Place(NamedTuple):
    """A frame that is fixed to a body of a tree."""

    body: int  # 0: the base, i: link i - 1
    rotation: tuple[tuple[float, ...], ...]  # (3, 3) in the body's frame
    place: tuple[float, ...]  # (3) of its origin there, m


class Reader:
    """Reads the tree of a plant, and the parameters of its contexts."""

    def __init__(self, plant: MultibodyPlant) -> None:
        """Raises NotCovered: the plant has what the equations do not cover."""
        _check(plant)
        self._plant = plant
        (base,) = (plant.get_body(index) for index in plant.GetFloatingBaseBodies())
        self._frames, self._groups = [base.body_frame()], [_welded(plant, base)]
        self._joints: list[Joint] = []
        self._springs = _springs(plant)
        links = self._links(plant.CreateDefaultContext())
        self.tree = Tree(
            num_positions=plant.num_positions(),
            num_velocities=plant.num_velocities(),
            base_position=base.floating_positions_start(),
            base_velocity=base.floating_velocities_start_in_v(),
            links=tuple(links),
        )
        rotors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
        self._rotors = {rotor.joint().index(): rotor for rotor in rotors}

    def _links(self, context: Context) -> list[Link]:
        plant, links = self._plant, list[Link]()
        of_body = dict.fromkeys(self._groups[0], 0)
        waiting = [
            joint
            for joint in map(plant.get_joint, plant.GetJointIndices())
            if joint.num_velocities() == 1
        ]
        while waiting:
            ready = [each for each in waiting if each.parent_body().index() in of_body]
            if not ready:
                raise NotCovered(f"joint '{waiting[0].name()}', apart from the floating base")
            for joint in ready:
                parent = of_body[joint.parent_body().index()]
                X = plant.CalcRelativeTransform(
                    context, self._frames[parent], joint.frame_on_parent()
                )
                spring = self._springs.get(joint.index())
                links.append(
                    Link(
                        parent=parent,
                        slides=joint.type_name() == "prismatic",
                        axis=_exact(getattr(joint, _AXES[joint.type_name()])()),
                        rotation=tuple(map(_exact, X.rotation().matrix())),
                        place=tuple(X.translation().tolist()),
                        position=joint.position_start(),
                        velocity=joint.velocity_start(),
                        rest=None if spring is None else _rest(spring),
                    )
                )
                group = _welded(plant, joint.child_body())
                of_body |= dict.fromkeys(group, len(links))
                self._frames.append(joint.frame_on_child())
                self._groups.append(group)
                self._joints.append(joint)
            waiting = [each for each in waiting if each not in ready]
        if len(links) > _MOST_LINKS:
            raise NotCovered(f"{len(links)} joints (at most {_MOST_LINKS})")
        if plant.num_velocities() != 6 + len(links):
            raise NotCovered("parts of the model apart from the floating base")
        return links

    def place_of(self, frame: Frame) -> Place:
        """Where a frame of the plant is."""
        index = frame.body().index()
        body = next(i for i, group in enumerate(self._groups) if index in group)
        context = self._plant.CreateDefaultContext()
        X = self._plant.CalcRelativeTransform(context, self._frames[body], frame)
        rotation = tuple(map(_exact, X.rotation().matrix()))
        return Place(body, rotation, tuple(X.translation().tolist()))

    def parameters(self, context: Context) -> np.ndarray:
        """The parameters (``Tree.num_parameters``) in a context of the plant."""
        bodies = [
            _inertia(self._plant, context, frame, group)
            for frame, group in zip(self._frames, self._groups, strict=True)
        ]
        return np.concatenate([*bodies, *(self._of_joint(each, context) for each in self._joints)])

    def _of_joint(self, joint: Joint, context: Context) -> list[float]:
        rotor, spring = self._rotors.get(joint.index()), self._springs.get(joint.index())
        reflected = 0.0
        if rotor is not None:
            reflected = rotor.gear_ratio(context) ** 2 * rotor.rotor_inertia(context)
        stiffness = 0.0
        if isinstance(spring, RevoluteSpring):
            stiffness = spring.GetStiffness(context)
        elif spring is not None:
            stiffness = spring.stiffness()
        return [float(joint.GetDampingVector(context)[0]), reflected, stiffness]


def _check(plant: MultibodyPlant) -> None:
    if len(plant.GetFloatingBaseBodies()) != 1:
        raise NotCovered("a model without one floating base in quaternions")
    if plant.gravity_field().gravity_vector().any():
        raise NotCovered("gravity")
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        kind = joint.type_name()
        if kind not in (*_AXES, "weld", "quaternion_floating"):
            raise NotCovered(f"joint '{joint.name()}' of type {kind}")
    for index in plant.GetJointActuatorIndices():
        if plant.get_joint_actuator(index).has_controller():
            raise NotCovered(f"actuator '{plant.get_joint_actuator(index).name()}': its controller")
    if plant.num_constraints():
        raise NotCovered("constraints")


def _springs(plant: MultibodyPlant) -> dict[int, RevoluteSpring | PrismaticSpring]:
    """The spring of each joint by its index; a second one raises NotCovered."""
    found: dict[int, RevoluteSpring | PrismaticSpring] = {}
    for index in range(1, plant.num_force_elements()):  # the first is gravity
        element = plant.get_force_element(ForceElementIndex(index))
        if not isinstance(element, (RevoluteSpring, PrismaticSpring)):
            raise NotCovered(f"force element {type(element).__name__}")
        joint = element.joint()
        if joint.index() in found:
            raise NotCovered(f"two springs on joint '{joint.name()}'")
        found[joint.index()] = element
    return found


def _rest(spring: RevoluteSpring | PrismaticSpring) -> float:
    turns = isinstance(spring, RevoluteSpring)
    return float(spring.default_nominal_angle() if turns else spring.nominal_position())


def _welded(plant: MultibodyPlant, body: RigidBody) -> list[BodyIndex]:
    return [each.index() for each in plant.GetBodiesWeldedTo(body)]


def _exact(values: np.ndarray) -> tuple[float, ...]:
    """Numbers with rounding errors of -1, 0 and 1 taken off."""
    nearest = np.round(values)
    return tuple(np.where(np.abs(values - nearest) < _EXACT, nearest + 0.0, values).tolist())


def _inertia(
    plant: MultibodyPlant, context: Context, frame: Frame, group: list[BodyIndex]
) -> np.ndarray:
    """The inertia of welded bodies about a frame's origin, in its axes."""
    whole = plant.CalcSpatialInertia(context, frame, group)
    mass = whole.get_mass()
    if mass == 0.0:
        return np.zeros(_INERTIA)
    about = whole.CalcRotationalInertia().CopyToFullMatrix3()
    return np.concatenate([[mass], mass * whole.get_com(), about[SIX]])
