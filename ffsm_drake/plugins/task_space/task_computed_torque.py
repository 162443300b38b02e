"""Computed torque in task space, with J* and H*: the pose error becomes a double integrator.

Khatib 1987, doi:10.1109/JRA.1987.1087068; free floating Papadopoulos and Dubowsky 1991,
doi:10.1109/70.105384.
"""

import dataclasses

import numpy as np

from ffsm_drake.common.products import applied
from ffsm_drake.plugins.task_space.tasks import AccelerationLaw, TaskPoint
from ffsm_drake.systems.controllers.law import State, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskComputedTorque(AccelerationLaw):
    """Computed torque for the pose of a frame, with the generalized Jacobian.

    tau_a = H* (z + [0; J+ (A_d + K_d e' + K_p e - A_0 - J* z)]) + C*, where z is the acceleration
    of the plan.
    """

    k_p_rotation: float = gain(
        25.0, "1/s^2", "gain K_p on the attitude error of the frame", scalar=True
    )
    k_p_position: float = gain(
        25.0, "1/s^2", "gain K_p on the position error of the frame", scalar=True
    )
    k_d_rotation: float = gain(
        10.0, "1/s", "gain K_d on the rate of the attitude error of the frame", scalar=True
    )
    k_d_position: float = gain(
        10.0, "1/s", "gain K_d on the rate of the position error of the frame", scalar=True
    )

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        feedback = self.feedback(self.k_d * point.e_dot + self.k_p * self.limited(point.e))
        wanted = point.desired_acceleration + feedback - point.bias_acceleration
        acceleration = point.served(self.planned(point.sample), wanted)
        return applied(point.mass_matrix, acceleration) + point.bias, {}
