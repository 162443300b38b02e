"""Resolved motion rate control with the generalized Jacobian, and a loop on the joint rates.

Whitney 1969, doi:10.1109/TMMS.1969.299896; with J* Umetani and Yoshida 1989, doi:10.1109/70.34766.
"""

import dataclasses
import functools

import numpy as np

from ffsm_drake.common.products import applied
from ffsm_drake.plugins.task_space.tasks import TaskPoint, TaskSpaceLaw, limited
from ffsm_drake.systems.controllers.law import State, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResolvedRate(TaskSpaceLaw):
    """Resolved-rate control of a frame with the generalized Jacobian.

    v_r = z + [0; J+ (V_d + K e - V_0 - J* z)] with z = v_d + k_plan e_q, and
    tau_a = H* k_v (v_r - v_a) + C*.

    The rates v_r are tracked with a lag, so the frame is behind its path by about A_d / (k_v K).
    """

    k_p_rotation: float = gain(2.0, "1/s", "gain K on the attitude error of the frame", scalar=True)
    k_p_position: float = gain(2.0, "1/s", "gain K on the position error of the frame", scalar=True)
    k_v: float = gain(20.0, "1/s", "gain on the rates of the driven coordinates", scalar=True)
    k_p_plan: float = gain(
        2.0, "1/s", "gain on the errors of a driven base and of free joints", scalar=True
    )

    @functools.cached_property
    def k_p(self) -> np.ndarray:
        """K by row of the task (m)."""
        return self.task_space.by_row(self.k_p_rotation, self.k_p_position)

    def driven_force(self, point: TaskPoint, state: State) -> tuple[np.ndarray, State]:
        planned = (point.sample.v_d + self.k_p_plan * point.sample.e)[self.task_space.driven]
        feedback = limited(self.k_p * point.e, self.speed_limit)
        rates = point.served(planned, point.desired_twist + feedback - point.drift)
        return applied(point.mass_matrix, self.k_v * (rates - point.v_a)) + point.bias, {}
