"""The joint tree of a spacecraft, read from a finished plant of Drake: constants of its
code, and parameters of each copy.
"""

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    FixedOffsetFrame,
    ForceElementIndex,
    Frame,
    FrameIndex,
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
_FRAME = 12  # parameters of a displaced frame: its rotation, its place in m
_AXES = {"revolute": "revolute_axis", "prismatic": "translation_axis"}
_MOST_LINKS = 60  # whose code is made in 5 s
_NEAR = 1e-12  # entries of rotations, and m, by which a frame is not displaced
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
    frame: int  # index of F in the plant


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tree:
    """A free base and its links; parents come first."""

    num_positions: int
    num_velocities: int
    base_position: int  # index in q of quaternion, position
    base_velocity: int  # index in v of angular velocity, velocity
    links: tuple[Link, ...]
    displaced: tuple[int, ...] = ()  # frames whose poses are parameters, not constants

    @property
    def num_parameters(self) -> int:
        """Number of parameters of a copy."""
        return self._num_bodies + _FRAME * len(self.displaced)

    @property
    def _num_bodies(self) -> int:
        return _INERTIA * (len(self.links) + 1) + _JOINT * len(self.links)

    def inertia_rows(self, body: int) -> slice:
        """A body's rows among the parameters: 0 is the base."""
        return slice(_INERTIA * body, _INERTIA * (body + 1))

    def joint_rows(self, body: int) -> slice:
        """Rows of the joint that moves a body, among the parameters."""
        first = _INERTIA * (len(self.links) + 1) + _JOINT * (body - 1)
        return slice(first, first + _JOINT)

    def placed(self, own: Any) -> "Tree":
        """Return the tree with the poses that its parameters give to displaced frames."""
        if not self.displaced:
            return self
        links = (
            dataclasses.replace(link, **self._pose(link.frame, own))
            if link.frame in self.displaced
            else link
            for link in self.links
        )
        return dataclasses.replace(self, links=tuple(links))

    def place_in(self, place: "Place", own: Any) -> "Place":
        """Return a place with the pose that the parameters give to its frame, if displaced."""
        if place.frame not in self.displaced:
            return place
        return place._replace(**self._pose(place.frame, own))

    def _pose(self, frame: int, own: Any) -> dict[str, Any]:
        first = self._num_bodies + _FRAME * self.displaced.index(frame)
        return {
            "rotation": own[first : first + 9].reshape(3, 3),
            "place": own[first + 9 : first + _FRAME],
        }


class Place(NamedTuple):
    """A frame that is fixed to a body of a tree."""

    body: int  # 0: the base, i: link i - 1
    rotation: tuple[tuple[float, ...], ...]  # (3, 3) in the body's frame
    place: tuple[float, ...]  # (3) of its origin there, m
    frame: int  # index in the plant


class Reader:
    """Reads the tree of a plant, and the parameters of its contexts."""

    def __init__(self, plant: MultibodyPlant, displaced: tuple[int, ...] = ()) -> None:
        """Args: the plant; see ``Tree.displaced``.

        Raises NotCovered: the plant has what the equations do not cover.
        """
        _check(plant)
        self._plant, self._default = plant, plant.CreateDefaultContext()
        (base,) = (plant.get_body(index) for index in plant.GetFloatingBaseBodies())
        self._frames, self._groups = [base.body_frame()], [_welded(plant, base)]
        self._joints: list[Joint] = []
        self._springs = _springs(plant)
        links = self._links(self._default)
        self.tree = Tree(
            num_positions=plant.num_positions(),
            num_velocities=plant.num_velocities(),
            base_position=base.floating_positions_start(),
            base_velocity=base.floating_velocities_start_in_v(),
            links=tuple(links),
            displaced=displaced,
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
                        frame=int(joint.frame_on_parent().index()),
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
        """Where a frame of the plant is, if it is not displaced."""
        body, X = self._body_of(frame), self._pose_in(self._default, frame)
        rotation = tuple(map(_exact, X.rotation().matrix()))
        return Place(body, rotation, tuple(X.translation().tolist()), int(frame.index()))

    def displaced_in(self, context: Context) -> tuple[int, ...]:
        """The frames of the plant that are elsewhere on their bodies than in a default context."""
        if not any(
            not each.GetPoseInParentFrame(context).IsExactlyEqualTo(pose)
            for each, pose in self._offsets
        ):
            return ()
        there = self._unposed(context)

        def is_elsewhere(frame: Frame) -> bool:
            usual = self._pose_in(self._default, frame)
            return not self._pose_in(there, frame).IsNearlyEqualTo(usual, _NEAR)

        frames = map(self._plant.get_frame, self._all_frames())
        return tuple(int(frame.index()) for frame in frames if is_elsewhere(frame))

    @functools.cached_property
    def _offsets(self) -> list[tuple[FixedOffsetFrame, RigidTransform]]:
        """The frames that a context can displace, with their default poses."""
        frames = map(self._plant.get_frame, self._all_frames())
        return [
            (each, each.GetPoseInParentFrame(self._default))
            for each in frames
            if isinstance(each, FixedOffsetFrame)
        ]

    def _all_frames(self) -> Iterable[FrameIndex]:
        """All but the frame of the world and those on it."""
        indices = map(FrameIndex, range(1, self._plant.num_frames()))
        on_bodies = {body for group in self._groups for body in group}
        return (each for each in indices if self._plant.get_frame(each).body().index() in on_bodies)

    def _body_of(self, frame: Frame) -> int:
        index = frame.body().index()
        return next(i for i, group in enumerate(self._groups) if index in group)

    def _pose_in(self, context: Context, frame: Frame) -> RigidTransform:
        body = self._frames[self._body_of(frame)]
        return self._plant.CalcRelativeTransform(context, body, frame)

    def _unposed(self, context: Context) -> Context:
        """A context with the default positions, for poses without rounding by its own ones."""
        there = context.Clone()
        self._plant.SetPositions(there, self._plant.GetPositions(self._default))
        return there

    def parameters(self, context: Context) -> np.ndarray:
        """The parameters (``Tree.num_parameters``) in a context of the plant."""
        bodies = [
            _inertia(self._plant, context, frame, group)
            for frame, group in zip(self._frames, self._groups, strict=True)
        ]
        joints = (np.array(self._of_joint(each, context)) for each in self._joints)
        rows = [*bodies, *joints]
        if self.tree.displaced:
            there = self._unposed(context)
            for index in self.tree.displaced:
                X = self._pose_in(there, self._plant.get_frame(FrameIndex(index)))
                rows += [X.rotation().matrix().ravel(), X.translation()]
        return np.concatenate(rows)

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
