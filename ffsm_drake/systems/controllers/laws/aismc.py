"""AISMC: adaptive integral sliding-mode control with time-delay estimation, equations (20) and
(21).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ffsm_drake.systems.controllers.law import ReachingGain, State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics

_SMALLEST_SCALE = 1e-9  # 1/s^3, least K_s K_P to divide by


@dataclasses.dataclass(frozen=True, kw_only=True)
class Aismc(InjectedDynamics):
    """AISMC, adaptive integral sliding-mode control with time delay, equations (20) and (21).

    u = a_d + K_D e' + K_P e + K_s s with s = e' + K_D e + K_P int e. Gains are diagonals (nv).

    The surface is the one that equation (7) needs. Equation (3) prints it with the factors of e and
    e' exchanged. The paper's K_s of 80 has no upper bound, and on an exact plant it adapts until
    the sampled loop is unstable. The defaults here therefore bound K_s.
    """

    label = "AISMC"
    chooses_k_s: ClassVar[bool] = True
    sample_time: float
    k_d: np.ndarray = gain(100.0, "1/s", "gain K_D on the rate of the error")
    k_p: np.ndarray = gain({"all": 100.0, "base_position": 200.0}, "1/s^2", "gain K_P on the error")
    k_s_initial: np.ndarray = gain(60.0, "1/s", "initial reaching gain K_s")
    alpha: np.ndarray = gain(
        {"base_position": 3e4, "base_rotation": 18e4, "joints": 9e4},
        "1/(rad s) or 1/(m s)",
        "rate of adaptation of the reaching gain K_s",
        feedback=False,
    )
    beta: np.ndarray = gain(
        {"base_position": 4e7, "base_rotation": 24e7, "joints": 12e7},
        "1/(rad s) or 1/(m s)",
        "accuracy scale in the adaptation of K_s, which is constant at |s| = K_s^2 / beta",
        positive=True,
        feedback=False,
    )
    k_s_max: np.ndarray = gain(
        70.0, "1/s", "upper bound of the reaching gain K_s; null: no bound", bound=True
    )

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_d)
        return {
            "integral_error": zeros,
            "sliding_variable": zeros,
            "reaching_gain": self.k_s_initial,
        }

    def held(self) -> Mapping[str, float | None]:
        return {"reaching_gain": None}

    @property
    def reaching_gain(self) -> ReachingGain:
        largest = np.where(self.alpha > 0, self.k_s_max, self.k_s_initial)
        return ReachingGain(
            start=self.k_s_initial, largest=largest, rate=self.alpha, rest=self._rest
        )

    def _rest(self, k_s: np.ndarray) -> np.ndarray:
        """|s| at which dK_s/dt = alpha |s| sgn(|s| - K_s^2 / beta) (equation (21)) is zero."""
        return k_s * k_s / self.beta

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        # Real noise drives |s| far past the thresholds, so K_s would adapt to its bound.
        return {"k_d": 2.0 * omega, "k_p": omega**2, "k_s_initial": k_s, "k_s_max": k_s}

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        return {**cls.gains_for(omega, omega), "k_s_max": 2.0 * omega}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. K_s K_P times the integral continues as a force."""
        scale = np.maximum(state["reaching_gain"] * self.k_p, _SMALLEST_SCALE)
        return {"integral_error": ratio @ (scale * state["integral_error"]) / scale}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        integral, k_s = state["integral_error"], state["reaching_gain"]
        s = e_dot + self.k_d * e + self.k_p * integral
        u = a_d + self.k_d * e_dot + self.k_p * e + k_s * s
        magnitude = np.abs(s)
        rate = self.alpha * magnitude * np.sign(magnitude - self._rest(k_s))
        return u, {
            "integral_error": integral + self.sample_time * e,
            "sliding_variable": s,
            "reaching_gain": np.minimum(
                np.maximum(k_s + self.sample_time * rate, 0.0), self.k_s_max
            ),
        }
