"""Phases without a capture: a run in two phases, and one that ends before the second."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.ending import DIVERGED
from ffsm_drake.runs.phases import Mission, Phase
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario import load_scenario, override_scenario
from ffsm_drake.systems.controllers import controller_factory

SCENARIO = load_scenario("postcapture", ["duration=0.6", "reference.duration=10"])


def _two_phases(scenario=SCENARIO, kept=None, **second):
    """A mission that changes loops after 25 samples, and its first phase."""
    rest = Phase(names=(("rest", None),), holds=True, **second)
    names = (("one", 10), ("two", 25))
    return Mission(scenario, kept=kept), Phase(names=names, holds=True, next=lambda: rest)


def _of_law(name):
    return override_scenario(SCENARIO, [f"controller={name}"])


@pytest.mark.parametrize("is_kept", [False, True])
def test_a_change_of_loops_keeps_the_bits(is_kept):
    loop = Rollout(SCENARIO)
    alone = loop.run()
    mission, first = _two_phases(kept={True: loop} if is_kept else None)
    log = mission.run(first)
    assert log.outcome == alone.outcome
    assert np.array_equal(log.time, alone.time)
    assert set(log.series) == set(alone.series)
    for name, values in alone.series.items():
        assert np.array_equal(log.series[name], values), name
    assert mission.sample == 25
    assert bool(loop.accepts(SCENARIO))  # a kept one is not released
    loop.release()


def test_a_run_that_diverges_goes_through_no_further_phase():
    scenario = dataclasses.replace(SCENARIO, divergence_speed=1e-6)
    mission, first = _two_phases(scenario)
    log = mission.run(first)
    assert log.outcome.status == DIVERGED
    assert len(mission.logs) == 1
    assert log.time[-1] < 0.25


def test_nothing_in_the_gripper_is_lighter():
    """The first force of a law with a model is that of the phase's own payload."""
    motion = override_scenario(SCENARIO, ["controller=computed_torque"])
    forces = {}
    for holds in (True, False):
        names = (("only", None),)
        log = Mission(motion).run(Phase(names=names, holds=holds))
        forces[holds] = np.abs(log.series["generalized_force"][5:]).max(axis=0)
    assert (forces[False][6:] < 0.7 * forces[True][6:]).all()


@pytest.mark.parametrize("laws", [("tde_aismc", "pd_plus"), ("pd_plus", "tde_aismc")])
def test_series_of_one_phase_are_nan_in_the_other(laws):
    own = {"controller": controller_factory(_of_law(laws[1]))}
    mission, first = _two_phases(_of_law(laws[0]), blocks=own, afresh=("controller",))
    log = mission.run(first)
    there = slice(0, 25) if laws[0] == "tde_aismc" else slice(25, None)
    for name in ("sliding_variable", "reaching_gain", "switching_gain"):
        values = make_table(log)[name].values
        assert np.isfinite(values[there]).all()
        rest = np.delete(values, there, axis=0)
        assert len(rest) in (25, 36)
        assert np.isnan(rest).all()
