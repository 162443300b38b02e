"""The pose of a frame (``reference.frame``) at the end of a plan.

The base ends as without the frame. The joints are free as far as the frame leaves them freedom, so
the cost of the plan chooses the redundant ones. The position of an undriven base follows from the
centre of mass, which moves at a constant velocity, and its attitude from the motion of the joints
(``turned_along``).
"""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix

from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.planning.curve import Curve
from ffsm_drake.plugins.planning.turn_limit import turned_along
from ffsm_drake.plugins.task_space.following import frame_path
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    position_error,
)
from ffsm_drake.spacecraft.free_floating import center_of_mass
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.frame_path import goal_frame, tracked_rows
from ffsm_drake.systems.start import velocity_at_start

END = 1e-5  # rad or m; largest distance of the frame from its pose
_POSITION = slice(3, NUM_BASE_VELOCITIES)  # of the base in v
_JOINTS = slice(NUM_BASE_VELOCITIES, None)


class FrameEnd:
    """The distance of a frame from its pose at the end of a curve, with its derivatives."""

    def __init__(
        self,
        mission: Mission,
        start: np.ndarray,
        rate: np.ndarray,
        planned: np.ndarray,
        duration: float,
    ) -> None:
        """Args:
          mission: a mission with a frame that ends at a pose.
          start, rate: q (nq) and v (nv) at the start.
          planned: indices in v of what is planned.
          duration: the longest, s.

        Raises the errors of ``goal_frame`` and ``frame_path``.
        """
        scenario, model = mission.scenario, mission.craft.nominal()
        self.frame, self.rows = goal_frame(scenario, model.plant), tracked_rows(scenario)
        q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
        pose = model.calc_frame_pose(q, self.frame)
        twist = model.calc_frame_twist(q, velocity_at_start(mission, model), self.frame)
        path = frame_path(scenario.reference, pose, twist, duration)
        self._goal = path.rows(np.array([path.end]))[0, :NUM_BASE_POSITIONS]
        self._model, self._start, self._planned = model, start, planned
        self._turns = 0 not in planned  # whether the base's rotation follows the joints
        mass_matrix = model.calc_mass_matrix(start)
        self._center = start[4:NUM_BASE_POSITIONS] + center_of_mass(mass_matrix)
        self._drift = mass_matrix[_POSITION] @ rate / mass_matrix[3, 3]  # m/s, of that centre
        # R_WF and p_WF at which the solver aims, so that the exact end is at the goal
        self._aim = _matrix(self._goal), self._goal[4:]

    def off(self, q: np.ndarray) -> np.ndarray:
        """Rotation vector and position (6) from the pose of the frame at q (nq) to its goal."""
        return position_error(self._goal, self._model.calc_frame_pose(q, self.frame))

    def learn(self, curve: Curve, x: np.ndarray, q: np.ndarray) -> None:
        """Aim so that the frame is at its goal, where unknowns x lead to q (nq) exactly."""
        found, exact = (
            self._model.calc_frame_pose(each, self.frame) for each in (self._end(curve, x)[0], q)
        )
        back = _matrix(found) @ _matrix(exact).T
        self._aim = back @ _matrix(self._goal), self._goal[4:] + found[4:] - exact[4:]

    def distance(self, curve: Curve, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The distances (m), sines of angles and m, and their derivatives by the unknowns x."""
        q, slope = self._end(curve, x)
        pose, by = self._model.calc_frame_pose(q, self.frame), np.empty((6, slope.shape[1]))
        turning, moving = np.split(self._model.calc_jacobian(q, self.frame) @ slope, 2)
        off = _matrix(pose) @ self._aim[0].T
        sines = 0.5 * np.array(
            [off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]
        )
        by[:3], by[3:] = 0.5 * (np.trace(off) * np.eye(3) - off) @ turning, moving
        return np.concatenate([sines, pose[4:] - self._aim[1]])[self.rows], by[self.rows]

    def _end(self, curve: Curve, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """q (nq) at the end of a curve, and the small change (nv, unknowns) of it."""
        values, by = (each[-1] for each in curve.evaluate(x))
        q, base = self._start.copy(), self._planned[self._planned < NUM_BASE_VELOCITIES]
        slope, first = np.zeros((q.size - 1, curve.num_unknowns)), len(values) - curve.size
        z = slice(first, first + base.size)
        joints = curve.joints or slice(NUM_BASE_POSITIONS - q.size, None)
        slope[base], slope[_JOINTS], q[_JOINTS.start + 1 :] = by[z], by[joints], values[joints]
        if self._turns:
            rotations, turning = turned_along(curve, x)
            rotation, slope[:3] = rotations[-1], turning[-1]
        else:
            every = np.tile(values[z][:3, None], 3)
            rotations, left, _ = attitude_motion(every, np.eye(3), np.zeros((3, 3)))
            rotation, slope[:3] = rotations[..., 0], left @ slope[:3]
        q[:4] = RotationMatrix(rotation @ _matrix(self._start)).ToQuaternion().wxyz()
        if _POSITION.start in base:
            q[4:NUM_BASE_POSITIONS] = values[z][_POSITION]
        else:  # the centre of mass moves on at its velocity
            mass_matrix = self._model.calc_mass_matrix(q)
            time, to_base = x[curve.num_points], mass_matrix[_POSITION] / mass_matrix[3, 3]
            q[4:NUM_BASE_POSITIONS] = self._center + time * self._drift
            q[4:NUM_BASE_POSITIONS] -= center_of_mass(mass_matrix)
            slope[_POSITION] = -to_base @ slope
            slope[_POSITION, curve.num_points] += self._drift
        return q, slope


def _matrix(pose: np.ndarray) -> np.ndarray:
    """The rotation matrix (3, 3) of a pose, or of a configuration, that begins with it."""
    return RotationMatrix(Quaternion(pose[:4])).matrix()
