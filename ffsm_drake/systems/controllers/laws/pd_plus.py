"""PD+: the model-based baseline of Paden and Panja (1988), without an estimate of model errors."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class PdPlus(ControlLaw):
    """PD+ of Paden and Panja: feedforward along the plan, and PD feedback.

    tau = Hhat a_d + Chat(q, v) v_d + K_d e' + K_p e.

    Chat(q, v) v_d is the symmetric bilinear form whose diagonal is Drake's bias term.
    """

    label = "PD+"
    model: PlantModel
    k_p: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
        "N m/rad or N/m",
        "gain K_p on the error",
    )
    k_d: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 300.0, "joints": 30.0},
        "N m s/rad or N s/m",
        "gain K_d on the rate of the error",
    )

    @classmethod
    def starting_gains(
        cls, omega: np.ndarray, mass_matrices: np.ndarray
    ) -> Mapping[str, np.ndarray | float]:
        """K_P = w^2 m and K_D = 2 w m with the smallest inertia m of each coordinate along the
        motion, and with w twice ``omega``: without an estimate of the disturbance PD+ is stiffer.

        PD+ does not decouple the coordinates, so that m is less than the effective inertia: with A
        = H^-1, it is 1 / sum_j |A_ij| sqrt(A_ii / A_jj). Then no eigenvalue of H^-1 K_D exceeds the
        largest 2 w (sums over the rows of the scaled matrix), and the sampled loop is stable for
        2 w L < 2.
        """
        inverse, w = np.linalg.inv(mass_matrices), 2.0 * omega
        scale = np.sqrt(np.diagonal(inverse, axis1=1, axis2=2))
        inertia = 1.0 / (scale * (np.abs(inverse) / scale[:, None]).sum(axis=2))
        least = inertia.min(axis=0)
        return {"k_d": 2.0 * w * least, "k_p": w**2 * least}

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        q, v, v_d = sample.q, sample.v, sample.v_d
        coriolis = 0.25 * (self.model.calc_bias(q, v + v_d) - self.model.calc_bias(q, v - v_d))
        force = self.model.calc_mass_matrix(q).dot(sample.a_d) + coriolis
        return force + self.k_d * sample.e_dot + self.k_p * sample.e, state
