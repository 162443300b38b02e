"""The approach to a measured target with a base that is not driven.

The driven coordinates are displaced from the planned approach, by c in the columns of
``displacement``, and the others follow by conservation of momentum. Newton's method chooses c and
c' at the grasp, such that the hands lie and move to the estimated target as planned. A step has
the generalized Jacobians J* of the hands, and is the smallest one of the least error.
"""

import dataclasses
import functools

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import composed, matrix_of, quaternion_of, turn_between
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.contact import grasping_hands
from ffsm_drake.plugins.capture.displacement import displaced, displacement, quintic
from ffsm_drake.plugins.capture.floating import From, floated, unfloated
from ffsm_drake.scenario import EMPTY
from ffsm_drake.scenario.capture import Capture
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion

# steps of Newton's method, at most; error and step that end them, m and rad, and per s
_STEPS, _CLOSE = 5, 1e-5
_HEAD = 3  # first numbers of a plan
_LARGEST = 0.3  # rad and m; of a step


class _Displaced(PlannedMotion):
    """A motion from one of its instants on, displaced by a polynomial."""

    def __init__(
        self,
        motion: PlannedMotion,
        ends: np.ndarray,
        *,
        begin: float,
        end: float,
        sample_time: float,
    ) -> None:
        """Args: the motion; [c; c'; c''] at begin and end (2, 3, nv), in s; the control period."""
        self._motion, self._since = unfloated(motion, sample_time), begin
        self._coefficients = quintic(ends[0], ends[1], end - begin)
        super().__init__(coordinates=motion.coordinates, sample_time=sample_time, end=end - begin)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        rows, firsts = self._motion.rows(self._since + times), (7, nq + 6, nq + nv + 6)
        for row, time in zip(rows, times.tolist(), strict=True):
            within = min(time, self.end)
            c = displacement(self._coefficients, within, time - within)
            if c[:, :6].any():
                row[:] = displaced(row, c, nq)
            else:
                for first, joints in zip(firsts, c[:, 6:], strict=True):
                    row[first : first + joints.size] += joints
        return rows


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FloatingApproach:
    """The displaced approach of a mission with undriven coordinates, from numbers in a memory.

    The numbers of a plan: begin and end, s, and whether it is the last; [c; c'; c''] at its begin
    and at its end; the state [q; v] at its begin.
    """

    mission: Mission
    motion: PlannedMotion  # which is displaced
    # a cache: the motions of plans, by their numbers
    motions: dict[bytes, PlannedMotion] = dataclasses.field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of numbers of a plan."""
        nq, nv = self._sizes
        return _HEAD + 6 * nv + nq + nv

    def row(self, plan: np.ndarray, time: float) -> np.ndarray:
        """Return [q_d; v_d; dv_d/dt] at a time (s) of the run."""
        begin, end = plan[:2]
        if end <= begin:
            return self.motion.row(time)
        key, period, since = plan.tobytes(), self.mission.scenario.sample_time, time - begin
        if key not in self.motions:
            self.motions.clear()
            self.motions[key] = self._motion(plan)
        sample = round(since / period) * period
        return self.motions[key].row(sample if abs(sample - since) < 1e-9 else since)

    def planned(
        self, plan: np.ndarray, time: float, target: np.ndarray, aim: np.ndarray, meets: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a plan from a time (s) on, and by how much it misses: angle (rad), distance (m).

        Args: the plan before; the time; motions (13) of the target at ``meets`` (s), as it is
        estimated and as it was planned.
        """
        nq, nv = self._sizes
        state = self.row(plan, time)[: nq + nv]
        ends = np.zeros((2, 3, nv))
        if plan[1] > plan[0]:
            ends = plan[_HEAD : _HEAD + 6 * nv].reshape(2, 3, nv).copy()
            ends[0] = displacement(quintic(ends[0], ends[1], plan[1] - plan[0]), time - plan[0])
        best, least, missed = plan, np.inf, np.zeros(2)
        for _ in range(_STEPS):
            found = np.concatenate([[time, meets, 0.0], ends.ravel(), state])
            motion = self._motion(found)
            error, jacobian = self._error(motion.row(motion.end), target, aim, meets)
            size = float(np.linalg.norm(error))
            if size < least:
                missed = np.linalg.norm(error[0].reshape(-1, 2, 3), axis=2).max(axis=0)
                missed[0] /= self._capture.tracking_length
                best, least = found, size
            steps = np.linalg.lstsq(jacobian, error.T, rcond=None)[0].T
            steps /= max(1.0, np.abs(steps).max() / _LARGEST)
            ends[1, :2, self._model.coordinates.driven] += steps.T
            if size < _CLOSE or np.abs(steps).max() < _CLOSE:
                break
        return best, missed

    def _error(
        self, row: np.ndarray, target: np.ndarray, aim: np.ndarray, meets: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """The weighted errors of the hands at the grasp, in a row: pose and twist (2, 6 each); and
        the weighted J* (6 each, na) there.
        """
        nq, _ = self._sizes
        q, wanted = row[:nq], self.motion.row(meets)
        turn = matrix_of(aim[:4]) @ turn_between(aim[:4], target[:4])
        R = matrix_of(quaternion_of(turn))
        stack = free_floating(self._model, q, [*self._model.coordinates.driven_groups])
        weights = np.repeat([self._capture.tracking_length, 1.0], 3)
        errors, jacobians = list[np.ndarray](), list[np.ndarray]()
        for hand in self._hands:
            pose, twist = self._of_hand(hand, row)
            goal, planned = self._of_hand(hand, wanted)
            arm = R @ (goal[4:] - aim[4:7])
            error = np.zeros((2, 6))
            rotation = composed(quaternion_of(turn), goal[:4])
            error[0, :3] = matrix_of(pose[:4]) @ turn_between(pose[:4], rotation)
            error[0, 3:] = target[4:7] + arm - pose[4:]
            error[1] = (planned.reshape(2, 3) @ R.T).ravel() - twist
            if self._capture.servicer.startswith("track"):
                dw, dv = (target[7:] - (aim[7:].reshape(2, 3) @ R.T).ravel()).reshape(2, 3)
                error[1] += np.concatenate([dw, dv + np.cross(dw, arm)])
            jacobian = stack.generalized_jacobian(self._model.calc_jacobian(q, hand))
            errors.append(error * weights)
            jacobians.append(weights[:, None] * jacobian)
        return np.concatenate(errors, axis=1), np.concatenate(jacobians)

    def _of_hand(self, hand: Frame, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose (7) and twist (6) of a hand in a row."""
        nq, nv = self._sizes
        q, v = row[:nq], row[nq : nq + nv]
        return self._model.calc_frame_pose(q, hand), self._model.calc_frame_twist(q, v, hand)

    def _motion(self, plan: np.ndarray) -> PlannedMotion:
        """The motion of a plan, as a function of the time since its begin."""
        nv, period = self._sizes[1], self.mission.scenario.sample_time
        numbers = plan[_HEAD:]
        ends = numbers[: 6 * nv].reshape(2, 3, nv)
        moved = _Displaced(self.motion, ends, begin=plan[0], end=plan[1], sample_time=period)
        return floated(From(moved, numbers[6 * nv :], sample_time=period), self.mission)

    @property
    def _sizes(self) -> tuple[int, int]:
        coordinates = self.motion.coordinates
        return coordinates.num_positions, coordinates.num_velocities

    @functools.cached_property
    def _model(self) -> PlantModel:
        return self.mission.craft.nominal(EMPTY)

    @functools.cached_property
    def _hands(self) -> list[Frame]:
        return grasping_hands(self.mission.scenario, self._model)

    @property
    def _capture(self) -> Capture:
        return self.mission.scenario.capture or Capture()
