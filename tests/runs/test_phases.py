"""Phases without a capture: a run in two phases, and one that ends before the second."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake.runs.ending import DIVERGED
from ffsm_drake.runs.phases import Mission, Phase
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import load_scenario

SCENARIO = load_scenario("postcapture", ["duration=0.6", "reference.duration=10"])


@pytest.fixture(name="loops")
def _loops():
    loops = [Rollout(SCENARIO) for _ in range(2)]
    yield loops
    for loop in loops:
        loop.release()


def _two_phases(loops, scenario=SCENARIO):
    """A mission that changes loops after 25 samples, and its first phase."""
    mission = Mission([scenario])

    def second():
        return Phase(loop=loops[1], names=(("rest", None),), begin=mission.go_on)

    first = Phase(
        loop=loops[0],
        names=(("one", 10), ("two", 25)),
        begin=lambda loop, context: None,
        scenarios=[scenario],
        next=second,
    )
    return mission, first


def test_a_change_of_loops_keeps_the_bits(loops):
    alone = loops[1].run()
    mission, first = _two_phases(loops)
    (log,) = mission.run(first)
    assert log.outcome == alone.outcome
    assert np.array_equal(log.time, alone.time)
    assert set(log.series) == set(alone.series)
    for name, values in alone.series.items():
        assert np.array_equal(log.series[name], values), name
    assert mission.sample == 25


def test_a_run_that_diverges_goes_through_no_further_phase(loops):
    scenario = dataclasses.replace(SCENARIO, divergence_speed=1e-6)
    mission, first = _two_phases(loops, scenario)
    (log,) = mission.run(first)
    assert log.outcome.status == DIVERGED
    assert len(mission.logs[0]) == 1
    assert log.time[-1] < 0.25
