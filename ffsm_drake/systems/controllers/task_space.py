"""Task space: what a frame does when the driven coordinates move, for laws that track its pose.

With J* the generalized Jacobian, H* and C* of the driven coordinates a (``docs/free_floating.md``), the frame's twist
and acceleration are

    V = J* v_a + (J v - J* v_a),        A = J* dv_a/dt + A_0,     H* dv_a/dt + C* = tau_a,

all of them of the nominal plant at the measured state. Where every coordinate is driven J* is J, H* is H.

Of the accelerations that give the frame the same A, the damped inverse takes that of least kinetic energy, whatever the
units of the driven coordinates are (the dynamically consistent inverse, Khatib 1987, doi:10.1109/JRA.1987.1087068),

    J# = H*^-1 J*^T Lambda,     Lambda = (J* H*^-1 J*^T + sum_i max(0, d^2 - s_i^2) b_i u_i u_i^T)^-1,

with J* = sum_i s_i u_i v_i^T and b_i = v_i^T H*^-1 v_i. Along u_i alone it takes 1/s_i of A where s_i > d, and s_i/d^2
below: 1/d at most, and none at a singularity. Rates are those of least size, so that no twist takes more than 1/d of it:
J+ is J# with 1 for H*.
"""

import abc
import dataclasses
import functools
from typing import ClassVar, Self

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, error_rate, position_error
from ffsm_drake.spacecraft.free_floating import TASK_ROWS, FreeFloating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, field_values, gain
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.setup import BlockSetup

