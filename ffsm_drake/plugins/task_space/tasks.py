"""Task space: the motion of a frame with the driven coordinates, for laws that track its pose.

With J* the generalized Jacobian, H* and C* of the driven coordinates a
(``docs/how_a_free_base_moves.md``), the frame's twist and acceleration are

    V = J* v_a + V_0,     A = J* dv_a/dt + A_0,     H* dv_a/dt + C* = tau_a,

all of them of the nominal plant at the measured state; with every coordinate driven J* is J, H* is
H. The joints serve the frame. A driven base follows its plan, and so do the joints in the frame's
null space: with a motion z of all driven coordinates along the plan, and the frame's desired
motion,

    v_a = z + [0; J+ (V - V_0 - J* z)],     dv_a/dt = z + [0; J+ (A - A_0 - J* z)],

J+ being the pseudoinverse of the joints' columns of J*, damped as in ``resolved_motion``: along
each singular direction 1/s, and s (2 d^2 - s^2) / d^4 where s < d. A twist takes rates of at
most 1.09/d times its size, and at a singularity the lost direction takes none. The inverse of least
kinetic energy (Khatib 1987, doi:10.1109/JRA.1987.1087068) has no such bound, and turns light wrists
needlessly.
"""

import abc
import dataclasses
import functools
from typing import ClassVar, Self

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.products import applied
from ffsm_drake.plugins.task_space.resolved_motion import damped_inverse
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import FreeFloating, whole_model
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
)
from ffsm_drake.systems.frame_path import goal_frame, tracked_rows
from ffsm_drake.systems.setup import BlockSetup

