"""Resolved motion rate: the joints that take a frame along its path, with the generalized Jacobian.

The joint rates u solve tasks in order of priority, each in what the ones before leave free, with least squares:

    frame   A u = V_d + feedback - V_0    A: columns of J* (rows of the task), V_0: the frame's twist with u = 0
    hold    F u = 0                       F: rows of -H_uu^-1 H_ua: what the held base coordinates do

and what then is left goes to a rate of the joints' own: zero, or towards the target posture. The frame's task is damped
where its Jacobian has singular values s below ``damping`` e: 1/s becomes s (2 e^2 - s^2) / e^4, which is damped least
squares with lambda^2 = (e^2 - s^2)^2 / (2 e^2 - s^2), once differentiable in s, and at most sqrt(32/27)/e = 1.09/e.
(Nakamura 1991, "Advanced Robotics", chapters 4 and 9; Siciliano and Slotine 1991, doi:10.1109/ICAR.1991.240390.)
"""

import dataclasses

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.scenario import FrameGoal
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES, position_errors, rotation_error
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import FramePath
from ffsm_drake.systems.free_motion import MomentumMotion
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.rotation_motion import quaternion_rate

_ROWS = {"pose": slice(0, 6), "attitude": slice(0, 3), "position": slice(3, 6), "none": slice(0, 0)}  # of a twist
_RANK = 1e-9  # ratio of singular values, between rounding and what an arm has
_STEP = 1e-4  # s; of the difference quotient along the motion
_INSTANTS = 401  # that a report looks at
_SLOWEST = 1e-3  # m/s; bound of the feedback for a frame that is to stay where it is
MISSED = 1e-6  # rad, m; from which on a path counts as missed


def damped_inverse(sizes: np.ndarray, damping: float) -> np.ndarray:
    """Instead of 1/s of singular values s: 1/s from ``damping`` on, below less, zero at zero; at most 1.09/damping."""
    share = np.minimum(sizes / damping, 1.0)
    return share * (2.0 - share**2) / np.maximum(sizes, damping)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Resolution:
    """How well a resolved motion follows its path, at times (n,)."""

    times: np.ndarray  # (n) s
    smallest: np.ndarray  # (n) singular value of the task's Jacobian that is not zero; infinite without a task
    attitude_miss: np.ndarray  # (n) rad; angle between the frame's attitude and the path's; zero where it has no part
    position_miss: np.ndarray  # (n) m; likewise
    joint_rate: np.ndarray  # (n) rad/s or m/s; norm of the joints' rates
    base_turn: np.ndarray  # (n) rad; of the base from its first attitude
    base_shift: np.ndarray  # (n) m; likewise of its position

    @property
    def missed(self) -> bool:
        """Whether the frame leaves the path."""
        return bool(np.fmax(self.attitude_miss, self.position_miss).max() > MISSED)


