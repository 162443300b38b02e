"""Time-delay control in task space, with the estimators acting on the frame's pose.

The frame obeys A = N + Lambda^-1 F with Lambda = (J* H*^-1 J*^T)^-1, the task's mass matrix, and F
the force on the frame; N holds everything unknown, and C* and A_0 too. An estimate needs only the
frame's acceleration from the force, Lambda^-1 F = J* H*^-1 tau_a. So the estimators get this (m
rows of the task) as the force, with a unit mass matrix, and no matrix inverse is needed at a
singularity.

An estimator of coupled coordinates, or with late or slow sensors, uses the coordinates instead: q
and v are estimated with their accelerations' lumped uncertainty, and the frame follows from the
estimated state.
"""

import dataclasses
from collections.abc import Mapping
from typing import Self

import numpy as np

from ffsm_drake.common.products import applied, product
from ffsm_drake.common.so3 import turned_by
from ffsm_drake.plugins.task_space.tasks import AccelerationLaw, TaskPoint, TaskSpace
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.estimation import Estimate, Estimator, make_estimator
from ffsm_drake.systems.controllers.law import (
    ControlLaw,
    Sample,
    State,
    field_values,
    gain,
)
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics, after_grasp
from ffsm_drake.systems.setup import BlockSetup

_PREFIX = "frame_"  # prefix of the memory that belongs to the frame


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskTimeDelay(AccelerationLaw):
    """Time-delay control for the pose of a frame.

    tau_a = H* (z + [0; J+ (f - J* H*^-1 C* - J* z)]) + C* with f = base force + u - base
    acceleration. f is the acceleration of the frame due to tau_a, u the acceleration that TDC
    commands, and z the acceleration of the plan.

    With an estimator of the coordinates, tau_a = H* (z + [0; J+ (u - A_0 - J* z)] - base
    acceleration) + base force, at the estimated state.
    """

    model: PlantModel  # reduced to H* where the spacecraft is underactuated
    estimator: Estimator  # for the frame's m rows if ``by_axis``, else for the coordinates
    k_p_rotation: float = gain(
        100.0, "1/s^2", "gain K_P on the attitude error of the frame", scalar=True
    )
    k_p_position: float = gain(
        100.0, "1/s^2", "gain K_P on the position error of the frame", scalar=True
    )
    k_d_rotation: float = gain(
        100.0, "1/s", "gain K_D on the rate of the attitude error of the frame", scalar=True
    )
    k_d_position: float = gain(
        100.0, "1/s", "gain K_D on the rate of the position error of the frame", scalar=True
    )

    @property
    def dynamics(self) -> InjectedDynamics:
        """Injected dynamics of vectors (m): TDC's; a subclass may choose others."""
        return Tdc(k_d=self.k_d, k_p=self.k_p)

    @property
    def _of_frame(self) -> bool:
        return self.estimator.by_axis

    def initial_state(self) -> State:
        estimator, dynamics = self.estimator.initial_state(), self.dynamics.initial_state()
        if self._of_frame:
            return {**super().initial_state(), **_named({**estimator, **dynamics})}
        return {**super().initial_state(), **estimator, **_named(dynamics)}

    def held(self) -> Mapping[str, float | None]:
        return {_PREFIX + name: value for name, value in self.dynamics.held().items()}

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw: an estimate of the coordinates continues as ``TimeDelayControl``'s."""
        if self._of_frame or not isinstance(before, TaskTimeDelay):
            return state
        ratio, v_d = after_grasp(self.model, before.model, reference)
        return {**state, **self.estimator.resume(state, ratio, v_d)}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        if self._of_frame:
            return super().step(sample, state)
        mass_matrix = self.model.calc_mass_matrix(sample.q)
        estimate, estimator_memory = self.estimator.step(sample, mass_matrix, state)
        driven = self.task_space.driven
        point = self.task_space.at(
            _at_estimate(sample, estimate, self.task_space), damping=self.damping
        )
        u, dynamics_memory = self._limited(point.e, point.e_dot, point, _own(state))
        acceleration = point.served(self.planned(point.sample), u - point.bias_acceleration)
        force = estimate.base_force.copy()
        force[driven] += applied(
            point.mass_matrix, acceleration - estimate.base_acceleration[driven]
        )
        singular = point.smallest_singular_value
        memory = {**estimator_memory, **_named(dynamics_memory)}
        return force, {**memory, "smallest_singular_value": singular}

    def _limited(
        self, e: np.ndarray, e_dot: np.ndarray, point: TaskPoint, state: State
    ) -> tuple[np.ndarray, State]:
        """u (m) within the limits on the correction of an error, and the dynamics' memory."""
        wanted = point.desired_acceleration
        u, memory = self.dynamics.step(self.limited(e), e_dot, wanted, state)
        return wanted + self.feedback(u - wanted), memory

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        own = _own(state)
        force = point.sample.applied_force[self.task_space.driven]
        both = np.stack([force, point.bias], axis=1)
        given = product(point.jacobian, np.linalg.solve(point.mass_matrix, both))
        sample = point.sample._replace(
            v=point.twist,
            v_d=point.desired_twist,
            a_d=point.desired_acceleration,
            e=point.e,
            e_dot=point.e_dot,
            applied_force=given[:, 0],
            is_new=_of_frame(point.sample.is_new, len(point.e)),
        )
        estimate, estimator_memory = self.estimator.step(sample, np.eye(len(given)), own)
        u, dynamics_memory = self._limited(estimate.e, estimate.e_dot, point, own)
        wanted = estimate.base_force + u - estimate.base_acceleration
        acceleration = point.served(self.planned(point.sample), wanted - given[:, 1])
        force = applied(point.mass_matrix, acceleration) + point.bias
        return force, _named({**estimator_memory, **dynamics_memory})

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw."""
        task_space = TaskSpace.from_setup(setup)
        q = configuration(
            setup.craft.coordinates, setup.scenario.initial_posture, key="initial_posture"
        )
        jacobian = task_space.model.calc_jacobian(q, task_space.frame)[task_space.rows]
        estimator = make_estimator(setup.mission, setup.coordinates, jacobian, setup.grip)
        return cls(**field_values(cls, setup, task_space=task_space, estimator=estimator))


def _of_frame(is_new: np.ndarray | None, size: int) -> np.ndarray | None:
    """Return the mask (2 size) of new measurements of a frame, which are new if those of all
    coordinates are.
    """
    if is_new is None:
        return None
    return np.repeat([part.all() for part in np.split(is_new, 2)], size)


def _at_estimate(sample: Sample, estimate: Estimate, space: TaskSpace) -> Sample:
    """Return a sample (nv) with the estimated state of the driven coordinates in place of the
    measured one, to first order in the attitude's error.
    """
    q, v, e, e_dot = (of.copy() for of in (sample.q, sample.v, sample.e, sample.e_dot))
    driven = space.driven
    e[driven], e_dot[driven] = estimate.e[driven], estimate.e_dot[driven]
    moved = space.model.calc_whole_velocity(sample.q, sample.e - e)
    q[:4] = turned_by(moved[:3], q[:4])
    q[4:] += moved[3:]
    v += sample.e_dot - e_dot
    return sample._replace(q=q, v=v, e=e, e_dot=e_dot)


def _own(state: State) -> State:
    return {
        name.removeprefix(_PREFIX): value
        for name, value in state.items()
        if name.startswith(_PREFIX)
    }


def _named(memory: State) -> State:
    return {_PREFIX + name: value for name, value in memory.items()}
