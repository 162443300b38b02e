"""Resolved motion rate control with the generalized Jacobian: the frame's twist as joint rates, and a loop on those.

Whitney 1969, doi:10.1109/TMMS.1969.299896; with J* Umetani and Yoshida 1989, doi:10.1109/70.34766.
"""

import dataclasses
import functools

import numpy as np

from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.task_space import TaskPoint, TaskSpaceLaw, by_row


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResolvedRate(TaskSpaceLaw):
    """v_r = J+ (V_d + K e - V_0) + (1 - J+ J*) (v_d + k_free e_q),  tau_a = H* k_v (v_r - v_a) + C*.

    V_0 = J v - J* v_a is the frame's drift while the driven coordinates stand still. The rates v_r lag: the frame is
    behind its path by about A_d / (k_v K).
    """

    k_p_rotation: float = gain(2.0, "1/s", "gain K on the frame's attitude error", scalar=True)
    k_p_position: float = gain(2.0, "1/s", "gain K on the frame's position error", scalar=True)
    k_v: float = gain(20.0, "1/s", "gain on the rates of the driven coordinates", scalar=True)
    k_p_free: float = gain(1.0, "1/s", "gain on the coordinates' errors where the task leaves freedom", scalar=True)

    @functools.cached_property
    def k_p(self) -> np.ndarray:
        """K by row of the task (m)."""
        return by_row(self.task_space, self.k_p_rotation, self.k_p_position)

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        sample, driven = point.sample, self.task_space.driven
        drift = point.twist - point.jacobian.dot(point.v_a)
        free = (sample.v_d + self.k_p_free * sample.e)[driven]
        wanted = point.desired_twist + self.k_p * point.e - drift
        rates = free + point.rate_inverse.dot(wanted - point.jacobian.dot(free))
        return point.mass_matrix.dot(self.k_v * (rates - point.v_a)) + point.bias, {}
