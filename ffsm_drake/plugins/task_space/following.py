"""Motions of a mission that follow a frame's path or the conservation of momentum."""

from collections.abc import Sequence

import numpy as np
from pydrake.math import RollPitchYaw

from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.task_space.free_motion import FreeMotion
from ffsm_drake.plugins.task_space.resolved_motion import ResolvedMotion
from ffsm_drake.scenario import Reference
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import BlendedPath


def free_motion(motion: PlannedMotion, mission: Mission, model: PlantModel) -> FreeMotion:
    """Return a motion whose undriven coordinates conserve momentum."""
    scenario = mission.scenario
    at_rest = scenario.reference.kind != "optimal" and not scenario.starts_moving
    return FreeMotion(motion, model=model, sample_time=scenario.sample_time, at_rest=at_rest)


def resolved_motion(
    motion: PlannedMotion,
    mission: Mission,
    model: PlantModel,
    given: Sequence[str] = (),
    step: float | None = None,
    marks: Sequence[float] = (),
) -> ResolvedMotion:
    """Return a motion whose joints move a frame along its path. Raises the errors of the path.

    The model may be one of a closed chain, with fewer coordinates than the motion. Joints that are
    ``given`` keep their motion. See ``MomentumMotion`` on step and marks.
    """
    scenario, tree = mission.scenario, mission.craft.nominal(model.grip)
    frame = goal_frame(scenario, tree.plant)
    q, v, _ = motion.evaluate(0.0)
    pose, twist = tree.calc_frame_pose(q, frame), tree.calc_frame_twist(q, v, frame)
    assert scenario.reference.frame is not None
    return ResolvedMotion(
        motion,
        path=frame_path(scenario.reference, pose, twist, motion.end),
        goal=scenario.reference.frame,
        frame=goal_frame(scenario, model.plant),
        model=model,
        sample_time=scenario.sample_time,
        given=given,
        step=step,
        marks=marks,
    )


def frame_path(
    reference: Reference, pose: np.ndarray, twist: np.ndarray, duration: float
) -> BlendedPath:
    """Return the path of ``reference.frame``: a line for its origin, an eigenaxis turn for its
    attitude.

    Both follow the blend of the planned motion. A frame that moves at the start is brought to rest
    by the stop of the blend, as coordinates are (``systems/reference.py``).

    Args:
      reference: the section ``reference``, with a frame.
      pose: [quaternion of R_WF; p_WF] (7) at the start, p_WF in m.
      twist: [w_WF; v_WF] (6) at the start, world axes, rad/s, m/s.
      duration: of the motion, s.

    Raises ScenarioError: an input shaper takes all of the duration.
    """
    goal, (quaternion, place) = reference.frame, np.split(pose, [4])
    assert goal is not None
    blend, change = Blend(reference, duration), np.zeros(6)
    if reference.goal == "stop":
        change = blend.stopping_time * twist
    if goal.rpy is not None:
        change[:3] = rotation_error(RollPitchYaw(goal.rpy).ToQuaternion().wxyz(), quaternion)
    if goal.position is not None:
        change[3:] = goal.position - place
    start = np.concatenate([np.zeros(3), place])
    return BlendedPath(first=quaternion, start=start, change=change, velocity=twist, blend=blend)
