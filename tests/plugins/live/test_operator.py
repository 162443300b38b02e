"""The disturbance that an operator scales."""

import gc
import weakref

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.live.operator import make_operated_disturbance


@pytest.mark.smoke
def test_the_operators_disturbance_is_freed():
    made = []

    def operated(setup):
        hands = {
            "initial": np.array([1.0, 0.0, 0.0, 0.0]),
            "poll": lambda time, q: np.array([2.0, 1.0, 0.0, 0.0]),
        }
        disturbance = make_operated_disturbance(setup, **hands)
        made.extend(weakref.ref(part) for part in (disturbance, setup, *disturbance.GetSystems()))
        return disturbance

    scenario = load_scenario("postcapture", ["duration=0.05"])
    simulate(scenario, blocks={"forces.disturbance": operated}, check_stability=False)
    gc.collect()
    assert [part() for part in made] == [None] * 4
