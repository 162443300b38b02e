"""Coordinated control of base and arm about the centre of mass.

After Giordano, Ott, Albu-Schaeffer, "Coordinated control of spacecraft's attitude and end-effector
for space robots", IEEE Robotics and Automation Letters 4 (2019) 2108, doi:10.1109/LRA.2019.2899433,
with the joints in place of the end effector's pose, so that an arm of any number of joints can be
controlled.

With the velocity v_c of the centre of mass in place of the base's, v = T^-1 [w; v_c; q'], the mass
matrix T^-T H T^-1 has two blocks: the mass m, and H* of base attitude and joints. External force
moves the first alone, internal torques the second alone:

    m dv_c/dt = f_c,                              f_c = m a_c,d + K_D e_c' + K_P e_c,
    H* dx/dt + C*(q, x) x = f, x = [w; q'],       f = H* dx_d/dt + C*(q, x) x_d + K_D e' + K_P e,

e_c being the error of the centre of mass. The force is tau = [f_w; 0; f_q] + H_v f_c / m, with the
columns H_v of the base's velocity. Arm and attitude then use no thrust: the base's force is f_c.
"""

import dataclasses
import functools

import numpy as np

from ffsm_drake.plugins.baselines.payload import force_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.free_floating import FreeFloating, ReducedModel, driven_model
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.law import ControlLaw, Sample, State, gain

_TRANSLATION = slice(3, NUM_BASE_VELOCITIES)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Coordinated(ControlLaw):
    """PD control of the centre of mass, and PD+ of base attitude and joints (Giordano et al.).

    The gains of ``base_position`` act on the centre of mass. If the base position is not driven,
    f_c is zero. If the whole base is not driven, H* is the mass matrix of the joints.
    """

    model: PlantModel
    k_p: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 600.0, "joints": 500.0},
        "N m/rad or N/m",
        "gain K_P on the error",
    )
    k_d: np.ndarray = gain(
        {"base_position": 1200.0, "base_rotation": 600.0, "joints": 35.0},
        "N m s/rad or N s/m",
        "gain K_D on the rate of the error",
    )

    @functools.cached_property
    def internal(self) -> PlantModel:
        """The model with H* and C*, of base attitude and joints if the whole base is driven."""
        given = self.model
        if isinstance(given, ReducedModel):
            return given
        coordinates = dataclasses.replace(given.coordinates, undriven=("base_position",))
        return driven_model(dataclasses.replace(given, coordinates=coordinates))

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        internal, q, v, v_d = self.internal, sample.q, sample.v, sample.v_d
        force = force_of(internal, q, v, v_d, sample.a_d)
        force += self.k_d * sample.e_dot + self.k_p * sample.e
        force[~internal.coordinates.is_driven] = 0.0
        if not self.model.coordinates.undriven:
            force += self._external(sample)
        return force, state

    def _external(self, sample: Sample) -> np.ndarray:
        """H_v f_c / m (nv)."""
        model, q, v, q_d, v_d = self.model, sample.q, sample.v, sample.q_d, sample.v_d
        now, wanted = (
            FreeFloating(
                mass_matrix=model.calc_mass_matrix(each), base_position=each[4:NUM_BASE_POSITIONS],
                driven=np.arange(v.size),
            )
            for each in (q, q_d)
        )  # fmt: skip
        H, H_d = now.mass_matrix, wanted.mass_matrix
        mass = H[3, 3]
        e_c = wanted.base_position + wanted.center_of_mass - now.base_position - now.center_of_mass
        rate = (H_d[_TRANSLATION] @ v_d - H[_TRANSLATION] @ v) / mass
        planned = (H_d @ sample.a_d + model.calc_bias(q_d, v_d))[_TRANSLATION]
        f_c = planned + self.k_d[_TRANSLATION] * rate + self.k_p[_TRANSLATION] * e_c
        return H[:, _TRANSLATION] @ f_c / mass
