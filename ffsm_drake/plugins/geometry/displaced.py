"""The true geometry of the arm: frames of its joints displaced in a context of a plant.

Bodies keep their mass, their centre of mass and their inertia in their own frames. The frame of
joint i, at p in the frame of the joint before it, moves by s_i p with the relative elongation s_i.
A joint's offset turns (or shifts) its frame about (or along) its axis: the plant's coordinate is
what the sensor measures.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, Joint, RigidBody
from pydrake.systems.framework import Context

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.so3 import matrix_of, quaternion_of
from ffsm_drake.plugins.geometry.settings import Geometry, Thermal
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, joints_of
from ffsm_drake.spacecraft.plant import base_body, coordinates_of, hand_frame

_KEY = "effects.geometry"
_STREAM = 0x6E0  # draws of the geometry among those with a seed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Errors:
    """Errors of the geometry in a run."""

    stretch: np.ndarray  # (n) of the link of each joint
    hand_stretch: float
    offset: np.ndarray  # (n) of each joint, rad or m
    mount_position: np.ndarray  # (3) m, base axes
    mount_rotation: np.ndarray  # (3) rad, base axes


def elongation(thermal: Thermal | None) -> float:
    """Return the relative elongation of links by their temperature."""
    if thermal is None:
        return 0.0
    share = math.sin(2.0 * math.pi * thermal.time / thermal.period)
    return thermal.expansion * (thermal.mean + thermal.amplitude * share)


def errors_of(settings: Geometry, coordinates: Coordinates, seed: int) -> Errors:
    """Return the errors of a run, with those that are drawn.

    Args: the settings; the joints; the seed of the scenario. Raises ScenarioError: an unknown
    joint.
    """
    count = len(coordinates.joints)
    seed = seed if settings.seed is None else settings.seed
    drawn = np.random.default_rng([seed, _STREAM]).standard_normal(2 * count + 7)
    offsets, stretches, mount = np.split(drawn, [count, 2 * count + 1])
    given = coordinates.joint_vector(settings.stretch, key=f"{_KEY}.stretch", default=0.0)
    offset = coordinates.joint_vector(
        settings.joint_offset, key=f"{_KEY}.joint_offset", default=0.0
    )
    warm = elongation(settings.thermal)
    return Errors(
        stretch=given + warm + settings.stretch_deviation * stretches[:-1],
        hand_stretch=settings.hand_stretch + warm + settings.stretch_deviation * stretches[-1],
        offset=offset + settings.offset_deviation * offsets,
        mount_position=settings.mount_position + settings.mount_position_deviation * mount[:3],
        mount_rotation=settings.mount_rotation + settings.mount_rotation_deviation * mount[3:],
    )


def displace(plant: MultibodyPlant, context: Context, scenario: Scenario) -> None:
    """Displace the frames of the arm in one context of a plant; call it once for a context.

    Raises ScenarioError: an unknown joint. ModelError: a joint has no frame of its own.
    """
    settings: Geometry = scenario.effects.geometry
    coordinates = coordinates_of(plant)
    errors = errors_of(settings, coordinates, scenario.random_seed)
    chain = list(_up(plant, hand_frame(plant, scenario.model).body()))
    # poses before any of them changes: displaced ones do not add up
    nominal = plant.CreateDefaultContext()
    poses = dict[str, tuple[FixedOffsetFrame, RigidTransform]]()
    for joint in joints_of(plant):
        if joint.name() not in coordinates.joints:
            continue
        at = coordinates.joints.index(joint.name())
        frame = _placed(plant, joint.frame_on_parent(), joint.name())
        before = _frame_before(plant, joint.parent_body())
        X_PF = _stretched(
            plant, nominal, frame, joint.frame_on_parent(), before, errors.stretch[at]
        )
        if chain and joint.index() == chain[-1].index():
            X_PF = _mounted(plant, nominal, frame, X_PF, errors)
        X_PF = X_PF @ _offset(joint, float(errors.offset[at]))
        poses[joint.name()] = frame, X_PF
    if errors.hand_stretch and chain:
        hand = hand_frame(plant, scenario.model)
        frame = _placed(plant, hand, scenario.model.end_effector)
        last = chain[0].frame_on_child()
        poses[_KEY] = frame, _stretched(plant, nominal, frame, hand, last, errors.hand_stretch)
    for frame, X_PF in poses.values():
        frame.SetPoseInParentFrame(context, X_PF)


def _up(plant: MultibodyPlant, body: RigidBody) -> Iterator[Joint]:
    """The moving joints from a body up to the base, the nearest first."""
    above = {joint.child_body().index(): joint for joint in _all_joints(plant)}
    base = base_body(plant).index()
    while body.index() != base and body.index() in above:
        joint = above[body.index()]
        if joint.num_velocities() == 1:
            yield joint
        body = joint.parent_body()


def _all_joints(plant: MultibodyPlant) -> list[Joint]:
    return [plant.get_joint(index) for index in plant.GetJointIndices()]


def _placed(plant: MultibodyPlant, frame: Frame, name: str) -> FixedOffsetFrame:
    """The frame whose pose places a frame: itself, or the one that its body is welded to."""
    while not isinstance(frame, FixedOffsetFrame):
        welds = (each for each in _all_joints(plant) if each.num_velocities() == 0)
        body = frame.body().index()
        above = next((each for each in welds if each.child_body().index() == body), None)
        if above is None:
            raise ModelError(f"{_KEY}: '{name}' has no pose relative to its link to be changed")
        frame = above.frame_on_parent()
    return frame


def _frame_before(plant: MultibodyPlant, body: RigidBody) -> Frame:
    """The frame from which the link ends at a joint on a body."""
    for joint in _up(plant, body):
        return joint.frame_on_child()
    return base_body(plant).body_frame()


def _stretched(
    plant: MultibodyPlant,
    context: Context,
    placed: FixedOffsetFrame,
    end: Frame,
    begin: Frame,
    stretch: float,
) -> RigidTransform:
    """The pose of a frame in its parent such that the link from ``begin`` to ``end`` is longer."""
    X_PF = placed.GetPoseInParentFrame(context)
    link = plant.CalcRelativeTransform(context, begin, end).translation()
    along = _axes_in_parent(plant, context, placed, begin) @ link
    return RigidTransform(X_PF.rotation(), X_PF.translation() + stretch * along)


def _axes_in_parent(
    plant: MultibodyPlant, context: Context, placed: FixedOffsetFrame, other: Frame
) -> RotationMatrix:
    """The axes of another frame in the frame that a displaced one is given in."""
    R_FO = plant.CalcRelativeTransform(context, placed, other).rotation()
    return placed.GetPoseInParentFrame(context).rotation() @ R_FO


def _mounted(
    plant: MultibodyPlant,
    context: Context,
    placed: FixedOffsetFrame,
    X_PF: RigidTransform,
    errors: Errors,
) -> RigidTransform:
    """The pose of the arm's first joint with the errors of its mounting, in base axes."""
    R_PB = _axes_in_parent(plant, context, placed, base_body(plant).body_frame())
    turned = _rotation(R_PB @ errors.mount_rotation) @ X_PF.rotation()
    return RigidTransform(turned, X_PF.translation() + R_PB @ errors.mount_position)


def _offset(joint: Joint, offset: float) -> RigidTransform:
    """The motion of a joint by an offset, rad or m."""
    if joint.type_name() == "prismatic":
        return RigidTransform(offset * joint.translation_axis())
    return RigidTransform(_rotation(offset * joint.revolute_axis()), np.zeros(3))


def _rotation(vector: np.ndarray) -> RotationMatrix:
    """The rotation of a rotation vector (3), rad."""
    return RotationMatrix(matrix_of(quaternion_of(vector)))