# fraction of the largest singular value below which a direction counts as missing in the arm
_ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpace:
    """A frame, the controlled rows of its twist, and the driven coordinates."""

    model: PlantModel  # whole, with the nominal payload
    frame: Frame
    rows: slice  # m rows of [w; v]
    driven: np.ndarray  # (na) indices of v, the joints last

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """Return the task of ``reference.frame``; default: the end effector's pose.

        The default applies without a frame, or without prescribed rows. Raises ModelError: there is
        no such frame.
        """
        scenario, given = setup.scenario, setup.nominal
        frame, rows = goal_frame(scenario, given.plant), tracked_rows(scenario)
        model = whole_model(given)  # laws get the reduced one
        return cls(model=model, frame=frame, rows=rows, driven=given.coordinates.driven)

    def at(self, sample: Sample, *, damping: float) -> "TaskPoint":
        """Return the task at one sample; singular values below ``damping`` are damped."""
        model, q, rows = self.model, sample.q, self.rows
        spacecraft = FreeFloating(
            mass_matrix=model.calc_mass_matrix(q),
            base_position=q[4:NUM_BASE_POSITIONS],
            driven=self.driven,
        )
        jacobian = model.calc_jacobian(q, self.frame)
        desired = sample.desired_frame
        if desired is None:  # the frame follows the planned motion of the coordinates
            desired = model.calc_frame_motion(sample.q_d, sample.v_d, sample.a_d, self.frame)
        twist = applied(jacobian, sample.v)
        actual = np.concatenate([model.calc_frame_pose(q, self.frame), twist])
        e, e_dot = model.calc_tracking_errors(desired[:13], actual, NUM_BASE_POSITIONS)
        return TaskPoint(
            task_space=self,
            sample=sample,
            spacecraft=spacecraft,
            whole_jacobian=jacobian[rows],
            jacobian=spacecraft.generalized_jacobian(jacobian)[rows],
            damping=damping,
            e=e[rows],
            e_dot=e_dot[rows],
            twist=twist[rows],
            desired_twist=desired[7:13][rows],
            desired_acceleration=desired[13:][rows],
            v_a=sample.v[self.driven],
        )

    def by_row(self, rotation: float, position: float) -> np.ndarray:
        """One number for the frame's rotation and one for its position by row of the task (m)."""
        return np.concatenate([rotation * np.ones(3), position * np.ones(3)])[self.rows]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TaskPoint:
    """The task at one sample: m rows of the frame's twist, na driven coordinates, nj joints; world
    axes.
    """

    task_space: TaskSpace
    sample: Sample
    spacecraft: FreeFloating
    whole_jacobian: np.ndarray  # J (m, nv)
    jacobian: np.ndarray  # J* (m, na)
    damping: float
    # (m) pose error: rotation vector from R_WF to its reference, rad; then position, m
    e: np.ndarray
    e_dot: np.ndarray  # (m) its rate
    twist: np.ndarray  # V (m), measured
    desired_twist: np.ndarray  # (m)
    desired_acceleration: np.ndarray  # (m)
    v_a: np.ndarray  # (na) measured

    @property
    def mass_matrix(self) -> np.ndarray:
        """H* (na, na)."""
        return self.spacecraft.reduced_mass_matrix

    @functools.cached_property
    def _whole_bias(self) -> np.ndarray:
        """C (nv)."""
        return self.task_space.model.calc_bias(self.sample.q, self.sample.v)

    @functools.cached_property
    def bias(self) -> np.ndarray:
        """C* (na)."""
        return self.spacecraft.reduced_bias(self._whole_bias)

    @property
    def drift(self) -> np.ndarray:
        """V_0 (m): J v - J* v_a."""
        return self.twist - applied(self.jacobian, self.v_a)

    @property
    def bias_acceleration(self) -> np.ndarray:
        """A_0 (m), exact: J' v - J_u H_uu^-1 C_u."""
        space, sample = self.task_space, self.sample
        own = space.model.calc_bias_acceleration(sample.q, sample.v, space.frame)[space.rows]
        return self.spacecraft.bias_acceleration(self.whole_jacobian, own, self._whole_bias)

    @functools.cached_property
    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """SVD u s v^T of the joints' columns of J*: u (m, k), s (k), v^T (k, nj)."""
        base = int(np.count_nonzero(self.task_space.driven < NUM_BASE_VELOCITIES))
        return np.linalg.svd(self.jacobian[:, base:], full_matrices=False)

    @property
    def smallest_singular_value(self) -> np.ndarray:
        """Smallest singular value (1) of the joints' columns of J*, rad counted as m.

        Directions in which the joints cannot move the frame do not count.
        """
        sizes = self._directions[1]
        counts = sizes >= _ROUNDING * sizes[:1]
        return np.where(counts, sizes, np.inf).min(keepdims=True)

    def served(self, z: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """z + [0; J+ (wanted - J* z)] (na): motion z corrected for the frame's motion (m)."""
        left, sizes, right = self._directions
        lacking = applied(left.T, wanted - applied(self.jacobian, z))
        result = z.copy()
        result[z.size - right.shape[1] :] += applied(
            right.T, damped_inverse(sizes, self.damping) * lacking
        )
        return result


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSpaceLaw(ControlLaw):
    """Base of the laws that track a frame's pose; ``driven_force`` is the law."""

    tracks_frame: ClassVar[bool] = True
    task_space: TaskSpace
    damping: float = gain(
        0.1,
        "rad/rad, m/rad",
        "singular value of the joints' J*, with 1 rad counted as 1 m, below which its inverse is "
        "damped",
        scalar=True,
        positive=True,
        feedback=False,
    )
    speed_limit: float = gain(
        0.1,
        "rad/s, m/s",
        "largest speed at which an error of the frame is corrected",
        scalar=True,
        positive=True,
        feedback=False,
    )

    def initial_state(self) -> State:
        return {"smallest_singular_value": np.zeros(1)}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        point = self.task_space.at(sample, damping=self.damping)
        on_driven, memory = self.driven_force(point, state)
        force = np.zeros_like(sample.v)
        force[self.task_space.driven] = on_driven
        return force, {**memory, "smallest_singular_value": point.smallest_singular_value}

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ModelError also: there is no such frame."""
        return cls(**field_values(cls, setup, task_space=TaskSpace.from_setup(setup)))

    @abc.abstractmethod
    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        """tau_a (na) at one sample, N m and N, and the law's memory; see
        ``ControlLaw.step``.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class AccelerationLaw(TaskSpaceLaw):
    """Base of the laws that command accelerations, with gains for the frame and for the plan."""

    k_p_rotation: float
    k_p_position: float
    k_d_rotation: float
    k_d_position: float
    acceleration_limit: float = gain(
        0.5,
        "rad/s^2, m/s^2",
        "largest acceleration with which an error of the frame is corrected",
        scalar=True,
        positive=True,
        feedback=False,
    )
    k_p_plan: float = gain(
        25.0, "1/s^2", "gain on the errors of a driven base and of free joints", scalar=True
    )
    k_d_plan: float = gain(
        10.0, "1/s", "gain on the rates of error of a driven base and of free joints", scalar=True
    )

    @functools.cached_property
    def k_p(self) -> np.ndarray:
        """K_p by row of the task (m)."""
        return self.task_space.by_row(self.k_p_rotation, self.k_p_position)

    @functools.cached_property
    def k_d(self) -> np.ndarray:
        """K_d by row of the task (m)."""
        return self.task_space.by_row(self.k_d_rotation, self.k_d_position)

    def feedback(self, wanted: np.ndarray) -> np.ndarray:
        """Feedback acceleration (m) for a frame's error, within its limit."""
        return limited(wanted, self.acceleration_limit)

    def limited(self, e: np.ndarray) -> np.ndarray:
        """Return the frame's error (m), shortened to keep the correction within the speed
        limit.

        At the limit K_p e is K_d times the speed. At a singularity no rate can remove an error,
        and joints oscillate faster the larger it is.
        """
        return limited(e, self.speed_limit * self.k_d / np.maximum(self.k_p, 1e-12))

    def planned(self, sample: Sample) -> np.ndarray:
        """Return the acceleration z (na) that follows the plan."""
        z = sample.a_d + self.k_d_plan * sample.e_dot + self.k_p_plan * sample.e
        return z[self.task_space.driven]


def limited(vector: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Return a frame's vector (m), rotation and position each shortened to a limit, one or by
    row.
    """
    parts = vector.reshape(-1, 3)
    limits = np.broadcast_to(limit, vector.shape).reshape(-1, 3)[:, :1]
    sizes = np.sqrt((parts * parts).sum(axis=-1, keepdims=True))
    return (parts * (limits / np.maximum(sizes, limits))).reshape(vector.shape)
