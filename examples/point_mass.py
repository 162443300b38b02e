"""An adaptive control law of one's own: it estimates a mass at the origin of the payload's frame.
From the shell, in the folder of this file:

ffsm run -c point_mass:PointMass --set disturbance.amplitude_scale=0
"""

import dataclasses

import numpy as np

import ffsm_drake
from ffsm_drake import ControlLaw, PlantModel, gain
from ffsm_drake.show.tables import results_table

PAYLOAD = "debris::debris"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointMass(ControlLaw):
    """Slotine and Li's law; it adapts a mass m at the origin of the payload's frame."""

    model: PlantModel
    sample_time: float
    slope: np.ndarray = gain(4.0, "1/s", "of the surface")
    k_d: np.ndarray = gain(
        {"base_position": 1200, "base_rotation": 300, "joints": 60}, "N m s/rad or N s/m", "on s"
    )
    rate: float = gain(1e6, "kg^2/(N m)", "of the mass", scalar=True, feedback=False)

    def initial_state(self):
        return {"mass": np.zeros(1)}  # kg, added to the nominal payload

    def held(self):  # a linearisation holds the mass
        return {"mass": None}

    def step(self, sample, state):
        q, v, model = sample.q, sample.v, self.model
        v_r = sample.v_d + self.slope * sample.e
        a_r = sample.a_d + self.slope * sample.e_dot
        s = v_r - v
        turning = 0.25 * (
            model.calc_bias_acceleration(q, v + v_r, PAYLOAD)
            - model.calc_bias_acceleration(q, v - v_r, PAYLOAD)
        )
        J = model.calc_jacobian(q, PAYLOAD)[3:]
        Y = J.T @ (J @ a_r + turning[3:])
        coriolis = 0.25 * (model.calc_bias(q, v + v_r) - model.calc_bias(q, v - v_r))
        force = model.calc_mass_matrix(q) @ a_r + coriolis + Y * state["mass"] + self.k_d * s
        return force, {"mass": state["mass"] + self.sample_time * self.rate * (Y @ s)}


if __name__ == "__main__":
    changes = ["duration=8", "reference.duration=8", "disturbance.amplitude_scale=0"]
    changes += ["payload.nominal.inertia=[16.7, 16.7, 16.7]", "controller=point_mass:PointMass"]
    adapts = ffsm_drake.load_scenario("postcapture", changes)
    fixed = ffsm_drake.override_scenario(adapts, ["controllers.PointMass.rate=0"])
    records = [ffsm_drake.simulate(each, check_stability=False) for each in (adapts, fixed)]
    print(results_table(records))
    ffsm_drake.write_outputs(records, "out/point_mass", figures=False)
