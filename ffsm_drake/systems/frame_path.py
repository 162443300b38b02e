"""A scenario's path of a frame: a line for its origin, an eigenaxis turn for its attitude.

Both follow the blend of the planned motion. After a capture the frame moves at the start, and the
blend's stop brings it to rest, as it does with coordinates (``systems/reference.py``).
"""

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import rotation_error
from ffsm_drake.mission import Mission
from ffsm_drake.scenario import FrameGoal, Scenario
from ffsm_drake.spacecraft.free_floating import TASK_ROWS
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration, find_frame, hand_frame
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.polynomial_motion import BlendedPath
from ffsm_drake.systems.start import velocity_at_start

# length of a row: quaternion (w, x, y, z) of R_WF, p_WF, w_WF, v_WF, alpha_WF, a_WF
FRAME_SIZE = 19


def goal_frame(scenario: Scenario, plant: MultibodyPlant) -> Frame:
    """Return the frame of ``reference.frame``. Raises ModelError: there is no such frame."""
    goal = scenario.reference.frame or FrameGoal()
    if goal.frame is None:
        return hand_frame(plant, scenario.model)
    return find_frame(plant, goal.frame, key="reference.frame.frame")


def tracked_rows(scenario: Scenario) -> slice:
    """Return the rows of a twist [w; v] that a law tracks: the prescribed ones of
    ``reference.frame``, or all if there are none.
    """
    goal = scenario.reference.frame
    return TASK_ROWS["pose" if goal is None or goal.task == "none" else goal.task]


def make_frame_path(
    mission: Mission, model: PlantModel, *, duration: float | None = None
) -> BlendedPath:
    """Return the path of ``reference.frame`` from its pose in ``initial_posture``.

    Args:
      mission: the mission; without ``reference.frame`` the hand stays where it is.
      model: the plant with the nominal payload.
      duration: the motion's, s; default: ``reference.duration``.

    Raises:
      ModelError: there is no such frame, or no grasp of the target.
      ScenarioError: the duration is ``auto``, or an input shaper takes all of it.
    """
    scenario, reference = mission.scenario, mission.scenario.reference
    goal = reference.frame or FrameGoal()
    duration = reference.duration if duration is None else duration
    if duration is None:
        raise ScenarioError("reference.duration", "auto has no value yet; give a number of seconds")
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    frame = goal_frame(scenario, model.plant)
    model.plant.SetPositions(model.context, q)
    X_WF = frame.CalcPoseInWorld(model.context)
    twist = np.zeros(6)
    if scenario.starts_moving:
        twist = model.calc_jacobian(q, frame) @ velocity_at_start(mission, model)
    blend = Blend(reference, duration)
    quaternion, change = X_WF.rotation().ToQuaternion().wxyz(), np.zeros(6)
    if reference.goal == "stop":
        change = blend.stopping_time * twist
    if goal.rpy is not None:
        change[:3] = rotation_error(
            RotationMatrix(RollPitchYaw(goal.rpy)).ToQuaternion().wxyz(), quaternion
        )
    if goal.position is not None:
        change[3:] = goal.position - X_WF.translation()
    start = np.concatenate([np.zeros(3), X_WF.translation()])
    return BlendedPath(first=quaternion, start=start, change=change, velocity=twist, blend=blend)
