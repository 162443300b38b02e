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


SYSTEMS = {
    "harmonics": [],
    "function of a sample": ["blocks.forces.disturbance.system=own_stage:Pull"],
}


@pytest.mark.parametrize("overrides", SYSTEMS.values(), ids=SYSTEMS)
def test_an_operator_who_does_nothing_changes_no_bit(overrides):
    scenario = load_scenario("postcapture", ["duration=0.2", *overrides])

    def operated(scale):
        hands = np.array([scale, 0.0, 0.0, 0.0])
        return lambda setup: make_operated_disturbance(
            setup, initial=hands, poll=lambda time, q: hands
        )

    records = [
        simulate(scenario, blocks=blocks, check_stability=False).dataset
        for blocks in (
            {},
            {"forces.disturbance": operated(1.0)},
            {"forces.disturbance": operated(3.0)},
        )
    ]
    for name in ("position", "velocity", "disturbance_force"):
        plain, same, larger = (record[name].values for record in records)
        assert np.array_equal(plain, same), name
        assert not np.array_equal(plain, larger), name
