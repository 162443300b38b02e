"""A fixed-time law with time-delay estimation: the settling time has a bound for every start.

Two first-order fixed-time systems (Polyakov, "Nonlinear feedback design for fixed-time
stabilization of linear control systems", IEEE Transactions on Automatic Control 57 (2012) 2106,
doi:10.1109/TAC.2011.2179869) in the cascade of Zuo, "Non-singular fixed-time terminal sliding mode
control of non-linear systems", IET Control Theory & Applications 9 (2015) 545,
doi:10.1049/iet-cta.2014.0202. With sig^p(x) = |x|^p sgn x, p < 1 < g, and f(e) = a_1 sig^p(e) +
b_1 sig^g(e),

    s = e' + f(e),     u = a_d + f'(e) e' + a_2 sig^p(s) + b_2 sig^g(s),

so that s' = -a_2 sig^p(s) - b_2 sig^g(s) - Ntilde, and on s = 0 e' = -f(e). Each of the two is zero
after at most 1 / (a (1 - p)) + 1 / (b (g - 1)), wherever it starts.
"""

import dataclasses

import numpy as np

from ffsm_drake.plugins.baselines.powers import check_powers, signed_power, slope
from ffsm_drake.systems.controllers.law import State, gain
from ffsm_drake.systems.controllers.time_delay import InjectedDynamics


@dataclasses.dataclass(frozen=True, kw_only=True)
class FixedTime(InjectedDynamics):
    """Fixed-time control with time-delay estimation; the settling time is bounded for any start.

    u = a_d + f'(e) e' + a_2 sig^p(s) + b_2 sig^g(s) with s = e' + f(e). Gains are diagonals (nv).

    sig^p is linear within boundary layers of e and s, which removes the singularity of f'(0). A
    linearisation about the plan, for example by ``ffsm stability``, uses the slope within the
    layers. The law is stiffest there, unless the errors are larger than order one.
    """

    power: float = gain(0.6, "", "power p of small errors, below 1", scalar=True, positive=True)
    far_power: float = gain(1.4, "", "power g of large errors, above 1", scalar=True, positive=True)
    a_1: np.ndarray = gain(2.0, "rad^(1-p)/s or m^(1-p)/s", "gain a_1 on small errors")
    b_1: np.ndarray = gain(2.0, "rad^(1-g)/s or m^(1-g)/s", "gain b_1 on large errors")
    a_2: np.ndarray = gain(3.0, "rad^(1-p)/s^(2-p) or m^(1-p)/s^(2-p)", "gain a_2 on small s")
    b_2: np.ndarray = gain(3.0, "rad^(1-g)/s^(2-g) or m^(1-g)/s^(2-g)", "gain b_2 on large s")
    width: np.ndarray = gain(
        1e-2, "rad or m", "width of the boundary layer of the error", positive=True
    )
    width_s: np.ndarray = gain(
        1e-3, "rad/s or m/s", "width of the boundary layer of s", positive=True
    )

    def __post_init__(self) -> None:
        check_powers(self.power, self.far_power)

    def initial_state(self) -> State:
        return {"sliding_variable": np.zeros_like(self.a_1)}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: State
    ) -> tuple[np.ndarray, State]:
        """One control sample; see InjectedDynamics."""
        p, g = self.power, self.far_power
        s = e_dot + self.a_1 * signed_power(e, p, self.width) + self.b_1 * signed_power(e, g, 0.0)
        rate = self.a_1 * slope(e, p, self.width) + self.b_1 * g * np.abs(e) ** (g - 1.0)
        u = a_d + rate * e_dot
        u = u + self.a_2 * signed_power(s, p, self.width_s) + self.b_2 * signed_power(s, g, 0.0)
        return u, {"sliding_variable": s}
