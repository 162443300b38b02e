"""Clearance: the smallest distance between parts of the spacecraft with relative motion.

The shapes are collision geometry, or visual geometry of a body without collision geometry. A mesh
is represented by its convex hull. Invented shapes, which represent a base without a picture, do not
count. Shapes that cannot be measured are listed.

Some pairs of parts are not checked: parts fixed to each other (target and gripper), parts connected
by a joint, and parts with few joints between them that are always close, such as the links of a
wrist. A held body of another model than the base is always checked against the base, and against
every part with a deep overlap at every joint angle.

Before a grasp the target is a separate body. Over the last decimetre and 20 degrees it may touch
the gripper and the parts that are not checked after the grasp. For a deep gripper,
this begins 5 cm before it meets the target. A flexible panel is represented by
its plates, with their deflections. It is not checked against its own body. Its visual geometry on
that body is checked in the rest position.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from pydrake.geometry import Mesh, Role, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, RigidBody

from ffsm_drake.common.errors import ModelError, one_line
from ffsm_drake.common.memo import memoized
from ffsm_drake.common.numbers import usable
from ffsm_drake.scenario import Model, Scenario
from ffsm_drake.spacecraft.coordinates import HIDDEN, joints_of
from ffsm_drake.spacecraft.distance import Solids, measures_of
from ffsm_drake.spacecraft.plant import (
    drawn_plant,
    find_body,
    find_frame,
    flexible_parts,
    hand_frame,
    model_files,
    parsed_plant,
)

TOLERANCE = 1e-6  # m; rounding: parts nearer than that to contact touch, and to a limit keep it

# Visuals whose names begin so stand for a link without a picture, and for a shape, named after
# them, that cannot be measured.
INVENTED, UNMEASURED = "invented", "unmeasured"

# Bodies with few joints between them that are near at every joint angle are left out.
_NEIGHBOURS, _NEAR = 3, 0.2  # joints, m
_TRIALS = 40  # joint configurations tested
_DEEP = 0.1  # m; no wrist's shapes overlap a held body by more at every joint angle

# Nearer to the grasp (or to where a deep gripper meets the target), and turned less from it, the
# gripper may touch the target: m, rad, m.
_REACH, _TURN, _MARGIN = 0.1, 0.35, 0.05


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Shape:
    body: RigidBody
    shape: Shape
    pose: RigidTransform  # X_BG


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nearest:
    """The smallest distance in one configuration."""

    distance: float  # m; negative: depth of overlap; 0: contact; infinite: no bodies can meet
    first: str  # names of the bodies
    second: str

    def __str__(self) -> str:
        return f"{self.first} and {self.second} {in_words(self.distance, '{} apart')}"

    def keeps(self, least: float) -> bool:
        """Whether the distance is a least one, m, or within rounding of it."""
        return self.distance >= least - TOLERANCE


def in_words(distance: float, apart: str) -> str:
    """How two parts at a signed distance (m) are; ``apart``: the words where they do not touch."""
    if distance < 0.0:
        return f"overlap by {-distance:.3g} m"
    return apart.format(f"{distance:.3g} m") if distance else "touch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Approach:
    """The closest approach of the spacecraft's parts along a motion."""

    index: int  # index of the configuration
    nearest: Nearest


