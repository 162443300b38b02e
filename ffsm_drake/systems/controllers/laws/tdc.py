"""TDC: time-delay control, equation (17)."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from ffsm_drake.scenario import TdcGains
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.controllers.estimators import Arrays


@dataclasses.dataclass(frozen=True, kw_only=True)
class TdcLaw:
    """u = a_d + K_D e' + K_P e (equation (17)); no state. Gains are diagonals (nv)."""

    k_d: np.ndarray
    k_p: np.ndarray

    @classmethod
    def from_gains(cls, gains: TdcGains, coordinates: Coordinates, sample_time: float) -> "TdcLaw":
        """The law for a scenario's gains. Raises ScenarioError for an unknown or missing coordinate."""
        return cls(
            k_d=coordinates.vector(gains.k_d, key="controllers.tdc.k_d"),
            k_p=coordinates.vector(gains.k_p, key="controllers.tdc.k_p"),
        )

    def initial_state(self) -> Mapping[str, np.ndarray]:
        return {}

    def step(
        self, e: np.ndarray, e_dot: np.ndarray, a_d: np.ndarray, state: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, Arrays]:
        """One control sample; see InjectedDynamics."""
        return a_d + self.k_d * e_dot + self.k_p * e, ()
