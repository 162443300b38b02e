"""A user's law for every mission: a light wrist before the grasp and a heavy one after it."""

import dataclasses

import numpy as np

import ffsm_drake
from ffsm_drake import gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mine(ffsm_drake.ControlLaw):
    """tau = Mhat (a_d + K_d e' + K_p e) + hhat."""

    model: ffsm_drake.PlantModel
    k_p: np.ndarray = gain({"all": 9.0}, "1/s^2", "on the error")
    k_d: np.ndarray = gain({"all": 6.0}, "1/s", "on its rate")

    def step(self, sample, state):
        q, v = sample.q, sample.v
        wanted = sample.a_d + self.k_d * sample.e_dot + self.k_p * sample.e
        return self.model.calc_mass_matrix(q) @ wanted + self.model.calc_bias(q, v), state
