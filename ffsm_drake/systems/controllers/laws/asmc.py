"""ASMC: adaptive sliding-mode control with time-delay estimation, equations (18) and (19)."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.systems.controllers.law import ReachingGain, State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics

# Least b|s| to divide by in (19): the gain is clipped at zero long before it matters.
_SMALLEST_SCALED_S = 1e-12


def switching_gain_rate(
    s: np.ndarray, g: np.ndarray, *, a: np.ndarray, b: np.ndarray, epsilon: float
) -> np.ndarray:
    """dG/dt (..., nv) of equation (19), with a = phi and b = 1/alpha of its print: fast growth,
    slow decay.
    """
    magnitude = np.abs(s)
    scaled = b * magnitude
    sigma = np.sign(np.maximum.reduce(magnitude, axis=-1, keepdims=True) - epsilon)
    decays = (g > 0.0) & (sigma < 0.0)
    return np.where(
        decays,
        -a / np.maximum(scaled, _SMALLEST_SCALED_S),
        np.where(g > 0.0, sigma, 1.0) * (a * scaled),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asmc(InjectedDynamics):
    """Adaptive sliding-mode control with time-delay estimation (ASMC), equations (18) and (19).

    u = a_d + K_D e' + K_s s + G sgn s with s = e' + K_D e. Gains are diagonals (nv).
    """

    label = "ASMC"
    sample_time: float
    k_d: np.ndarray = gain(100.0, "1/s", "gain K_D on the rate of the error")
    k_s: np.ndarray = gain(80.0, "1/s", "constant reaching gain K_s")
    g_initial: np.ndarray = gain(
        0.0,
        "rad/s^2 or m/s^2",
        "initial switching gain G; equation (19) treats 0 separately",
        feedback=False,
    )
    epsilon: float = gain(
        1e-4,
        "rad/s or m/s",
        "size of the sliding variable above which G grows, and below which it decays",
        scalar=True,
        positive=True,
        feedback=False,
    )
    a: np.ndarray = gain(
        {"all": 1e-6, "base_position": 1e-7},
        "rad/s^3 or m/s^3",
        "rate of adaptation of G, phi in equation (19)",
        feedback=False,
    )
    b: np.ndarray = gain(
        1e5,
        "s/rad or s/m",
        "scale of the sliding variable in the adaptation of G, 1/alpha in equation (19)",
        positive=True,
        feedback=False,
    )
    g_max: np.ndarray = gain(
        None,
        "rad/s^2 or m/s^2",
        "upper bound of the switching gain G; null: no bound",
        bound=True,
        feedback=False,
    )

    def initial_state(self) -> State:
        return {"sliding_variable": np.zeros_like(self.k_d), "switching_gain": self.g_initial}

    def held(self) -> Mapping[str, float | None]:
        return {"switching_gain": 0.0}

    @property
    def reaching_gain(self) -> ReachingGain:
        return ReachingGain(start=self.k_s, largest=self.k_s)

    @classmethod
    def gains_for(cls, omega: Any, k_s: Any) -> dict[str, Any]:
        return {"k_d": omega, "k_s": omega}

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        return {"k_d": omega, "k_s": 2.0 * omega}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. G continues as a bound on forces."""
        return {"switching_gain": np.abs(ratio) @ state["switching_gain"]}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        g = state["switching_gain"]
        s = e_dot + self.k_d * e
        u = a_d + self.k_d * e_dot + self.k_s * s + g * np.sign(s)
        rate = switching_gain_rate(s, g, a=self.a, b=self.b, epsilon=self.epsilon)
        g = np.minimum(np.maximum(g + self.sample_time * rate, 0.0), self.g_max)
        return u, {"sliding_variable": s, "switching_gain": g}
