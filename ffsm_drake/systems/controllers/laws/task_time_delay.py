"""Time-delay control in task space: the estimators of time-delay control, on the frame's pose.

The frame obeys V' = N + Lambda^-1 F with the task's inertia Lambda and the force F that acts on the frame in its
directions, tau_a = J*^T F, of which F = J#^T tau_a is found again; everything unknown is in N, C* and A_0 too. The
estimators see a sample of m coordinates: the frame's error for e, its twist for v, F for tau, Lambda for H.
"""

import dataclasses
from collections.abc import Mapping
from typing import Self

import numpy as np

from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.estimators import Estimator, make_task_estimator
from ffsm_drake.systems.controllers.law import State, field_values, gain
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.controllers.task_space import AccelerationLaw, TaskPoint, TaskSpace
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics, time_delay_force
from ffsm_drake.systems.setup import BlockSetup

_PREFIX = "frame_"  # of the memory: what is of the frame, not of the coordinates


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskTimeDelay(AccelerationLaw):
    """tau_a = J*^T (base force + Lambda (u - base acceleration)) + H* (1 - J# J*) z; u is TDC's, z as computed torque's."""

    estimator: Estimator  # of m coordinates
    k_p_rotation: float = gain(100.0, "1/s^2", "gain K_P on the frame's attitude error", scalar=True)
    k_p_position: float = gain(100.0, "1/s^2", "gain K_P on the frame's position error", scalar=True)
    k_d_rotation: float = gain(100.0, "1/s", "gain K_D on its rate", scalar=True)
    k_d_position: float = gain(100.0, "1/s", "gain K_D on its rate", scalar=True)

    @property
    def dynamics(self) -> InjectedDynamics:
        """What is injected, of vectors (m): TDC; a subclass may inject others."""
        return Tdc(k_d=self.k_d, k_p=self.k_p)

    def initial_state(self) -> State:
        return {**super().initial_state(), **_named({**self.estimator.initial_state(), **self.dynamics.initial_state()})}

    def held(self) -> Mapping[str, float | None]:
        return {_PREFIX + name: value for name, value in self.dynamics.held().items()}

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        own = {name.removeprefix(_PREFIX): value for name, value in state.items() if name.startswith(_PREFIX)}
        sample = point.sample._replace(
            v=point.twist,
            v_d=point.desired_twist,
            a_d=point.desired_acceleration,
            e=point.e,
            e_dot=point.e_dot,
            applied_force=point.inverse.T.dot(point.sample.applied_force[self.task_space.driven]),
            is_new=None,
        )
        estimate, after = self.estimator.step(sample, point.inertia, own)
        u, dynamics = self.dynamics.step(estimate.e, estimate.e_dot, sample.a_d, own)
        on_frame = time_delay_force(
            delayed_force=estimate.base_force,
            nominal_mass_matrix=point.inertia,
            delayed_acceleration=estimate.base_acceleration,
            u=u,
        )
        force = point.jacobian.T.dot(on_frame) + point.mass_matrix.dot(self.free_acceleration(point))
        return force, _named({**after, **dynamics})

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ScenarioError also for an estimator that needs measurements by coordinate."""
        task_space = TaskSpace.from_setup(setup)
        q = configuration(task_space.model.plant, setup.scenario.initial_posture, key="initial_posture")
        jacobian = task_space.model.calc_jacobian(q, task_space.frame)[task_space.rows]
        estimator = make_task_estimator(setup.scenario, setup.coordinates, jacobian)
        return cls(**field_values(cls, setup, task_space=task_space, estimator=estimator))


def _named(memory: State) -> State:
    return {_PREFIX + name: value for name, value in memory.items()}
