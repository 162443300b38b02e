"""PD+: a model-based baseline of Paden and Panja (1988), without any estimate of what the model lacks."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ffsm_drake.systems.controllers.sampled import Sample, SampledController


class PdPlus(SampledController):
    """tau = Hhat a_d + Chat(q, v) v_d + K_d e' + K_p e, with forces per error as gains (N m/rad, N/m and per s).

    Chat(q, v) v_d is the symmetric bilinear form whose diagonal is Drake's bias term.
    """

    GAINS: ClassVar = {
        "k_p": {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
        "k_d": {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
    }

    def law(self, sample: Sample, state: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        q, v, v_d = sample.q, sample.v, sample.v_d
        coriolis = 0.25 * (self.nominal.calc_bias(q, v + v_d) - self.nominal.calc_bias(q, v - v_d))
        force = self.nominal.calc_mass_matrix(q) @ sample.a_d + coriolis
        return force + self.gains["k_d"] * sample.e_dot + self.gains["k_p"] * sample.e, state
