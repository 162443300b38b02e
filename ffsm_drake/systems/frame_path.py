"""A scenario's path of a frame: a line for its origin, an eigenaxis turn for its attitude.

Both follow the blend of the planned motion. After a capture the frame moves at the start, and the
blend's stop brings it to rest, as it does with coordinates (``systems/reference.py``).
"""

import dataclasses

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import eigenaxis_motion, rotation_error, rotation_vector_motion
from ffsm_drake.scenario import FrameGoal, Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration, find_frame, hand_frame
from ffsm_drake.spacecraft.start import velocity_at_start
from ffsm_drake.systems.blend import Blend

FRAME_SIZE = 19  # length of a row of FramePath


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FramePath:
    """The pose of a frame F over time, with velocities and accelerations; world axes, rad, m, s."""

    first: np.ndarray  # (7) quaternion (w, x, y, z) of R_WF, then p_WF, at the start
    change: np.ndarray  # (6) rotation vector from first to last attitude, then the displacement
    twist: np.ndarray  # (6) [w_WF; v_WF] at the start
    blend: Blend

    @property
    def end(self) -> float:
        """Time at which the frame comes to rest, s."""
        return self.blend.duration

    def rows(self, times: np.ndarray) -> np.ndarray:
        """Return rows (n, 19) at times (n,), s; at rest outside the motion.

        [quaternion wxyz of R_WF (4), p_WF (3), w_WF (3), v_WF (3), alpha_WF (3), a_WF (3)].
        """
        s, ds, dds = (column[:, None] for column in self.blend.blend(times))
        value, rate, acceleration = s * self.change, ds * self.change, dds * self.change
        if self.twist.any():
            g, dg, ddg = (column[:, None] for column in self.blend.stop(times))
            value, rate, acceleration = (
                value + g * self.twist,
                rate + dg * self.twist,
                acceleration + ddg * self.twist,
            )
            turn = rotation_vector_motion(
                self.first[:4], value[:, :3], rate[:, :3], acceleration[:, :3]
            )
        else:
            turn = eigenaxis_motion(self.first[:4], self.change[:3], (s, ds, dds))
        quaternion, omega, alpha = turn
        return np.hstack(
            [
                quaternion,
                self.first[4:] + value[:, 3:],
                omega,
                rate[:, 3:],
                alpha,
                acceleration[:, 3:],
            ]
        )


def goal_frame(scenario: Scenario, plant: MultibodyPlant) -> Frame:
    """Return the frame of ``reference.frame``. Raises ModelError: there is no such frame."""
    goal = scenario.reference.frame or FrameGoal()
    if goal.frame is None:
        return hand_frame(plant, scenario.model)
    return find_frame(plant, goal.frame, key="reference.frame.frame")


def make_frame_path(
    scenario: Scenario, model: PlantModel, *, duration: float | None = None
) -> FramePath:
    """Return the path of ``reference.frame`` from its pose in ``initial_posture``.

    Args:
      scenario: the scenario; without ``reference.frame`` the hand stays where it is.
      model: the plant with the nominal payload.
      duration: the motion's, s; default: ``reference.duration``.

    Raises:
      ModelError: there is no such frame, or no grasp of the target.
      ScenarioError: the duration is ``auto``, or an input shaper takes all of it.
    """
    reference = scenario.reference
    goal = reference.frame or FrameGoal()
    duration = reference.duration if duration is None else duration
    if duration is None:
        raise ScenarioError("reference.duration", "auto has no value yet; give a number of seconds")
    q = configuration(model.plant, scenario.initial_posture, key="initial_posture")
    frame = goal_frame(scenario, model.plant)
    model.plant.SetPositions(model.context, q)
    X_WF = frame.CalcPoseInWorld(model.context)
    twist = np.zeros(6)
    if scenario.starts_moving:
        twist = model.calc_jacobian(q, frame) @ velocity_at_start(scenario, model)
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
    return FramePath(
        first=np.concatenate([quaternion, X_WF.translation()]),
        change=change,
        twist=twist,
        blend=blend,
    )
