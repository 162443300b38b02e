"""PD+: the model-based baseline of Paden and Panja (1988), without an estimate of model errors."""

import dataclasses

import numpy as np

from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, gain
from ffsm_drake.systems.controllers.time_delay import matrix_vector


@dataclasses.dataclass(frozen=True, kw_only=True)
class PdPlus(ControlLaw):
    """tau = Hhat a_d + Chat(q, v) v_d + K_d e' + K_p e.

    Chat(q, v) v_d is the symmetric bilinear form whose diagonal is Drake's bias term.
    """

    model: PlantModel
    k_p: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
        "N m/rad or N/m",
        "gain K_p on the error",
    )
    k_d: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
        "N m s/rad or N s/m",
        "gain K_d on the error's rate",
    )

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        q, v, v_d = sample.q, sample.v, sample.v_d
        coriolis = 0.25 * (self.model.calc_bias(q, v + v_d) - self.model.calc_bias(q, v - v_d))
        force = matrix_vector(self.model.calc_mass_matrix(q), sample.a_d) + coriolis
        return force + self.k_d * sample.e_dot + self.k_p * sample.e, state