class Clearance:
    """Distances between the parts of a spacecraft. The plant's context is a scratch pad.

    Configurations are the spacecraft's, then the pose of a body that is apart, then deflections;
    without the last, flexible parts are at rest.
    """

    def __init__(
        self,
        model: Model,
        *,
        apart: str | None = None,
        flexible: bool = False,
        invented: bool = False,
        hands: Sequence[Sequence[str]] = (),
    ) -> None:
        """Load the model.

        Args:
          model: the model.
          apart: body (scoped name) not grasped yet, whose pose then follows the configuration.
          flexible: with the plates of flexible panels.
          invented: with shapes that stand for links without a picture.
          hands: frames (scoped names) of hands, which may touch the target, and on the target.

        Raises:
          ModelError: the model does not load, or MuJoCo does not accept its shapes.
        """
        self.plant: MultibodyPlant = parsed_plant(model, apart=apart, flexible=flexible)
        self.plant_context = self.plant.CreateDefaultContext()
        self._places = _places_in(self.plant)
        # frames of a hand, and on the target, where it holds that
        self._grips = [
            [find_frame(self.plant, each, key="contacts") for each in both] for both in hands
        ]
        self._bodies = [self.plant.get_body(BodyIndex(i)) for i in range(self.plant.num_bodies())]
        self._shapes, self.unmeasured = list[_Shape](), list[str]()
        self._gather(model, flexible=flexible, invented=invented)
        self._shaped = [b for b in self._bodies if any(s.body is b for s in self._shapes)]
        try:
            self._solids = Solids(
                [(self._shaped.index(s.body), s.shape, s.pose) for s in self._shapes]
            )
        except (RuntimeError, ValueError) as error:
            raise ModelError(f"model: shapes without a distance: {one_line(error)}") from error
        self.pairs = self._free_pairs()
        pairs = [(k, pair) for k, both in enumerate(self.pairs) for pair in self._solids_of(*both)]
        self._measured = np.array([pair for _, pair in pairs], dtype=int).reshape(-1, 2)
        self._bodies_of = [self.pairs[k] for k, _ in pairs]
        # the pairs of shapes that must keep clear, by those of bodies that may touch
        self._apart = dict[
            frozenset[frozenset[BodyIndex]], tuple[np.ndarray, list[tuple[RigidBody, RigidBody]]]
        ]()

    def _gather(self, model: Model, *, flexible: bool, invented: bool) -> None:
        """Find the shapes that count, and name those that cannot be measured."""
        parts = flexible_parts().flexible_bodies(self.plant, model) if model.flexible else ()
        is_plate = {body.index(): plate for body, plate in parts}
        plant, scene_graph = drawn_plant(model, flexible=flexible)
        inspector = scene_graph.model_inspector()
        for body in self._bodies:
            frame = plant.GetBodyFrameIdOrThrow(body.index())
            shapes = inspector.GetGeometries(frame, Role.kProximity)
            if is_plate.get(body.index(), not shapes):
                shapes += inspector.GetGeometries(frame, Role.kIllustration)
            for geometry in shapes:
                name = inspector.GetName(geometry).rpartition("::")[2]
                shape, pose = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
                if name.startswith(INVENTED) and not invented:
                    continue
                try:
                    if name.startswith(UNMEASURED):
                        raise ValueError(name.partition(" ")[2])
                    measures_of(shape)
                    self._shapes.append(_Shape(body=body, shape=shape, pose=pose))
                except (RuntimeError, ValueError) as error:
                    what = shape.source().path().name if isinstance(shape, Mesh) else error
                    self.unmeasured.append(f"{body.name()} ({what})")

    def placed(self) -> Iterator[tuple[str, Shape, RigidTransform]]:
        """Each shape, with the scoped name of its body, and its pose X_BG in that."""
        for each in self._shapes:
            yield each.body.scoped_name().get_full(), each.shape, each.pose

    def nearest(self, q: np.ndarray, *, below: float = np.inf) -> Nearest:
        """Return the smallest distance in configuration q (n), if below ``below`` (m).

        A smaller ``below`` is faster.
        """
        pairs, bodies = self._place(q)
        distance, index = self._solids.least(pairs, below)
        if index < 0:
            return Nearest(distance=np.inf, first="", second="")
        first, second = sorted(body.name() for body in bodies[index])
        if abs(distance) < TOLERANCE:
            distance = 0.0
        return Nearest(distance=distance, first=first, second=second)

    def within(
        self, q: np.ndarray, most: float
    ) -> Iterator[tuple[float, np.ndarray, tuple[RigidBody, RigidBody]]]:
        """The shapes nearer to each other than ``most`` (m) in configuration q (n): distance (m),
        nearest points (2, 3) in the world, and bodies.
        """
        pairs, bodies = self._place(q)
        for index, distance, points in self._solids.within(pairs, most):
            yield distance, points, bodies[index]

    def _place(self, q: np.ndarray) -> tuple[np.ndarray, list[tuple[RigidBody, RigidBody]]]:
        """Take a configuration; the pairs of shapes that may not touch then, and their bodies."""
        whole = np.zeros(self._places.size)
        whole[self._places[: q.size]] = q
        self._move(whole)
        met = frozenset(self._may_touch())
        if met not in self._apart:
            bodies = (frozenset(body.index() for body in both) for both in self._bodies_of)
            kept = [k for k, both in enumerate(bodies) if both not in met]
            self._apart[met] = self._measured[kept], [self._bodies_of[k] for k in kept]
        return self._apart[met]

    def _move(self, q: np.ndarray, grip: Sequence[Frame] = ()) -> None:
        """Put the shapes where a configuration of the plant has them, the target in a hand."""
        context = self.plant_context
        self.plant.SetPositions(context, q)
        poses = [body.EvalPoseInWorld(context) for body in self._shaped]
        if grip:
            hand, at = grip
            for k, body in enumerate(self._shaped):
                if not self._is_held(body, at.body()):
                    in_hand = body.body_frame().CalcPose(context, at)
                    poses[k] = hand.CalcPoseInWorld(context) @ in_hand
        self._solids.place(np.array([pose.GetAsMatrix34() for pose in poses]))

    def _solids_of(self, first: RigidBody, second: RigidBody) -> list[tuple[int, int]]:
        """Return the pairs of shapes of two bodies."""
        one, other = (
            [k for k, each in enumerate(self._shapes) if each.body is body]
            for body in (first, second)
        )
        return [*itertools.product(one, other)]

    def along(self, positions: np.ndarray, *, enough: float = -np.inf) -> Approach:
        """Return the closest approach along configurations (n, nq); those not ``usable`` are
        skipped, and all after the first that is as near as ``enough`` (m).
        """
        known = np.flatnonzero(usable(positions))
        if not known.size:
            raise ValueError("none of the configurations can be evaluated")
        nothing = Nearest(distance=np.inf, first="", second="")
        best = Approach(index=int(known[0]), nearest=nothing)
        for index in known:
            nearest = self.nearest(positions[index], below=best.nearest.distance)
            if nearest.distance < best.nearest.distance:
                best = Approach(index=int(index), nearest=nearest)
            if best.nearest.distance <= enough:
                break
        return best

    def _may_touch(self) -> set[frozenset[BodyIndex]]:
        """Pairs of bodies that may touch in the present configuration."""
        return set()

    def _free_pairs(self) -> list[tuple[RigidBody, RigidBody]]:
        """Return the pairs of bodies with shapes that must keep clear of each other."""
        plant, pairs = self.plant, list[tuple[RigidBody, RigidBody]]()
        # the joints that move each body; a flexible part belongs to its carrying body
        moving = {body.index(): set[Joint]() for body in self._bodies}
        for joint in map(plant.get_joint, plant.GetJointIndices()):
            if joint.num_velocities() and _is_known(joint):
                for index in plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
                    moving[index].add(joint)
        shaped = [body for body in self._shaped if body.index() != 0]
        for first, second in itertools.combinations(shaped, 2):
            one, other = moving[first.index()], moving[second.index()]
            between, grip = one ^ other, []
            for each in self._grips if self._is_held(first, second) else ():
                link = one if self._is_held(first, each[1].body()) else other
                own = link ^ moving[each[0].body().index()]
                if len(own) < len(between):
                    between, grip = own, each
            joints = sorted(between, key=lambda joint: joint.velocity_start())
            if not joints:
                continue
            connected = {
                frozenset((each.parent_body().index(), each.child_body().index()))
                for each in joints
            }
            if frozenset((first.index(), second.index())) in connected:
                continue
            is_free = any(joint.num_velocities() > 1 for joint in joints)
            is_base = min(len(one), len(other)) == 1  # only its free joint moves it
            if (
                is_free
                or len(joints) > _NEIGHBOURS
                or (self._is_held(first, second) and is_base)
                or not self._always_near(first, second, joints, grip)
            ):
                pairs.append((first, second))
        return pairs

    @staticmethod
    def _is_held(first: RigidBody, second: RigidBody) -> bool:
        """Whether two bodies are of different models, a servicer and what it holds."""
        return first.model_instance() != second.model_instance()

    def _always_near(
        self, first: RigidBody, second: RigidBody, joints: list[Joint], grip: Sequence[Frame]
    ) -> bool:
        """True if two bodies are nearer than _NEAR at every angle of the joints between them, and
        what is held does not overlap by more than _DEEP at all of them; ``grip``: see ``_grips``.
        """
        q = self.plant.GetPositions(self.plant_context)  # with unit quaternions
        pairs = np.array(self._solids_of(first, second))
        generator, least = np.random.default_rng(0), -np.inf
        for _ in range(_TRIALS):
            for joint in joints:
                limits = [*joint.position_lower_limits(), *joint.position_upper_limits()]
                if not np.isfinite(limits).all():
                    limits = [-1.0, 1.0] if joint.type_name() == "prismatic" else [-np.pi, np.pi]
                q[joint.position_start()] = generator.uniform(*limits)
            self._move(q, grip)
            distance, _ = self._solids.least(pairs)
            if distance > _NEAR:
                return False
            least = max(least, distance)
        return least > -_DEEP or not self._is_held(first, second)


