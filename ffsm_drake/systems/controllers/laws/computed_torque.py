"""Computed torque, a baseline without estimate or adaptation: feedback linearization."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComputedTorque(ControlLaw):
    """Computed torque: feedback linearization with the nominal model.

    tau = Hhat (a_d + K_d e' + K_p e) + Chat.
    """

    label = "Computed torque"
    model: PlantModel
    k_p: np.ndarray = gain(25.0, "1/s^2", "gain K_p on the error")
    k_d: np.ndarray = gain(10.0, "1/s", "gain K_d on the rate of the error")

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        return {"k_d": 2.0 * omega, "k_p": omega**2}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        u = sample.a_d + self.k_d * sample.e_dot + self.k_p * sample.e
        mass_matrix = self.model.calc_mass_matrix(sample.q)
        return mass_matrix.dot(u) + self.model.calc_bias(sample.q, sample.v), state
