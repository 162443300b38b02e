"""TDC: time-delay control, equation (17)."""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tdc(InjectedDynamics):
    """Time-delay control (TDC) with linear feedback, equation (17).

    u = a_d + K_D e' + K_P e. Gains are diagonals (nv). The law has no state.
    """

    label = "TDC"
    k_d: np.ndarray = gain(100.0, "1/s", "gain K_D on the rate of the error")
    k_p: np.ndarray = gain({"all": 100.0, "base_position": 200.0}, "1/s^2", "gain K_P on the error")

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        return {"k_d": 2.0 * omega, "k_p": omega**2}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        return a_d + self.k_d * e_dot + self.k_p * e, {}
