"""The proposed controller: TDE-based adaptive integral sliding-mode control, equations (6), (9) and (10)."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.scenario import TdeAismcGains
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.estimators import Arrays


def reaching_gain_rate(s: np.ndarray, k_s: np.ndarray, *, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """dK_s/dt (nv) of equation (9): zero at |s| = K_s / beta."""
    magnitude = np.abs(s)
    return alpha * magnitude * np.sign(magnitude - k_s / beta)


def switching_gain_rate(s: np.ndarray, g: np.ndarray, *, phi: np.ndarray, epsilon: float) -> np.ndarray:
    """dG/dt (nv) of equation (10): grows while ||s||_inf > epsilon, shrinks below; leaves zero at phi epsilon."""
    magnitude = np.abs(s)
    # On so few numbers Python's max and min are faster than NumPy's, and np.where is the slowest of all.
    excess = max(magnitude.tolist()) - epsilon
    rate = phi * magnitude
    if excess < 0.0:
        rate = -rate
    elif not excess > 0.0:
        rate *= excess  # zero, or not a number
    return rate if min(g.tolist()) > 0.0 else np.where(g > 0.0, rate, epsilon * phi)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TdeAismcLaw:
    """u = a_d + K_D e' + K_P e + K_s s + G sgn s with s = e' + K_D e + K_P int e (equation (6)).

    Gains are diagonals (nv). The surface is the one that (7) needs; (3) prints it with the factors of e and e'
    exchanged.
    """

    sample_time: float
    k_d: np.ndarray
    k_p: np.ndarray
    k_s_initial: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    k_s_max: np.ndarray
    g_initial: np.ndarray
    epsilon: float
    phi: np.ndarray
    g_max: np.ndarray

    @classmethod
    def from_gains(cls, gains: TdeAismcGains, coordinates: Coordinates, sample_time: float) -> "TdeAismcLaw":
        """The law for a scenario's gains. Raises ScenarioError for an unknown or missing coordinate."""
        key = "controllers.tde_aismc"
        return cls(
            sample_time=sample_time,
            epsilon=gains.epsilon,
            k_s_max=coordinates.vector(gains.k_s_max or {}, key=f"{key}.k_s_max", default=np.inf),
            g_max=coordinates.vector(gains.g_max or {}, key=f"{key}.g_max", default=np.inf),
            **{
                name: coordinates.vector(getattr(gains, name), key=f"{key}.{name}")
                for name in ("k_d", "k_p", "k_s_initial", "alpha", "beta", "g_initial", "phi")
            },
        )

    @functools.cached_property
    def _constants(self) -> Arrays:
        """The sample time and zero, (nv) each: NumPy takes half as long for two arrays as for an array and a number."""
        return np.full_like(self.k_d, self.sample_time), np.zeros_like(self.k_d)

    def initial_state(self) -> Mapping[str, np.ndarray]:
        zeros = np.zeros_like(self.k_d)
        return {
            "integral_error": zeros,
            "sliding_variable": zeros,
            "reaching_gain": self.k_s_initial,
            "switching_gain": self.g_initial,
        }

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, Arrays]:
        """One control sample; see InjectedDynamics."""
        integral, _, k_s, g = state
        s = e_dot + self.k_d * e + self.k_p * integral
        u = a_d + self.k_d * e_dot + self.k_p * e + k_s * s + g * np.sign(s)
        k_s_rate = reaching_gain_rate(s, k_s, alpha=self.alpha, beta=self.beta)
        g_rate = switching_gain_rate(s, g, phi=self.phi, epsilon=self.epsilon)
        period, zero = self._constants
        k_s_next = np.minimum(np.maximum(k_s + period * k_s_rate, zero), self.k_s_max)
        g_next = np.minimum(np.maximum(g + period * g_rate, zero), self.g_max)
        return u, (integral + period * e, s, k_s_next, g_next)
