"""Time-delay control in task space, with the estimators acting on the frame's pose.

The frame obeys A = N + Lambda^-1 F with Lambda = (J* H*^-1 J*^T)^-1, the task's mass matrix, and F
the force on the frame; N holds everything unknown, and C* and A_0 too. An estimate needs only the
frame's acceleration from the force, Lambda^-1 F = J* H*^-1 tau_a. So the estimators get this (m
rows of the task) as the force, with a unit mass matrix, and no matrix is inverted that becomes
singular at a singularity.
"""

import dataclasses
from collections.abc import Mapping
from typing import Self

import numpy as np

from ffsm_drake.common.products import applied, product
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.controllers.estimators import Estimator, make_estimator
from ffsm_drake.systems.controllers.law import State, field_values, gain, is_wide
from ffsm_drake.systems.controllers.laws.tdc import Tdc
from ffsm_drake.systems.controllers.task_space import AccelerationLaw, TaskPoint, TaskSpace
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics
from ffsm_drake.systems.setup import BlockSetup

_PREFIX = "frame_"  # prefix of the memory that belongs to the frame


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskTimeDelay(AccelerationLaw):
    """tau_a = H* (z + [0; J+ (f - J* H*^-1 C* - J* z)]) + C* with f = base force + u - base
    acceleration.

    f is the frame's acceleration from tau_a, u that of TDC, z the acceleration of the plan.
    """

    estimator: Estimator  # for m coordinates
    k_p_rotation: float = gain(
        100.0, "1/s^2", "gain K_P on the frame's attitude error", scalar=True
    )
    k_p_position: float = gain(
        100.0, "1/s^2", "gain K_P on the frame's position error", scalar=True
    )
    k_d_rotation: float = gain(100.0, "1/s", "gain K_D on its rate", scalar=True)
    k_d_position: float = gain(100.0, "1/s", "gain K_D on its rate", scalar=True)

    @property
    def dynamics(self) -> InjectedDynamics:
        """Injected dynamics of vectors (m): TDC's; a subclass may choose others."""
        return Tdc(k_d=self.k_d, k_p=self.k_p)

    @property
    def wide(self) -> bool:  # type: ignore[override]
        """As its estimator."""
        return is_wide(self.estimator)

    def initial_state(self) -> State:
        memory = _named({**self.estimator.initial_state(), **self.dynamics.initial_state()})
        return {**super().initial_state(), **memory}

    def held(self) -> Mapping[str, float | None]:
        return {_PREFIX + name: value for name, value in self.dynamics.held().items()}

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        own = {
            name.removeprefix(_PREFIX): value
            for name, value in state.items()
            if name.startswith(_PREFIX)
        }
        force = point.sample.applied_force[..., self.task_space.driven]
        both = np.stack([force, point.bias], axis=-1)
        given = product(point.jacobian, np.linalg.solve(point.mass_matrix, both))
        sample = point.sample._replace(
            v=point.twist,
            v_d=point.desired_twist,
            a_d=point.desired_acceleration,
            e=point.e,
            e_dot=point.e_dot,
            applied_force=given[..., 0],
            is_new=None,
        )
        estimate, estimator_memory = self.estimator.step(sample, np.eye(given.shape[-2]), own)
        u, dynamics_memory = self.dynamics.step(
            self.limited(estimate.e), estimate.e_dot, sample.a_d, own
        )
        u = sample.a_d + self.feedback(u - sample.a_d)
        wanted = estimate.base_force + u - estimate.base_acceleration
        acceleration = point.served(self.planned(point.sample), wanted - given[..., 1])
        force = applied(point.mass_matrix, acceleration) + point.bias
        return force, _named({**estimator_memory, **dynamics_memory})

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """See ControlLaw. Raises ScenarioError also for an estimator that needs measurements by
        coordinate.
        """
        task_space = TaskSpace.from_setup(setup)
        q = configuration(
            task_space.model.plant, setup.scenario.initial_posture, key="initial_posture"
        )
        jacobian = task_space.model.calc_jacobian(q, task_space.frame)[task_space.rows]
        estimator = make_estimator(setup.scenario, setup.coordinates, jacobian)
        return cls(**field_values(cls, setup, task_space=task_space, estimator=estimator))


def _named(memory: State) -> State:
    return {_PREFIX + name: value for name, value in memory.items()}