class ResolvedMotion(MomentumMotion):
    """A frame goes along its path; driven base coordinates, and as far as they are free the joints, as is wanted."""

    def __init__(
        self,
        wanted: PlannedMotion,
        *,
        path: FramePath,
        goal: FrameGoal,
        frame: Frame,
        model: PlantModel,
        sample_time: float,
    ) -> None:
        """Args: the motion without the frame; its path; what is asked of it; the frame; the nominal plant; s."""
        self._wanted, self._path, self._goal, self._frame = wanted, path, goal, frame
        coordinates = model.coordinates
        self._arm = np.flatnonzero(coordinates.driven >= NUM_BASE_VELOCITIES)  # of the driven coordinates
        self._base = coordinates.driven[: self._arm[0]]  # of v: what of the base is driven
        held = coordinates.indices(goal.hold, key="reference.frame.hold")
        # Of the undriven coordinates.
        self._held = np.flatnonzero(np.isin(np.delete(np.arange(len(coordinates.names)), coordinates.driven), held))
        self._task = _ROWS[goal.task]
        times = np.linspace(0.0, path.end, _INSTANTS)
        self._most = max(_SLOWEST, float(np.linalg.norm(path.rows(times)[:, 7:13], axis=1).max()))  # of the feedback
        self._fastest = float(path.blend.blend(times)[1].max())
        q, v, _ = wanted.evaluate(0.0)
        self._posture = goal.joints == "target_posture" or goal.task == "none"
        self._first_rate = v[NUM_BASE_VELOCITIES:]
        stack = free_floating(model, q, [coordinates.names[i] for i in coordinates.driven])
        self._first_reaction = stack.following[self._held][:, self._arm] @ self._first_rate
        super().__init__(model=model, position=q, velocity=v, sample_time=sample_time, end=path.end)

    def velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        return self._resolved(q, self._asked(np.array([time]))[0][0])[0]

    def driven_velocity(self, time: float, q: np.ndarray) -> np.ndarray:
        return self.velocity(time, q)[self._driven]

    def driven_motion(self, times: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        driven = self._driven
        velocity, acceleration = np.empty((2, times.size, driven.size))
        for i, (one, asked, change) in enumerate(zip(q, *self._asked(times), strict=True)):
            v, _ = self._resolved(one, asked)
            # The motion goes on, in what it depends on, at its rate: first order is enough of central differences.
            rate = np.concatenate([quaternion_rate(one[:4], v[:3]), v[3:]])
            after, before = (
                self._resolved(one + step * rate, asked + step * change)[0][driven] for step in (_STEP, -_STEP)
            )
            velocity[i], acceleration[i] = v[driven], (after - before) / (2.0 * _STEP)
        return q, velocity, acceleration

    def resolution(self, times: np.ndarray | None = None) -> Resolution:
        """How well the path is followed, at times (n,), s; without them, over the motion."""
        times = np.linspace(0.0, self.end, _INSTANTS) if times is None else times
        rows = self.rows(times)
        q, v, _ = np.split(rows, np.cumsum([len(n) for n in (self.coordinates.position_names, self.coordinates.names)]),
                           axis=1)  # fmt: skip
        path, smallest, miss = self._path.rows(times), np.empty(times.size), np.zeros((times.size, 6))
        for i, (one, asked) in enumerate(zip(q, self._asked(times)[0], strict=True)):
            smallest[i] = self._resolved(one, asked)[1]
            miss[i, self._task] = self._error(one, path[i])[self._task]
        moved = position_errors(q, np.tile(self._first, (times.size, 1)))
        return Resolution(
            times=times,
            smallest=smallest,
            attitude_miss=np.linalg.norm(miss[:, :3], axis=1),
            position_miss=np.linalg.norm(miss[:, 3:], axis=1),
            joint_rate=np.linalg.norm(v[:, NUM_BASE_VELOCITIES:], axis=1),
            base_turn=np.linalg.norm(moved[:, :3], axis=1),
            base_shift=np.linalg.norm(moved[:, 3:6], axis=1),
        )

    def remarks(self) -> list[str]:
        """What of the path is missed, and why; a line, or none."""
        found, damping = self.resolution(), self._goal.damping
        if not found.missed:
            return []
        miss = np.hypot(found.attitude_miss, found.position_miss)
        worst, nearest = int(np.argmax(miss)), int(np.argmin(found.smallest))
        sizes = [f"{found.position_miss[i]:.3g} m and {found.attitude_miss[i]:.3g} rad" for i in (worst, -1)]
        why = "more is asked of it than the joints" + (" and what is held" if self._goal.hold else "") + " leave free"
        if found.smallest[nearest] < damping:
            why = (
                f"it is damped near a dynamic singularity, with a singular value of {found.smallest[nearest]:.3g} at "
                f"t = {found.times[nearest]:.3g} s (reference.frame.damping {damping:g})"
            )
        return [
            f"reference.frame: the plan misses its path by up to {sizes[0]} at t = {found.times[worst]:.3g} s "
            f"and by {sizes[1]} at its end: {why}"
        ]

    def _asked(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the joints depend on beside the configuration, (n, .), and how fast it changes.

        Pose (quaternion, position) and twist of the frame, velocities of the base that are driven, positions and rates
        that the joints would have, the pull towards these positions, 1/s, and the share of the first reaction.
        """
        path, coordinates, arm = self._path.rows(times), self._model.coordinates, self._first_rate.size
        turn = quaternion_rate(path[:, :4].T, path[:, 7:10].T).T
        _, slow, slower = (column[:, None] for column in self._path.blend.stop(times))
        _, speed, acceleration = (column[:, None] for column in self._path.blend.blend(times))
        pull, rest = self._goal.feedback / self._fastest, np.zeros((times.size, arm))
        q = v = a = rest
        if self._posture or self._base.size:
            wanted = self._wanted.rows(times)
            q, v, a = np.split(wanted, np.cumsum([len(coordinates.position_names), len(coordinates.names)]), axis=1)
        if self._posture:
            joints, rate, change = (each[:, -arm:] for each in (q, v, a))
            free, changing = [joints, rate, pull * speed], [rate, change, pull * acceleration]
        else:
            free = [rest, slow * self._first_rate, rest[:, :1]]
            changing = [rest, slower * self._first_rate, rest[:, :1]]
        return (
            np.hstack([path[:, :13], v[:, self._base], *free, slow]),
            np.hstack([turn, path[:, 10:], a[:, self._base], *changing, slower]),
        )

    def _error(self, q: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(6) from the frame in a configuration, which the plant is set to, to a pose."""
        self._model.plant.SetPositions(self._model.context, q)
        X_WF = self._frame.CalcPoseInWorld(self._model.context)
        turn = rotation_error(pose[:4], X_WF.rotation().ToQuaternion().wxyz())
        return np.concatenate([turn, pose[4:7] - X_WF.translation()])

    def _resolved(self, q: np.ndarray, asked: np.ndarray) -> tuple[np.ndarray, float]:
        """v (nv) in a configuration, and the smallest singular value of the frame's task."""
        arm, count = self._arm, self._arm.size
        pose, twist, base, joints, rate, (pull, slow) = np.split(
            asked, np.cumsum([7, 6, self._base.size, count, count])
        )
        q = np.concatenate([q[:4] / np.linalg.norm(q[:4]), q[4:]])
        stack = self._stack(q)
        driven_velocity = np.concatenate([base, np.zeros(count)])
        jacobian = self._model.calc_jacobian(q, self._frame)[self._task]
        feedback = self._goal.feedback * self._error(q, pose)[self._task]
        feedback /= np.sqrt(1.0 + feedback @ feedback / self._most**2)
        v = stack.velocity(driven_velocity, self._momentum if self._momentum.any() else None)  # with the joints at rest
        following = stack.following[:, arm]
        tasks = [
            (following[self._held], slow * self._first_reaction, 0.0),
            (
                jacobian[:, stack.driven[arm]] + jacobian[:, stack.undriven] @ following,
                twist[self._task] + feedback - jacobian @ v,
                self._goal.damping,
            ),
        ]
        rates, free, smallest = np.zeros(count), np.eye(count), np.inf
        for matrix, target, damping in tasks if self._goal.priority == "hold" else tasks[::-1]:
            if not target.size:
                continue
            left, sizes, right = np.linalg.svd(matrix @ free, full_matrices=False)
            real = sizes > _RANK * np.linalg.norm(matrix)
            left, sizes, right = left[:, real], sizes[real], right[real]
            inverse = damped_inverse(sizes, damping) if damping else 1.0 / sizes
            if damping:
                smallest = float(sizes.min(initial=np.inf))
            rates = rates + right.T @ (inverse * (left.T @ (target - matrix @ rates)))
            free = free - (right.T * (inverse * sizes)) @ right
        rates = rates + free @ (rate + pull * (joints - q[NUM_BASE_POSITIONS:]))
        v[NUM_BASE_VELOCITIES:] = rates
        v[stack.undriven] += following @ rates
        return v, smallest