def _is_known(joint: Joint) -> bool:
    return not joint.name().startswith(HIDDEN)


def _places_in(plant: MultibodyPlant) -> np.ndarray:
    """For each entry of a configuration its place in the plant's q: deflections come last."""
    hidden = [each.position_start() for each in joints_of(plant) if not _is_known(each)]
    return np.r_[np.setdiff1d(np.arange(plant.num_positions()), hidden), hidden].astype(int)


class ApproachClearance(Clearance):
    """Clearance before the grasp.

    Configurations are the servicer's, then the target's pose (quaternion, position).
    """

    def __init__(
        self,
        model: Model,
        target: str,
        *,
        flexible: bool = False,
        hands: Sequence[Sequence[str]] = (),
    ) -> None:
        """Args:
          model: the model.
          target: scoped name of the target.
          flexible: whether flexible parts are included.
          hands: see ``Clearance``; they may touch it near the grasp.

        Raises the errors of ``Clearance``.
        """
        super().__init__(model, apart=target, flexible=flexible)
        held = Clearance(model, hands=hands)
        body, context = find_body(held.plant, target, key="payload.body"), held.plant_context
        self._X_PE = hand_frame(held.plant, model).CalcPose(context, body.body_frame())  # at grasp
        self._hand = hand_frame(self.plant, model)
        self._target = find_body(self.plant, target, key="payload.body")
        # Near the grasp the pairs of a held target are checked: without the gripper, and without
        # links always near it.
        apart = {
            each.scoped_name().get_full()
            for pair in held.pairs
            if target in (names := [body.scoped_name().get_full() for body in pair])
            for each, name in zip(pair, names, strict=True)
            if name != target
        }
        self._gripping = {
            frozenset((self._target.index(), body.index()))
            for body in self._bodies
            if body.scoped_name().get_full() not in apart
        }
        pairs = [
            pair
            for each in held.plant.GetBodiesWeldedTo(body)
            for pair in held._solids_of(body, each)
            if self._is_held(body, each)
        ]
        held._move(held.plant.GetPositions(context))
        least, _ = held._solids.least(np.reshape(np.array(pairs, int), (-1, 2)))
        self._reach = max(_REACH, _MARGIN - least)

    def _may_touch(self) -> set[frozenset[BodyIndex]]:
        context = self.plant_context
        grasp = self._target.EvalPoseInWorld(context) @ self._X_PE
        offset = grasp.inverse() @ self._hand.CalcPoseInWorld(context)
        gap, turn = np.linalg.norm(offset.translation()), offset.rotation().ToAngleAxis().angle()
        return self._gripping if gap < self._reach and turn < _TURN else set()


def shapes_of(scenario: Scenario, *, apart: bool = False) -> Clearance:
    """Return the collision shapes of a scenario's model, flexible parts included; ``apart``: its
    target is not grasped yet.
    """
    hands = tuple((each.effector, each.frame) for each in scenario.contacts.values())
    return _loaded(scenario.model, scenario.payload.body if apart else None, hands)


# called after every run of a campaign; loading is slow
@memoized(maxsize=4, files=model_files)
def _loaded(model: Model, apart: str | None, hands: Sequence[Sequence[str]]) -> Clearance:
    """Return the shapes of a model."""
    if apart is None:
        return Clearance(model, flexible=True, hands=hands)
    return ApproachClearance(model, apart, flexible=True, hands=hands)
