"""Adaptive nonsingular terminal sliding mode with time-delay estimation.

The surface is that of Feng, Yu, Man, "Non-singular terminal sliding mode control of rigid
manipulators", Automatica 38 (2002) 2159, doi:10.1016/S0005-1098(02)00147-4, the use with time-delay
estimation that of Jin, Lee, Chang, Choi, IEEE Transactions on Industrial Electronics 56 (2009)
3593, doi:10.1109/TIE.2009.2024097:

    s = e + |e'|^p sgn e' / B,     1 < p < 2,
    u = a_d + (B/p) |e'|^(2-p) sgn e' + K_s s + G sgn s,

so that s' = -(p/B) |e'|^(p-1) (K_s s + G sgn s + Ntilde). On s = 0 the error obeys
e' = -(B |e|)^(1/p) sgn e and is zero after the time |e(0)|^(1-1/p) / (B^(1/p) (1 - 1/p)). The gain
G adapts to the unknown bound of the estimation error: G' = alpha |s| while |s| > epsilon, else
G' = -G / T_G.
"""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ffsm_drake.plugins.baselines.powers import signed_power
from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics
from ffsm_drake.systems.parts.signals import UNIT


@dataclasses.dataclass(frozen=True, kw_only=True)
class TerminalSlidingMode(InjectedDynamics):
    """Adaptive nonsingular terminal sliding-mode control with time-delay estimation.

    u = a_d + (B/p) |e'|^(2-p) sgn e' + K_s s + G sgn s with s = e + |e'|^p sgn e' / B. Gains are
    diagonals (nv).

    Powers and sign are linear within boundary layers of e' and s. A linearisation about the plan,
    for example by ``ffsm stability``, uses the slopes within the layers, with G held at its value:
    K_P = K_s + G / width_s, K_D = (B/p) width_rate^(1-p) + K_P width_rate^(p-1) / B.
    """

    sliding_unit: ClassVar[str] = UNIT
    sample_time: float
    power: float = gain(1.5, "", "power p of the rate, between 1 and 2", scalar=True, positive=True)
    slope: np.ndarray = gain(
        3.0, "rad^(p-1)/s^p or m^(p-1)/s^p", "slope B of the surface", positive=True
    )
    k_s: np.ndarray = gain(600.0, "1/s^2", "reaching gain K_s")
    alpha: np.ndarray = gain(
        100.0, "1/s^3", "rate of adaptation of the switching gain G", feedback=False
    )
    epsilon: np.ndarray = gain(
        1e-5, "rad or m", "size of s below which G decays", positive=True, feedback=False
    )
    decay: float = gain(
        1.0, "s", "time constant T_G of the decay of G", scalar=True, positive=True, feedback=False
    )
    g_max: np.ndarray = gain(
        0.1,
        "rad/s^2 or m/s^2",
        "upper bound of the switching gain G; null: no bound",
        bound=True,
        feedback=False,
    )
    width_s: np.ndarray = gain(1e-3, "rad or m", "width of the boundary layer of s", positive=True)
    width_rate: np.ndarray = gain(
        1e-2, "rad/s or m/s", "width of the boundary layer of e'", positive=True
    )

    def __post_init__(self) -> None:
        if not np.all(np.abs(self.power - 1.5) < 0.5):
            raise ValueError(f"power must be between 1 and 2, not {self.power}")

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_s)
        return {"sliding_variable": zeros, "switching_gain": zeros}

    def held(self) -> Mapping[str, float | None]:
        return {"switching_gain": None}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. G continues as a bound on forces."""
        return {"switching_gain": np.abs(ratio) @ state["switching_gain"]}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        p, g = self.power, state["switching_gain"]
        s = e + signed_power(e_dot, p, self.width_rate) / self.slope
        u = a_d + self.slope / p * signed_power(e_dot, 2.0 - p, self.width_rate)
        u = u + self.k_s * s + g * signed_power(s, 0.0, self.width_s)
        rate = np.where(np.abs(s) > self.epsilon, self.alpha * np.abs(s), -g / self.decay)
        g = np.minimum(np.maximum(g + self.sample_time * rate, 0.0), self.g_max)
        return u, {"sliding_variable": s, "switching_gain": g}
