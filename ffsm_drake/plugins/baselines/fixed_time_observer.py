"""A fixed-time law of proportional-differential form with a fixed-time disturbance observer.

The structure is that of Yao, "Disturbance observer-based robust fixed-time integrated trajectory
tracking control for space manipulator", Robotica (2022): a nominal fixed-time law like a PD law,
and a fixed-time observer whose estimate of the lumped disturbance is fed forward. Only the abstract
of this paper was read. The equations are not copied from it, but are the common forms of both
parts. The law is homogeneous in both limits (Andrieu, Praly, Astolfi, "Homogeneous approximation,
recursive observer design, and output feedback", SIAM Journal on Control and Optimization 47 (2008)
1814, doi:10.1137/060675861). The observer is the uniform robust exact differentiator (Cruz-Zavala,
Moreno, Fridman, IEEE Transactions on Automatic Control 56 (2011) 2727,
doi:10.1109/TAC.2011.2160030), applied to the rate of the error.

With q'' = Hhat^-1 (tau - b) + d, where b = Chat(q, v) v and d is the lumped disturbance, sig^p(x) =
|x|^p sgn x, p < 1 < g, and x = e' - z,

    tau = Hhat (a_d + k_p f(e; p, g) + k_d f(e'; 2p/(1+p), 2g/(1+g)) - d^) + b,
    f(y; p, g) = c (sig^p(y / c) + sig^g(y / c)),     c the size at which both powers are equal,
    z' = a_d - Hhat^-1 (tau - b) - d^ + k_1 (sig^(1/2)(x) + mu sig^(3/2)(x)),
    d^' = -k_2 (sgn(x) / 2 + 2 mu x + 3/2 mu^2 sig^2(x)).

d^ = d after a time with a bound for every start, if the rate of d is at most C, with k_1 > 2
C^(1/2) and k_2 > 2 C; here k_1 = 2.1 C^(1/2) and k_2 = 2.1 C. In the sampled loop, z is predicted
over a period with the applied force, so that saturation is not taken for a disturbance.
"""

import dataclasses

import numpy as np

from ffsm_drake.plugins.baselines.powers import check_powers, signed_power
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, gain
from ffsm_drake.systems.controllers.time_delay import after_grasp

_MARGIN = 2.1  # of k_1 / C^(1/2) and k_2 / C, which must exceed 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class FixedTimeObserver(ControlLaw):
    """Fixed-time law of PD form with a fixed-time disturbance observer and the nominal model.

    tau = Hhat (a_d + k_p f(e) + k_d f(e') - d^) + Chat, each f a sum of two signed powers. Gains
    are diagonals (nv). The law uses no ``estimator`` of the scenario.

    Powers and sign are linear within boundary layers. A linearisation about the plan, for example
    by ``ffsm stability``, uses the slopes within the layers, where law and observer are stiffest.
    """

    model: PlantModel
    sample_time: float
    power: float = gain(0.6, "", "power p of small errors, below 1", scalar=True, positive=True)
    far_power: float = gain(1.4, "", "power g of large errors, above 1", scalar=True, positive=True)
    k_p: np.ndarray = gain({"all": 10.0, "base_position": 1.0}, "1/s^2", "gain k_p on the error")
    k_d: np.ndarray = gain(
        {"all": 5.0, "base_position": 2.0}, "1/s", "gain k_d on the rate of the error"
    )
    size: np.ndarray = gain(1.0, "rad or m", "error at which both powers are equal", positive=True)
    size_rate: np.ndarray = gain(
        1.0, "rad/s or m/s", "rate of the error at which both powers are equal", positive=True
    )
    width: np.ndarray = gain(
        1e-2, "rad or m", "width of the boundary layer of the error", positive=True
    )
    width_rate: np.ndarray = gain(
        1e-2, "rad/s or m/s", "width of the boundary layer of e'", positive=True
    )
    rate_bound: np.ndarray = gain(
        {"base_position": 1.0, "base_rotation": 10.0, "joints": 100.0},
        "rad/s^3 or m/s^3",
        "bound C on the rate of the disturbance, which sets k_1 and k_2",
    )
    far_gain: np.ndarray = gain(
        1.0, "s/rad or s/m", "weight mu of the observer's powers of large errors"
    )
    width_x: np.ndarray = gain(
        0.05, "rad/s or m/s", "width of the boundary layer of the observer's error", positive=True
    )

    def __post_init__(self) -> None:
        check_powers(self.power, self.far_power)

    def initial_state(self) -> State:
        zeros = np.zeros_like(self.k_p)
        # z at the next sample but for the force; d^
        return {"predicted_rate": zeros, "estimated_disturbance": zeros}

    def resume(self, state: State, before: ControlLaw, reference: np.ndarray) -> State:
        """See ControlLaw. The disturbance continues as a force."""
        if not isinstance(before, FixedTimeObserver):
            return state
        ratio, _ = after_grasp(self.model, before.model, reference)
        return {**state, "estimated_disturbance": ratio @ state["estimated_disturbance"]}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        mass_matrix = self.model.calc_mass_matrix(sample.q)
        bias = self.model.calc_bias(sample.q, sample.v)
        z, d = self._observed(sample, state, mass_matrix, bias)
        u = (
            sample.a_d
            - d
            + self.k_p * _powers(sample.e, self.power, self.far_power, self.size, self.width)
        )
        near, far = (2.0 * p / (1.0 + p) for p in (self.power, self.far_power))
        u = u + self.k_d * _powers(sample.e_dot, near, far, self.size_rate, self.width_rate)
        after = {
            "predicted_rate": z + self.sample_time * (sample.a_d - d),
            "estimated_disturbance": d,
        }
        return mass_matrix.dot(u) + bias, after

    def _observed(
        self, sample: Sample, state: State, mass_matrix: np.ndarray, bias: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """z and d^ (nv) at this sample."""
        d = state["estimated_disturbance"]
        if sample.is_first:
            return sample.e_dot, d
        given = np.linalg.solve(mass_matrix, sample.applied_force - bias)
        z = state["predicted_rate"] - self.sample_time * given
        x, mu, width = sample.e_dot - z, self.far_gain, self.width_x
        first = signed_power(x, 0.5, width) + mu * signed_power(x, 1.5, width)
        second = 0.5 * signed_power(x, 0.0, width) + 2.0 * mu * x
        second = second + 1.5 * mu * mu * signed_power(x, 2.0, width)
        z = z + self.sample_time * _MARGIN * np.sqrt(self.rate_bound) * first
        return z, d - self.sample_time * _MARGIN * self.rate_bound * second


def _powers(
    y: np.ndarray, near: float, far: float, size: np.ndarray, width: np.ndarray
) -> np.ndarray:
    """f(y; near, far) with its boundary layer, (nv)."""
    scaled, layer = y / size, width / size
    return size * (signed_power(scaled, near, layer) + signed_power(scaled, far, layer))
