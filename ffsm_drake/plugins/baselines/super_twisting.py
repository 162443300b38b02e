"""The super-twisting law with time-delay estimation.

Kali, Saad, Benjelloun, Khairallah, "Super-twisting algorithm with time delay estimation for
uncertain robot manipulators", Nonlinear Dynamics 93 (2018) 557, doi:10.1007/s11071-018-4209-y; the
algorithm is Levant's (International Journal of Control 58 (1993) 1247,
doi:10.1080/00207179308923053), the choice of gains that of his lecture of 2005:

    s = e' + K_D e,     u = a_d + K_D e' + k_1 |s|^(1/2) sgn s + z,     z' = k_2 sgn s.

With u the closed loop is e'' = a_d - u - Ntilde, so s' = -k_1 |s|^(1/2) sgn s - z - Ntilde. It
reaches s = s' = 0 in a finite time if the rate of the estimation error Ntilde is at most C, with
k_1 = 1.5 C^(1/2) and k_2 = 1.1 C; u stays continuous.
"""

import dataclasses

import numpy as np

from ffsm_drake.plugins.baselines.powers import signed_power
from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics


@dataclasses.dataclass(frozen=True, kw_only=True)
class SuperTwisting(InjectedDynamics):
    """Super-twisting sliding-mode control with time-delay estimation.

    u = a_d + K_D e' + k_1 |s|^(1/2) sgn s + z with z' = k_2 sgn s and s = e' + K_D e. Gains are
    diagonals (nv).

    Root and sign are linear within a boundary layer of s. A linearisation about the plan, for
    example by ``ffsm stability``, uses the slope within the layer, where the law is stiffest:
    K_s = k_1 / width^(1/2), with an integral gain of k_2 / width.
    """

    sample_time: float
    k_d: np.ndarray = gain(10.0, "1/s", "slope K_D of the surface")
    rate_bound: np.ndarray = gain(
        20.0,
        "rad/s^3 or m/s^3",
        "bound C on the rate of the estimation error, which sets k_1 and k_2",
    )
    width: np.ndarray = gain(
        0.05, "rad/s or m/s", "width of the boundary layer of s", positive=True
    )

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_d)
        return {"sliding_variable": zeros, "twisting_acceleration": zeros}

    def resume(self, state: State, ratio: np.ndarray) -> State:
        """See InjectedDynamics. The acceleration z continues as a force."""
        return {"twisting_acceleration": ratio @ state["twisting_acceleration"]}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        s, z = e_dot + self.k_d * e, state["twisting_acceleration"]
        k_1, k_2 = 1.5 * np.sqrt(self.rate_bound), 1.1 * self.rate_bound
        u = a_d + self.k_d * e_dot + k_1 * signed_power(s, 0.5, self.width) + z
        z = z + self.sample_time * k_2 * signed_power(s, 0.0, self.width)
        return u, {"sliding_variable": s, "twisting_acceleration": z}
