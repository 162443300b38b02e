"""ASMC: adaptive sliding-mode control with time-delay estimation, equations (18) and (19)."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.scenario import AsmcGains
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.estimators import Arrays

# Floor of b|s| where (19) divides by it: the gain is clipped at zero long before the quotient matters.
_SMALLEST_SCALED_S = 1e-12


def switching_gain_rate(s: np.ndarray, g: np.ndarray, *, a: np.ndarray, b: np.ndarray, epsilon: float) -> np.ndarray:
    """dG/dt (nv) of equation (19), with a = phi and b = 1/alpha of its print: fast growth, slow decay."""
    magnitude = np.abs(s)
    scaled = b * magnitude
    direction = np.sign(max(magnitude.tolist()) - epsilon)  # on so few numbers faster than NumPy's max
    if direction < 0.0:
        return np.where(g > 0.0, -a / np.maximum(scaled, _SMALLEST_SCALED_S), a * scaled)
    return np.where(g > 0.0, direction * (a * scaled), a * scaled)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AsmcLaw:
    """u = a_d + K_D e' + K_s s + G sgn s with s = e' + K_D e (equation (18)). Gains are diagonals (nv)."""

    sample_time: float
    k_d: np.ndarray
    k_s: np.ndarray
    g_initial: np.ndarray
    epsilon: float
    a: np.ndarray
    b: np.ndarray
    g_max: np.ndarray

    @classmethod
    def from_gains(cls, gains: AsmcGains, coordinates: Coordinates, sample_time: float) -> "AsmcLaw":
        """The law for a scenario's gains. Raises ScenarioError for an unknown or missing coordinate."""
        return cls(
            sample_time=sample_time,
            epsilon=gains.epsilon,
            g_max=coordinates.vector(gains.g_max or {}, key="controllers.asmc.g_max", default=np.inf),
            **{
                name: coordinates.vector(getattr(gains, name), key=f"controllers.asmc.{name}")
                for name in ("k_d", "k_s", "g_initial", "a", "b")
            },
        )

    @functools.cached_property
    def _constants(self) -> Arrays:
        """The sample time and zero, (nv) each: NumPy takes half as long for two arrays as for an array and a number."""
        return np.full_like(self.k_d, self.sample_time), np.zeros_like(self.k_d)

    def initial_state(self) -> Mapping[str, np.ndarray]:
        return {"sliding_variable": np.zeros_like(self.k_d), "switching_gain": self.g_initial}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, Arrays]:
        """One control sample; see InjectedDynamics."""
        _, g = state
        s = e_dot + self.k_d * e
        u = a_d + self.k_d * e_dot + self.k_s * s + g * np.sign(s)
        rate = switching_gain_rate(s, g, a=self.a, b=self.b, epsilon=self.epsilon)
        period, zero = self._constants
        g_next = np.minimum(np.maximum(g + period * rate, zero), self.g_max)
        return u, (s, g_next)
