"""Many runs of one build: the bits of a fresh build, what a run may change, and metrics without the dataset."""

import dataclasses

import numpy as np
import pytest

from ffsm_drake import ScenarioError, load_scenario, override_scenario, simulate
from ffsm_drake.simulation import Rollout

SCENARIO = load_scenario("flight_sensors", ["duration=1", "sensing.delay=2", "actuation.delay=1"])


@pytest.fixture(scope="module")
def rollout():
    return Rollout(SCENARIO)


def assert_same_bits(log, scenario):
    fresh = Rollout(scenario).run()
    assert log.outcome == fresh.outcome
    assert log.scenario is scenario
    assert np.array_equal(log.time, fresh.time)
    assert set(log.series) == set(fresh.series)
    for name, values in log.series.items():
        assert np.array_equal(values, fresh.series[name]), name
    assert log.metrics == fresh.metrics


@pytest.mark.parametrize(
    "override",
    ["random_seed=7", "duration=0.5", "payload.truth={mass: 140, inertia: [20, 20, 20]}", "divergence_speed=1e-3"],
)
def test_a_run_has_the_bits_of_a_fresh_build(rollout, override):
    scenario = override_scenario(SCENARIO, [override])
    assert rollout.accepts(scenario)
    first = rollout.run()
    changed = rollout.run(scenario)
    assert_same_bits(changed, scenario)
    assert changed.time.size != first.time.size or not np.array_equal(changed.error, first.error)
    # Nothing stays behind for the next.
    assert_same_bits(rollout.run(), SCENARIO)


@pytest.mark.parametrize(
    "override",
    ["controller=tdc", "controllers.tde_aismc.k_d=3", "sample_time=0.02", "payload.belief.mass=70",
     "sensing.velocity_noise=1e-5", "disturbance.amplitude_scale=2", "simulator_config.max_step_size=0.005"],
)  # fmt: skip
def test_what_needs_another_build_is_refused(rollout, override):
    scenario = override_scenario(SCENARIO, [override])
    assert not rollout.accepts(scenario)
    with pytest.raises(ScenarioError, match="build another") as error:
        rollout.run(scenario)
    assert "\n" not in str(error.value)


def test_metrics_of_the_log_are_those_of_the_record(rollout):
    log, record = rollout.run(), simulate(SCENARIO)
    expected = {key: value for key, value in record.metrics.items() if key != "momentum_residual"}
    assert log.metrics == expected
    assert np.array_equal(log.error, record.dataset["error"].values)
    assert np.array_equal(log.generalized_force, record.dataset["generalized_force"].values)
    assert np.array_equal(log.time, record.dataset["time"].values)
    assert log.outcome == record.outcome


def test_a_log_is_frozen(rollout):
    with pytest.raises(dataclasses.FrozenInstanceError):
        rollout.run().time = np.zeros(1)
