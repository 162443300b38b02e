"""Stability of a case predicted from the linear sampled loop, cheap enough for every run."""

import math

import numpy as np

from ffsm_drake.control_design.stability.margins import forecast_reaching_gain, sampling_of
from ffsm_drake.control_design.stability.sampled_loop import LoopGains, coupled_loop, law_gains
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import make_nominal_plant, make_true_plant
from ffsm_drake.systems.controllers import PAPER_LAWS
from ffsm_drake.systems.reference import make_reference

POSTURES = (0.0, 0.5, 1.0)  # fractions of the planned motion


def predict_stability(scenario: Scenario) -> tuple[float, float] | None:
    """Spectral radii of the coupled sampled loop, the worst over the postures looked at; below 1 it is stable.

    The first is at the starting gains, the second with every K_s at the largest value that adaptation is expected to
    reach. None for a controller that is not one of the paper's. Raises ModelError or ScenarioError where a value cannot
    be used.
    """
    if scenario.controller not in PAPER_LAWS:
        return None
    nominal, true = make_nominal_plant(scenario), make_true_plant(scenario)
    law = law_gains(scenario, nominal.coordinates)
    sampling = sampling_of(scenario, nominal.coordinates)
    reference = make_reference(scenario, nominal.coordinates)
    configurations = [reference.evaluate(part * scenario.reference.duration)[0] for part in POSTURES]
    pairs = [(true.calc_mass_matrix(q), nominal.calc_mass_matrix(q)) for q in configurations]

    def radius(gains: LoopGains) -> float:
        return max(
            coupled_loop(gains, true_mass_matrix=h, nominal_mass_matrix=h_hat, sampling=sampling).spectral_radius
            for h, h_hat in pairs
        )

    starting = radius(law.at())
    if starting >= 1.0 or np.array_equal(law.k_s_max, law.k_s):  # adaptation has nothing to add
        return starting, starting
    _, k_s = forecast_reaching_gain(scenario, law, sampling, true, nominal)
    expected = radius(law.at(k_s.max(axis=0)))
    return starting, expected if math.isfinite(expected) else math.inf
