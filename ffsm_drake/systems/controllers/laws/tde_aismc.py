"""The proposed controller: TDE-based adaptive integral sliding-mode control, equations (6), (9) and
(10).
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.laws.aismc import Aismc


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
class TdeAismc(Aismc):
    """TDE-AISMC, the paper's controller: AISMC with a switching term, equations (6), (9), (10).

    u = a_d + K_D e' + K_P e + K_s s + G sgn s with s = e' + K_D e + K_P int e. K_s adapts at
    another rate than in AISMC. Gains are diagonals (nv).
    """

    label = "TDE-AISMC (proposed)"
    beta: np.ndarray = gain(
        {"base_position": 4e7, "base_rotation": 24e7, "joints": 12e7},
        "1/rad or 1/m",
        "accuracy scale in the adaptation of K_s, which is constant at |s| = K_s / beta",
        positive=True,
        feedback=False,
    )
    g_initial: np.ndarray = gain(
        2e-4, "rad/s^2 or m/s^2", "initial switching gain G", feedback=False
    )
    epsilon: float = gain(
        1e-4,
        "rad/s or m/s",
        "size of the sliding variable above which G grows, and below which it decays",
        scalar=True,
        positive=True,
        feedback=False,
    )
    phi: np.ndarray = gain(
        {"all": 1e-1, "base_position": 1e-2},
        "1/s^2",
        "rate of adaptation of the switching gain G",
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
        return {**super().initial_state(), "switching_gain": self.g_initial}

    def held(self) -> Mapping[str, float | None]:
        return {**super().held(), "switching_gain": 0.0}

    def _rest(self, k_s: np.ndarray) -> np.ndarray:
        """|s| at which dK_s/dt = alpha |s| sgn(|s| - K_s / beta) (equation (9)) is zero."""
        return k_s / self.beta

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        return {**super().starting_gains(omega, mass_matrices), "g_max": 2e-3}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. G continues as its bound."""
        after = super().resume(state, ratio)
        return {**after, "switching_gain": np.abs(ratio) @ state["switching_gain"]}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        u, after = super().step(e, e_dot, a_d, state)
        s, g = after["sliding_variable"], state["switching_gain"]
        u = u + g * np.sign(s)
        rate = switching_gain_rate(s, g, phi=self.phi, epsilon=self.epsilon)
        g = np.minimum(np.maximum(g + self.sample_time * rate, 0.0), self.g_max)
        return u, {**after, "switching_gain": g}
