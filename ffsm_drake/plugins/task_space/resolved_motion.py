"""Resolved motion rate: joint rates for a frame's motion along its path, with J*.

The joint rates u solve tasks by least squares in order of priority, each in the null space of its
predecessors:

    frame   A u = V_d + feedback - V_0    A: columns of J* (rows of the task),
                                          V_0: the frame's twist with u = 0
    hold    F u = 0                       F: rows of -H_uu^-1 H_ua for the held base coordinates

and the rest of the null space goes to the joints' own rate: zero, or towards the target posture.
The frame's task is damped where its Jacobian has singular values s below ``damping`` e: 1/s becomes
s (2 e^2 - s^2) / e^4, the damped least squares with lambda^2 = (e^2 - s^2)^2 / (2 e^2 - s^2),
once differentiable in s, and at most sqrt(32/27)/e = 1.09/e. (Nakamura 1991, "Advanced Robotics",
chapters 4 and 9; Siciliano and Slotine 1991, doi:10.1109/ICAR.1991.240390.)
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.products import times as _times
from ffsm_drake.common.so3 import quaternion_rate
from ffsm_drake.plugins.task_space.free_motion import MomentumMotion
from ffsm_drake.scenario import FrameGoal
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_VELOCITIES,
    position_errors,
)
from ffsm_drake.spacecraft.free_floating import TASK_ROWS, free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import BlendedPath

_RANK = 1e-9  # ratio of singular values: above rounding errors, below that of any arm
_STEP = 1e-4  # s; step of the difference quotient along the motion
_INSTANTS = 201  # samples for a report
_SLOWEST = 1e-3  # m/s; bound of the feedback for a frame at rest
MISSED = 1e-6  # rad, m; smallest deviation that counts as missing the path


def damped_inverse(sizes: np.ndarray, damping: float) -> np.ndarray:
    """Damped inverses of singular values s: 1/s from ``damping`` on, less below, zero at zero.

    At most 1.09/damping.
    """
    share = np.minimum(sizes / damping, 1.0)
    return share * (2.0 - share**2) / np.maximum(sizes, damping)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Resolution:
    """Accuracy of a resolved motion on its path, at times (n,)."""

    times: np.ndarray  # (n) s
    # (n) smallest non-zero singular value of the task's Jacobian; infinite without a task
    smallest: np.ndarray
    # (n) rad; angle between the frame's attitude and the path's; zero if not prescribed
    attitude_miss: np.ndarray
    position_miss: np.ndarray  # (n) m; distance of the frame's origin from the path's
    joint_rate: np.ndarray  # (n) rad/s or m/s; norm of the joints' rates
    base_turn: np.ndarray  # (n) rad; rotation of the base from its first attitude

    @property
    def missed(self) -> bool:
        """True if the frame leaves the path."""
        return bool(np.fmax(self.attitude_miss, self.position_miss).max() > MISSED)


class _Resolved(NamedTuple):
    """Velocities and task errors in configurations (n, nq)."""

    v: np.ndarray  # (n, nv)
    smallest: np.ndarray  # (n) singular value of the frame's task
    error: np.ndarray  # (n, rows of the task) from the frame to its path


class ResolvedMotion(MomentumMotion):
    """Motion of a frame along its path; the null space follows the given motion."""

    # the feedback corrects errors, and velocities follow from the configuration
    accuracy = 1e-9

    def __init__(
        self,
        wanted: PlannedMotion,
        *,
        path: BlendedPath,
        goal: FrameGoal,
        frame: Frame,
        model: PlantModel,
        sample_time: float,
        given: Sequence[str] = (),
        step: float | None = None,
        marks: Sequence[float] = (),
    ) -> None:
        """Args:
        wanted: the motion without the frame, of the model's coordinates at least.
        path: path of the frame.
        goal: goal of the frame.
        frame: the frame.
        model, sample_time, step, marks: see ``MomentumMotion``.
        given: names of joints that move as in ``wanted``, as driven base coordinates do.
        """
        self._wanted, self._goal, self._frame = wanted, goal, frame
        self._path = self.path = path
        coordinates, names = model.coordinates, wanted.coordinates.names
        # the model's coordinates in v of the motion; a closed chain has fewer
        self._places = np.array([names.index(name) for name in coordinates.names])
        # indices among the driven coordinates: of given ones, and joints of them; of the others
        of_joints = coordinates.driven >= NUM_BASE_VELOCITIES
        is_given = np.isin(coordinates.driven, coordinates.indices(given, key="given"))
        self._given = np.flatnonzero(is_given | ~of_joints)
        self._moved, self._arm = np.flatnonzero(is_given), np.flatnonzero(of_joints & ~is_given)
        self._joints = coordinates.driven[self._arm]  # indices in v
        held = coordinates.indices(goal.hold, key="reference.frame.hold")
        # Indices among the undriven coordinates.
        self._held = np.flatnonzero(
            np.isin(np.delete(np.arange(len(coordinates.names)), coordinates.driven), held)
        )
        self._task = TASK_ROWS[goal.task]
        times = np.linspace(0.0, path.end, _INSTANTS)
        # bounds of the feedback
        self._most = max(_SLOWEST, float(np.linalg.norm(path.rows(times)[:, 7:13], axis=1).max()))
        self._fastest = float(path.blend.blend(times)[1].max())
        q, v, _ = wanted.evaluate(0.0)
        v = v[self._places]
        self._posture = goal.joints == "target_posture" or goal.task == "none"
        self._first_rate = v[self._joints]
        stack = free_floating(model, q, [coordinates.names[i] for i in coordinates.driven])
        reaction = stack.following[self._held][:, of_joints]
        self._first_reaction = reaction @ v[NUM_BASE_VELOCITIES:]
        if self._moved.size:  # splines follow this motion, and it follows them
            self.accuracy = MomentumMotion.accuracy
        # True if the base moves while the joints rest.
        self._moves = bool(self._given.size or stack.momentum(v).any())
        super().__init__(
            model=model,
            position=q,
            velocity=v,
            sample_time=sample_time,
            end=path.end,
            step=step,
            marks=marks,
        )

    def velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        return self._resolved(q[None], self._inputs(np.array([time]))[0]).v[0]

    def driven_velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        return self.velocity(time, q)[self._driven]

    def driven_motion(
        self, times: np.ndarray, q: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        inputs, change = self._inputs(times)
        if self._moved.size:
            places = 1 + self._places[self._driven[self._moved]]
            q[:, places] = self._wanted.evaluate(times)[0][:, places]
        v = self._resolved(q, inputs).v
        # Inputs of the rates are extrapolated linearly: central differences need no more.
        every = self._model.calc_whole_velocity(q, v)
        rate = np.hstack([quaternion_rate(q[:, :4].T, v[:, :3].T).T, every[:, 3:]])
        after, before = (
            self._resolved(
                q + h * rate, [x + h * slope for x, slope in zip(inputs, change, strict=True)]
            ).v
            for h in (_STEP, -_STEP)
        )
        return q, v[:, self._driven], (after - before)[:, self._driven] / (2.0 * _STEP)

    def velocities(self, times: np.ndarray) -> np.ndarray:
        return self._resolved(self._integrated(times), self._inputs(times)[0]).v

    def resolution(self, times: np.ndarray | None = None) -> Resolution:
        """Accuracy on the path at times (n,), s; default: over the motion."""
        times = np.linspace(0.0, self.end, _INSTANTS) if times is None else times
        q = self._integrated(times)
        found, miss = self._resolved(q, self._inputs(times)[0]), np.zeros((times.size, 6))
        miss[:, self._task] = found.error
        moved = position_errors(q, np.tile(self._first, (times.size, 1)))
        return Resolution(
            times=times,
            smallest=found.smallest,
            attitude_miss=np.linalg.norm(miss[:, :3], axis=1),
            position_miss=np.linalg.norm(miss[:, 3:], axis=1),
            joint_rate=np.linalg.norm(found.v[:, NUM_BASE_VELOCITIES:], axis=1),
            base_turn=np.linalg.norm(moved[:, :3], axis=1),
        )

    def remarks(self) -> list[str]:
        """Deviation from the path and its cause: a line, or none."""
        found, damping = self.resolution(), self._goal.damping
        if not found.missed:
            return []
        miss = np.hypot(found.attitude_miss, found.position_miss)
        worst, nearest = int(np.argmax(miss)), int(np.argmin(found.smallest))
        sizes = [
            f"{found.position_miss[i]:.3g} m and {found.attitude_miss[i]:.3g} rad"
            for i in (worst, -1)
        ]
        why = (
            "the joints"
            + (" and the held coordinates" if self._goal.hold else "")
            + " leave too little freedom"
        )
        if found.smallest[nearest] < damping:
            why = (
                "it is damped near a dynamic singularity, with a singular value of "
                f"{found.smallest[nearest]:.3g} at "
                f"t = {found.times[nearest]:.3g} s (reference.frame.damping {damping:g})"
            )
        return [
            f"reference.frame: the plan misses its path by up to {sizes[0]} at t = "
            f"{found.times[worst]:.3g} s "
            f"and by {sizes[1]} at its end: {why}"
        ]

    def _inputs(self, times: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Inputs of the joint rates beside the configuration, (n, .) each, and their rates of
        change.

        Pose (quaternion, position) and twist of the frame, given velocities, positions and rates of
        the joints' own motion, the gain towards these positions, 1/s, and the fraction of the first
        reaction.
        """
        path, places, given = self._path.rows(times), self._places, self._driven[self._given]
        turn = quaternion_rate(path[:, :4].T, path[:, 7:10].T).T
        _, slow, slower = (column[:, None] for column in self._path.blend.stop(times))
        _, speed, acceleration = (column[:, None] for column in self._path.blend.blend(times))
        pull, rest = self._goal.feedback / self._fastest, np.zeros((times.size, self._arm.size))
        q = v = a = rest
        if self._posture or given.size:
            q, v, a = self._wanted.evaluate(times)
            q, v, a = q[:, 1 + places], v[:, places], a[:, places]
        if self._posture:
            joints, rate, change = (each[:, self._joints] for each in (q, v, a))
            free, changing = [joints, rate, pull * speed], [rate, change, pull * acceleration]
        else:
            free = [rest, slow * self._first_rate, rest[:, :1]]
            changing = [rest, slower * self._first_rate, rest[:, :1]]
        return (
            [path[:, :7], path[:, 7:13], v[:, given], *free, slow],
            [np.hstack([turn, path[:, 10:13]]), path[:, 13:], a[:, given], *changing, slower],
        )

    def _resolved(self, q: np.ndarray, inputs: Sequence[np.ndarray]) -> _Resolved:
        """Solution in configurations (n, nq) for ``_inputs``."""
        arm, count = self._arm, self._arm.size
        pose, twist, given, joints, rate, pull, slow = inputs
        q = q.copy()
        q[:, :4] /= np.sqrt((q[:, :4] * q[:, :4]).sum(axis=1, keepdims=True))
        stack = self._stack(q)
        jacobian = self._model.calc_jacobian(q, self._frame)[:, self._task]
        error = position_errors(pose, self._model.calc_frame_pose(q, self._frame))[:, self._task]
        feedback = self._goal.feedback * error
        feedback /= np.sqrt(1.0 + (feedback * feedback).sum(axis=1, keepdims=True) / self._most**2)
        v = np.zeros((len(q), self._places.size))  # with the other joints at rest
        if self._moves:
            driven = np.zeros((len(q), self._driven.size))
            driven[:, self._given] = given
            v = stack.velocity(driven, self._momentum)
        following, reaction = stack.following[..., arm], slow * self._first_reaction
        if self._moved.size:
            moved = stack.following[:, self._held][..., self._moved]
            reaction = reaction - _times(moved, v[:, self._driven[self._moved]])
        tasks = [
            (following[:, self._held], reaction, 0.0),
            (
                jacobian[..., stack.driven[arm]] + jacobian[..., stack.undriven] @ following,
                twist[:, self._task] + feedback - _times(jacobian, v),
                self._goal.damping,
            ),
        ]
        rates, free, smallest = (
            np.zeros((len(q), count)),
            np.tile(np.eye(count), (len(q), 1, 1)),
            np.full(len(q), np.inf),
        )
        for matrix, target, damping in tasks if self._goal.priority == "hold" else tasks[::-1]:
            if not target.shape[1]:
                continue
            left, sizes, right = np.linalg.svd(matrix @ free, full_matrices=False)
            real = sizes > _RANK * np.sqrt((matrix * matrix).sum(axis=(1, 2)))[:, None]
            if damping:
                inverse = damped_inverse(sizes, damping)
                smallest = np.where(real, sizes, np.inf).min(axis=1)
            else:
                inverse = np.divide(1.0, sizes, out=np.zeros_like(sizes), where=real)
            right = np.swapaxes(right, 1, 2)
            rates = rates + _times(
                right, inverse * _times(np.swapaxes(left, 1, 2), target - _times(matrix, rates))
            )
            free = free - (right * (inverse * sizes)[:, None]) @ np.swapaxes(right, 1, 2)
        rates = rates + _times(free, rate + pull * (joints - q[:, 1 + self._places[self._joints]]))
        v[:, self._joints] = rates
        v[:, stack.undriven] += _times(following, rates)
        return _Resolved(v, smallest, error)
