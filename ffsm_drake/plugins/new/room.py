"""Distances of parts in postures in which two hands hold a target, or reach for it.

A hand may extend beyond its frame, into the target that it holds. It may touch the target. So may
its fingers, and links that are near the target in every posture of the hand, such as its wrist.
"""

from collections.abc import Iterator

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody

from ffsm_drake.common.so3 import matrix_of, quaternion_of
from ffsm_drake.plugins.new.draft import Draft
from ffsm_drake.plugins.new.postures import CLEAR, Postures
from ffsm_drake.plugins.new.urdf.target import Target
from ffsm_drake.spacecraft.clearance import Clearance
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS
from ffsm_drake.spacecraft.plant import find_body, find_frame

_BEFORE = (1.0, 2.0, 3.0)  # s before the grasp, in which the base is already close
_TOLD = 1e-3  # m, of a depth
_AWAY = 1e3  # m, of a target that nothing can meet


class Room:
    """Distances of the parts of a servicer and a target. Joints (n) are in rad or m."""

    def __init__(self, draft: Draft, target: Target, second: list[str]) -> None:
        """Load the model.

        Args:
          draft: the present scenario.
          target: the target.
          second: joints that move the second hand only.
        """
        model, self._target = draft.scenario.model, f"debris::{target.body}"
        tips = (draft.servicer.tip, draft.servicer.second)
        self._names = [tip.frame for tip in tips if tip is not None]
        hands = [f"servicer::{name}" for name in self._names]
        places = [f"debris::{name}" for name in (target.grasp, target.second or target.grasp)]
        self._held = Clearance(
            model, flexible=True, invented=True, hands=[*zip(hands, places, strict=True)]
        )
        self._apart = Clearance(model, flexible=True, apart=self._target)
        self._second = _moved(self._held.plant, second)
        self._moving = _moved(self._apart.plant, [*draft.coordinates.joints])
        self._ends = [_hand(self._apart.plant, hand) for hand in hands]
        capture = draft.scenario.capture
        self._rate = np.array(capture.rate) if capture else np.zeros(3)

    def is_free(self, joints: np.ndarray) -> bool:
        """Whether the parts that the second arm does not move keep clear, the target included."""
        return all(self._second & pair for _, pair in self._holding(joints))

    def distance(self, joints: np.ndarray) -> float:
        """Return the smallest distance with the target held, m; infinite above ``CLEAR``."""
        return min((d for d, _ in self._holding(joints)), default=np.inf)

    def along(self, rows: np.ndarray) -> float:
        """Return the smallest ``distance`` of configurations (n, nq), m."""
        return min(self.distance(row[NUM_BASE_POSITIONS:]) for row in rows)

    def alone(self, joints: np.ndarray) -> float:
        """Return the smallest distance without a target, m; infinite above ``CLEAR``."""
        away = RigidTransform([_AWAY, _AWAY, _AWAY])
        return min((d for d, _ in self._with_target(joints, away)), default=np.inf)

    def tumble(self, joints: np.ndarray) -> float:
        """Return the smallest distance of the base and the tumbling target in the last seconds
        before the grasp, m; infinite above ``CLEAR``.
        """
        held, found = self._pose(joints), [np.inf]
        for time in _BEFORE:
            turn = RotationMatrix(matrix_of(quaternion_of(-time * self._rate)))
            pose = RigidTransform(held.rotation() @ turn, held.translation())
            near = self._with_target(joints, pose)
            found += [d for d, pair in near if self._target in pair and not pair & self._moving]
        return min(found)

    def remarks(self, joints: np.ndarray) -> Iterator[str]:
        """Yield a remark for each hand whose shape is in the target that it holds."""
        near = [*self._with_target(joints, self._pose(joints))]
        for name, end in zip(self._names, self._ends, strict=True):
            depths = (-d for d, pair in near if self._target in pair and pair & end)
            if (depth := max(depths, default=0.0)) > _TOLD:
                yield (
                    f"the shape of '{name}' is {1e3 * depth:.0f} mm deep in the target at its "
                    "grasp, where contact does not count: give --tips a frame at the end of the "
                    "hand to avoid it"
                )

    def _holding(self, joints: np.ndarray) -> Iterator[tuple[float, set[str]]]:
        ends = set[str]().union(*self._ends)
        for distance, pair in self._near(self._held, Postures.whole(joints)):
            if self._target not in pair or not pair & ends:
                yield distance, pair

    def _pose(self, joints: np.ndarray) -> RigidTransform:
        """Return the pose of the target that the first hand holds."""
        held = self._held
        held.plant.SetPositions(held.plant_context, Postures.whole(joints))
        body = find_body(held.plant, self._target, key="payload.body")
        pose: RigidTransform = body.EvalPoseInWorld(held.plant_context)
        return pose

    def _with_target(
        self, joints: np.ndarray, pose: RigidTransform
    ) -> Iterator[tuple[float, set[str]]]:
        quaternion = pose.rotation().ToQuaternion().wxyz()
        q = np.concatenate([Postures.whole(joints), quaternion, pose.translation()])
        return self._near(self._apart, q)

    @staticmethod
    def _near(shapes: Clearance, q: np.ndarray) -> Iterator[tuple[float, set[str]]]:
        """Yield the distances below ``CLEAR``, m, and the names of the two bodies."""
        for distance, _, bodies in shapes.within(q, CLEAR):
            yield distance, {*map(_name, bodies)}


def _name(body: RigidBody) -> str:
    found: str = body.scoped_name().get_full()
    return found


def _hand(plant: MultibodyPlant, frame: str) -> set[str]:
    """Return the names of the bodies that are fixed to a frame, and of the fingers beyond it."""
    body = find_frame(plant, frame, key="--tips").body()
    fixed = {each.index() for each in plant.GetBodiesWeldedTo(body)}
    joints = map(plant.get_joint, plant.GetJointIndices())
    beyond = [each.name() for each in joints if each.parent_body().index() in fixed]
    return {_name(plant.get_body(index)) for index in fixed} | _moved(plant, beyond)


def _moved(plant: MultibodyPlant, joints: list[str]) -> set[str]:
    """Return the names of the bodies that joints move."""
    moving = [plant.GetJointByName(name).index() for name in joints]
    bodies = plant.GetBodiesKinematicallyAffectedBy(moving) if moving else []
    return {_name(plant.get_body(index)) for index in bodies}
