"""Computed torque: feedback linearization with the believed model, a baseline without estimate or adaptation."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from ffsm_drake.systems.controllers.sampled import Sample, SampledController


class ComputedTorque(SampledController):
    """tau = Hhat (a_d + K_d e' + K_p e) + Chat, with K_d in 1/s and K_p in 1/s^2."""

    GAINS: ClassVar = {"k_p": 25.0, "k_d": 10.0}

    def law(self, sample: Sample, state: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Mapping[str, np.ndarray]]:
        u = sample.a_d + self.gains["k_d"] * sample.e_dot + self.gains["k_p"] * sample.e
        force = self.nominal.calc_mass_matrix(sample.q) @ u + self.nominal.calc_bias(sample.q, sample.v)
        return force, state
