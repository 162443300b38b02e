"""Phases without a capture: a run in two phases, and one that ends before the second."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.ending import DIVERGED
from ffsm_drake.runs.phases import Mission, Phase
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import load_scenario, override_scenario

SCENARIO = load_scenario("postcapture", ["duration=0.6", "reference.duration=10"])


@pytest.fixture(name="loops")
def _loops():
    loops = [Rollout(SCENARIO) for _ in range(2)]
    yield loops
    for loop in loops:
        loop.release()


def _two_phases(loops, scenario=SCENARIO, afresh=()):
    """A mission that changes loops after 25 samples, and its first phase."""
    mission = Mission([scenario])

    def second():
        def begin(loop, context):
            mission.go_on(loop, context, *afresh)

        return Phase(loop=loops[1], names=(("rest", None),), begin=begin)

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


@pytest.mark.parametrize("laws", [("tde_aismc", "pd_plus"), ("pd_plus", "tde_aismc")])
def test_series_of_one_phase_are_nan_in_the_other(laws):
    scenarios = [override_scenario(SCENARIO, [f"controller={law}"]) for law in laws]
    loops = [Rollout(scenario) for scenario in scenarios]
    mission, first = _two_phases(loops, scenarios[0], afresh=("controller",))
    (log,) = mission.run(first)
    there = slice(0, 25) if laws[0] == "tde_aismc" else slice(25, None)
    for name in ("sliding_variable", "reaching_gain", "switching_gain"):
        values = make_table(log)[name].values
        assert np.isfinite(values[there]).all()
        rest = np.delete(values, there, axis=0)
        assert len(rest) in (25, 36)
        assert np.isnan(rest).all()
    for loop in loops:
        loop.release()