_ROUNDING = 1e-9  # of the largest singular value: below, a direction that the arm does not have at all


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TaskSpace:
    """A frame, the rows of its twist that count, and what is driven."""

    model: PlantModel  # whole, with the nominal payload
    frame: Frame
    rows: slice  # of [w; v]: m of them
    driven: np.ndarray  # (na) indices of v

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """Of ``reference.frame``; without one, or with none of its rows prescribed, the whole pose of the end effector.

        Raises ModelError: there is no such frame.
        """
        goal, given = setup.scenario.reference.frame, setup.nominal
        task = "pose" if goal is None or goal.task == "none" else goal.task
        # Not that of the driven coordinates alone, which a law gets otherwise.
        model = PlantModel(plant=given.plant, context=given.context, coordinates=given.coordinates)
        frame = goal_frame(setup.scenario, model)
        return cls(model=model, frame=frame, rows=TASK_ROWS[task], driven=given.coordinates.driven)

    def at(self, sample: Sample, *, damping: float) -> "TaskPoint":
        """The task at one sample (not several runs), singular values below ``damping`` damped."""
        model, q = self.model, sample.q
        mass_matrix = model.calc_mass_matrix(q)
        spacecraft = FreeFloating(
            mass_matrix=mass_matrix, base_position=q[4:NUM_BASE_POSITIONS], driven=self.driven
        )
        jacobian = model.calc_jacobian(q, self.frame)
        desired = self.planned(sample) if sample.desired_frame is None else sample.desired_frame
        twist = jacobian.dot(sample.v)
        e = position_error(desired[:7], model.calc_frame_pose(q, self.frame))
        e_dot = error_rate(e, desired[7:13], twist)
        rows, driven = self.rows, self.driven
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
            v_a=sample.v[driven],
        )

    def planned(self, sample: Sample) -> np.ndarray:
        """[pose; twist; acceleration] (19) of the frame in the planned motion of the coordinates."""
        model, q, v = self.model, sample.q_d, sample.v_d
        jacobian = model.calc_jacobian(q, self.frame)
        acceleration = jacobian.dot(sample.a_d) + model.calc_bias_acceleration(q, v, self.frame)
        return np.concatenate([model.calc_frame_pose(q, self.frame), jacobian.dot(v), acceleration])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TaskPoint:
    """The task at one sample: m rows of the frame's twist, na driven coordinates; world axes."""

    task_space: TaskSpace
    sample: Sample
    spacecraft: FreeFloating
    whole_jacobian: np.ndarray  # J (m, nv)
    jacobian: np.ndarray  # J* (m, na)
    damping: float
    e: np.ndarray  # (m) of the pose: rotation vector from R_WF to its reference, rad; then of the position, m
    e_dot: np.ndarray  # (m) its rate
    twist: np.ndarray  # (m) measured
    desired_twist: np.ndarray  # (m)
    desired_acceleration: np.ndarray  # (m)
    v_a: np.ndarray  # (na) measured

    @functools.cached_property
    def mass_matrix(self) -> np.ndarray:
        """H* (na, na)."""
        return self.spacecraft.reduced_mass_matrix

    @functools.cached_property
    def mobility(self) -> np.ndarray:
        """H*^-1 (na, na)."""
        return np.linalg.inv(self.mass_matrix)

    @functools.cached_property
    def whole_bias(self) -> np.ndarray:
        """C (nv)."""
        return self.task_space.model.calc_bias(self.sample.q, self.sample.v)

    @functools.cached_property
    def bias(self) -> np.ndarray:
        """C* (na)."""
        return self.spacecraft.reduced_bias(self.whole_bias)

    @functools.cached_property
    def bias_acceleration(self) -> np.ndarray:
        """A_0 (m), exact: J' v - J_u H_uu^-1 C_u."""
        space, sample = self.task_space, self.sample
        own = space.model.calc_bias_acceleration(sample.q, sample.v, space.frame)[space.rows]
        return self.spacecraft.bias_acceleration(self.whole_jacobian, own, self.whole_bias)

    @functools.cached_property
    def _directions(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """J* = u s v^T: u (m, k), s (k), v^T (k, na)."""
        return np.linalg.svd(self.jacobian, full_matrices=False)

    @functools.cached_property
    def _inertia(self) -> np.ndarray:
        """Lambda in the directions u (k, k)."""
        _, sizes, right = self._directions
        mobility = right @ self.mobility @ right.T
        damped = np.maximum(self.damping**2 - sizes * sizes, 0.0) * np.diagonal(mobility)
        return np.linalg.inv(sizes[:, None] * mobility * sizes + np.diag(damped))

    @property
    def smallest_singular_value(self) -> float:
        """Of J*, rad counted as m, among directions in which the arm moves the frame at all."""
        sizes = self._directions[1]
        return float(sizes[sizes > _ROUNDING * sizes[0]][-1]) if sizes[0] > 0.0 else 0.0

    @functools.cached_property
    def inertia(self) -> np.ndarray:
        """Lambda (m, m), kg m^2 and kg; 1 in directions in which the arm cannot push."""
        left = self._directions[0]
        return left @ self._inertia @ left.T + np.eye(len(left)) - left @ left.T

    @functools.cached_property
    def inverse(self) -> np.ndarray:
        """J# (na, m)."""
        left, sizes, right = self._directions
        return self.mobility @ right.T @ (sizes[:, None] * self._inertia) @ left.T

    @functools.cached_property
    def rate_inverse(self) -> np.ndarray:
        """J+ (na, m)."""
        left, sizes, right = self._directions
        return right.T @ (sizes / np.maximum(sizes, self.damping) ** 2 * left).T


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskSpaceLaw(ControlLaw):
    """Base of the laws on a frame's pose: where the task leaves freedom, the driven coordinates follow their plan."""

    tracks_frame: ClassVar[bool] = True
    task_space: TaskSpace
    damping: float = gain(
        0.05,
        "rad/rad, m/rad",
        "singular value of J*, rad counted as m, below which it is damped",
        scalar=True,
        positive=True,
        feedback=False,
    )

    def initial_state(self) -> State:
        return {"smallest_singular_value": np.zeros(1)}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        if sample.v.ndim > 1:  # several runs, one after the other
            return _one_by_one(self, sample, state)
        point = self.task_space.at(sample, damping=self.damping)
        on_driven, memory = self.driven_force(point, state)
        force = np.zeros_like(sample.v)
        force[self.task_space.driven] = on_driven
        return force, {**memory, "smallest_singular_value": np.array([point.smallest_singular_value])}

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ModelError also: there is no such frame."""
        return cls(**field_values(cls, setup, task_space=TaskSpace.from_setup(setup)))

    @abc.abstractmethod
    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        """tau_a (na) at one sample, N m and N, and the law's own memory; see ``ControlLaw.step``."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AccelerationLaw(TaskSpaceLaw):
    """Base of the laws that command accelerations: their gains, for the frame and for the freedom that it leaves."""

    k_p_rotation: float
    k_p_position: float
    k_d_rotation: float
    k_d_position: float
    k_p_free: float = gain(4.0, "1/s^2", "gain on the coordinates' errors where the task leaves freedom", scalar=True)
    k_d_free: float = gain(4.0, "1/s", "gain on their rates there", scalar=True)

    @functools.cached_property
    def k_p(self) -> np.ndarray:
        """By row of the task (m)."""
        return by_row(self.task_space, self.k_p_rotation, self.k_p_position)

    @functools.cached_property
    def k_d(self) -> np.ndarray:
        """By row of the task (m)."""
        return by_row(self.task_space, self.k_d_rotation, self.k_d_position)

    def free_acceleration(self, point: TaskPoint) -> np.ndarray:
        """(1 - J# J*) z (na): what of an acceleration z that follows the plan leaves the frame alone."""
        sample, driven = point.sample, self.task_space.driven
        wanted = sample.a_d + self.k_d_free * sample.e_dot + self.k_p_free * sample.e
        free: np.ndarray = wanted[driven] - point.inverse.dot(point.jacobian.dot(wanted[driven]))
        return free


def by_row(task_space: TaskSpace, rotation: float, position: float) -> np.ndarray:
    """One number for the frame's rotation and one for its position, by row of the task (m)."""
    return np.repeat([rotation, position], 3)[task_space.rows]


def _one_by_one(law: TaskSpaceLaw, sample: Sample, state: State) -> tuple[np.ndarray, State]:
    forces, memories = [], []
    for i in range(len(sample.v)):
        one = Sample(*(value[i] if isinstance(value, np.ndarray) else value for value in sample))
        force, memory = law.step(one, {name: value[i] for name, value in state.items()})
        forces.append(force)
        memories.append(memory)
    return np.stack(forces), {name: np.stack([memory[name] for memory in memories]) for name in memories[0]}
