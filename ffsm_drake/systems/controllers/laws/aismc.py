"""AISMC: adaptive integral sliding-mode control with time-delay estimation, equations (20) and (21)."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.scenario import AismcGains
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.estimators import Arrays


def reaching_gain_rate(s: np.ndarray, k_s: np.ndarray, *, alpha: np.ndarray, beta: np.ndarray) -> np.ndarray:
    """dK_s/dt (nv) of equation (21): zero at |s| = K_s^2 / beta."""
    magnitude = np.abs(s)
    return alpha * magnitude * np.sign(magnitude - k_s * k_s / beta)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AismcLaw:
    """u = a_d + K_D e' + K_P e + K_s s with s = e' + K_D e + K_P int e (equation (20)). Gains are diagonals (nv).

    The surface is the one that (7) needs; (3) prints it with the factors of e and e' exchanged.
    """

    sample_time: float
    k_d: np.ndarray
    k_p: np.ndarray
    k_s_initial: np.ndarray
    alpha: np.ndarray
    beta: np.ndarray
    k_s_max: np.ndarray

    @classmethod
    def from_gains(cls, gains: AismcGains, coordinates: Coordinates, sample_time: float) -> "AismcLaw":
        """The law for a scenario's gains. Raises ScenarioError for an unknown or missing coordinate."""
        return cls(
            sample_time=sample_time,
            k_s_max=coordinates.vector(gains.k_s_max or {}, key="controllers.aismc.k_s_max", default=np.inf),
            **{
                name: coordinates.vector(getattr(gains, name), key=f"controllers.aismc.{name}")
                for name in ("k_d", "k_p", "k_s_initial", "alpha", "beta")
            },
        )

    @functools.cached_property
    def _constants(self) -> Arrays:
        """The sample time and zero, (nv) each: NumPy takes half as long for two arrays as for an array and a number."""
        return np.full_like(self.k_d, self.sample_time), np.zeros_like(self.k_d)

    def initial_state(self) -> Mapping[str, np.ndarray]:
        zeros = np.zeros_like(self.k_d)
        return {"integral_error": zeros, "sliding_variable": zeros, "reaching_gain": self.k_s_initial}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, Arrays]:
        """One control sample; see InjectedDynamics."""
        integral, _, k_s = state
        s = e_dot + self.k_d * e + self.k_p * integral
        u = a_d + self.k_d * e_dot + self.k_p * e + k_s * s
        rate = reaching_gain_rate(s, k_s, alpha=self.alpha, beta=self.beta)
        period, zero = self._constants
        k_s_next = np.minimum(np.maximum(k_s + period * rate, zero), self.k_s_max)
        return u, (integral + period * e, s, k_s_next)
