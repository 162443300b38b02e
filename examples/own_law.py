"""A control law of one's own, checked, run and compared with the paper's. From the shell, in the
folder of this file:

ffsm compare -c own_law:MyPdPlus -c tde_aismc
"""

import dataclasses

import numpy as np

import ffsm_drake
from ffsm_drake import gain
from ffsm_drake.show.tables import results_table
from ffsm_drake.testing import check_controller


@dataclasses.dataclass(frozen=True, kw_only=True)
class MyPdPlus(ffsm_drake.ControlLaw):
    """PD+: tau = Hhat a_d + Chat(q, v) v_d + K_d e' + K_p e."""

    model: ffsm_drake.PlantModel
    k_p: np.ndarray = gain(
        {"base_position": 1200, "base_rotation": 300, "joints": 30},
        "N m/rad or N/m",
        "on the error",
    )
    k_d: np.ndarray = gain({"all": 300, "joints": 30}, "N m s/rad or N s/m", "on its rate")

    def step(self, sample, state):
        q, v, v_d = sample.q, sample.v, sample.v_d
        coriolis = 0.25 * (self.model.calc_bias(q, v + v_d) - self.model.calc_bias(q, v - v_d))
        force = self.model.calc_mass_matrix(q) @ sample.a_d + coriolis
        return force + self.k_d * sample.e_dot + self.k_p * sample.e, state


def main():
    print(check_controller(MyPdPlus))
    mine = ["controller=own_law:MyPdPlus", "controllers.MyPdPlus.k_p.joints=20"]
    scenarios = [
        ffsm_drake.load_scenario("postcapture", overrides)
        for overrides in (mine, ["controller=tde_aismc"])
    ]
    records = [ffsm_drake.simulate(scenario) for scenario in scenarios]
    print(results_table(records))
    ffsm_drake.write_outputs(records, "out/own_law", figures=False)
    print("Open out/own_law/report.html.")


if __name__ == "__main__":
    main()
