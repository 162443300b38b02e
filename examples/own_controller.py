"""A controller of one's own, flown, judged and compared with the paper's; from the shell the same is

ffsm compare postcapture -c own_controller:MyPdPlus -c tde_aismc          (in the folder of this file)
"""

import ffsm_drake
from ffsm_drake.show.outputs import results_table
from ffsm_drake.testing import check_controller


class MyPdPlus(ffsm_drake.SampledController):
    """PD+: tau = Hhat a_d + Chat(q, v) v_d + K_d e' + K_p e."""

    GAINS = {"k_p": {"base_position": 1200, "base_rotation": 300, "joints": 30}, "k_d": {"all": 300, "joints": 30}}

    def law(self, sample, state):
        plant = self.nominal
        coriolis = plant.calc_bias(sample.q, sample.v + sample.v_d) - plant.calc_bias(sample.q, sample.v - sample.v_d)
        force = plant.calc_mass_matrix(sample.q) @ sample.a_d + 0.25 * coriolis
        return force + self.gains["k_d"] * sample.e_dot + self.gains["k_p"] * sample.e, state


def main():
    print(check_controller(MyPdPlus))
    mine = ["controller=own_controller:MyPdPlus", "controllers.own.MyPdPlus.k_p.joints=20"]
    scenarios = [ffsm_drake.load_scenario("postcapture", overrides) for overrides in (mine, ["controller=tde_aismc"])]
    records = [ffsm_drake.simulate(scenario) for scenario in scenarios]
    print(results_table(records))
    ffsm_drake.write_outputs(records, "out/own_controller", figures=False)
    print("Open out/own_controller/report.html.")


if __name__ == "__main__":
    main()
