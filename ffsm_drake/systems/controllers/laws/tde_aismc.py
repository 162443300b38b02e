"""The proposed controller: TDE-based adaptive integral sliding-mode control, equations (6), (9) and
(10).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np

from ffsm_drake.systems.controllers.law import ReachingGain, State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics

_SMALLEST_SCALE = 1e-9  # 1/s^3, least K_s K_P to divide by


def reaching_gain_rate(
    s: np.ndarray, k_s: np.ndarray, *, alpha: np.ndarray, beta: np.ndarray
) -> np.ndarray:
    """dK_s/dt (..., nv) of equation (9): zero at |s| = K_s / beta."""
    magnitude = np.abs(s)
    return alpha * magnitude * np.sign(magnitude - k_s / beta)


def switching_gain_rate(
    s: np.ndarray, g: np.ndarray, *, phi: np.ndarray, epsilon: float
) -> np.ndarray:
    """dG/dt (..., nv) of equation (10): positive while ||s||_inf > epsilon, else negative.

    At G = 0 it is phi epsilon.
    """
    magnitude = np.abs(s)
    sigma = np.sign(np.maximum.reduce(magnitude, axis=-1, keepdims=True) - epsilon)
    return np.where(g > 0.0, phi * magnitude * sigma, phi * epsilon)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TdeAismc(InjectedDynamics):
    """u = a_d + K_D e' + K_P e + K_s s + G sgn s with s = e' + K_D e + K_P int e (equation (6)).

    Gains are diagonals (nv). The surface is the one that (7) needs; (3) prints it with the factors
    of e and e' exchanged. On an exact plant the published K_s of 80, without a bound, adapts until
    the sampled loop is unstable, hence the defaults of K_s.
    """

    by_axis: ClassVar[bool] = True
    wide: ClassVar[bool] = True
    chooses_k_s: ClassVar[bool] = True
    sample_time: float
    k_d: np.ndarray = gain(100.0, "1/s", "gain K_D on the error's rate")
    k_p: np.ndarray = gain({"all": 100.0, "base_position": 200.0}, "1/s^2", "gain K_P on the error")
    k_s_initial: np.ndarray = gain(60.0, "1/s", "reaching gain K_s at the start")
    alpha: np.ndarray = gain(
        {"base_position": 3e4, "base_rotation": 18e4, "joints": 9e4},
        "1/(rad s) or 1/(m s)",
        "rate of K_s",
        feedback=False,
    )
    beta: np.ndarray = gain(
        {"base_position": 4e7, "base_rotation": 24e7, "joints": 12e7},
        "1/rad or 1/m",
        "accuracy scale of K_s, which rests at |s| = K_s / beta",
        positive=True,
        feedback=False,
    )
    k_s_max: np.ndarray = gain(70.0, "1/s", "upper bound of K_s; null: unbounded", bound=True)
    g_initial: np.ndarray = gain(
        2e-4, "rad/s^2 or m/s^2", "switching gain G at the start", feedback=False
    )
    epsilon: float = gain(
        1e-4,
        "rad/s or m/s",
        "bound on the sliding variable that switches the adaptation's sign",
        scalar=True,
        positive=True,
        feedback=False,
    )
    phi: np.ndarray = gain(
        {"all": 1e-1, "base_position": 1e-2}, "1/s^2", "rate of G", feedback=False
    )
    g_max: np.ndarray = gain(
        None, "rad/s^2 or m/s^2", "upper bound of G; null: unbounded", bound=True, feedback=False
    )

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_d)
        return {
            "integral_error": zeros,
            "sliding_variable": zeros,
            "reaching_gain": self.k_s_initial,
            "switching_gain": self.g_initial,
        }

    def held(self) -> Mapping[str, float | None]:
        return {"reaching_gain": None, "switching_gain": 0.0}

    @property
    def reaching_gain(self) -> ReachingGain:
        largest = np.where(self.alpha > 0, self.k_s_max, self.k_s_initial)
        return ReachingGain(
            start=self.k_s_initial, largest=largest, rate=self.alpha, rest=self._rest
        )

    def _rest(self, k_s: np.ndarray) -> np.ndarray:
        return k_s / self.beta

    def with_reaching_gain(self, k_s: np.ndarray) -> Self:
        return dataclasses.replace(self, k_s_initial=k_s)

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        # Real noise drives |s| far past the thresholds, so K_s would adapt to its bound.
        gains = {"k_d": 2.0 * omega, "k_p": omega**2}
        return {**gains, "k_s_initial": k_s, "k_s_max": k_s}

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        return {**cls.gains_for(omega, omega), "k_s_max": 2.0 * omega, "g_max": 2e-3}

    def switching_gain_after(self, s: np.ndarray, g: np.ndarray) -> np.ndarray:
        rate = switching_gain_rate(s, g, phi=self.phi, epsilon=self.epsilon)
        return np.minimum(np.maximum(g + self.sample_time * rate, 0.0), self.g_max)

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. K_s K_P times the integral continues as a force, G as its bound."""
        scale = np.maximum(state["reaching_gain"] * self.k_p, _SMALLEST_SCALE)
        return {
            "integral_error": ratio @ (scale * state["integral_error"]) / scale,
            "switching_gain": np.abs(ratio) @ state["switching_gain"],
        }

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        integral, k_s, g = state["integral_error"], state["reaching_gain"], state["switching_gain"]
        s = e_dot + self.k_d * e + self.k_p * integral
        u = a_d + self.k_d * e_dot + self.k_p * e + k_s * s + g * np.sign(s)
        k_s_rate = reaching_gain_rate(s, k_s, alpha=self.alpha, beta=self.beta)
        return u, {
            "integral_error": integral + self.sample_time * e,
            "sliding_variable": s,
            "reaching_gain": np.minimum(
                np.maximum(k_s + self.sample_time * k_s_rate, 0.0), self.k_s_max
            ),
            "switching_gain": self.switching_gain_after(s, g),
        }
