"""Many runs of one build: the bits of a fresh build, what a run may change, and metrics without the
dataset.
"""

import dataclasses

import numpy as np
import pytest
from pydrake.systems.analysis import SimulatorConfig
from pydrake.systems.framework import LeafSystem

from ffsm_drake import BlockError, ScenarioError, load_scenario, override_scenario, simulate
from ffsm_drake.common.settings import settings_of
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.scenario.schema import FIXED_STEP_SCHEMES
from ffsm_drake.systems.reference import PlannedReference

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
    [
        "random_seed=7",
        "duration=0.5",
        "payload.truth={mass: 140, inertia: [20, 20, 20]}",
        "divergence_speed=1e-3",
    ],
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


@pytest.mark.parametrize("scheme", settings_of(SimulatorConfig)["integration_scheme"].one_of)
def test_no_integrator_goes_on_from_the_run_before(scheme):
    """Of one with error control the last step is as long as the next would be."""
    controlled = scheme not in FIXED_STEP_SCHEMES
    scenario = load_scenario(
        "postcapture",
        [
            "duration=0.1",
            f"simulator_config.integration_scheme={scheme}",
            f"simulator_config.use_error_control={str(controlled).lower()}",
            "simulator_config.accuracy=1e-6",
        ],
    )
    rollout = Rollout(scenario)
    first, second = (rollout.run().series["state"] for _ in range(2))
    rollout.release()
    np.testing.assert_array_equal(first, second)
    assert not rollout.accepts(scenario)
    rollout.release()


@pytest.mark.parametrize(
    "override",
    [
        "controller=tdc",
        "controllers.tde_aismc.k_d=3",
        "sample_time=0.02",
        "payload.nominal.mass=70",
        "sensing.velocity_noise=1e-5",
        "disturbance.amplitude_scale=2",
        "simulator_config.max_step_size=0.005",
    ],
)
def test_what_needs_another_build_is_refused(rollout, override):
    scenario = override_scenario(SCENARIO, [override])
    assert not rollout.accepts(scenario)
    with pytest.raises(ScenarioError, match="build another") as error:
        rollout.run(scenario)
    assert "\n" not in str(error.value)


@pytest.mark.smoke
def test_metrics_of_the_log_are_those_of_the_record(rollout):
    log, record = rollout.run(), simulate(SCENARIO)
    assert log.ending == record.ending
    of_the_record = ("momentum_residual", "ending")
    expected = {key: value for key, value in record.metrics.items() if key not in of_the_record}
    assert log.metrics == expected
    assert np.array_equal(log.error, record.dataset["error"].values)
    assert np.array_equal(log.generalized_force, record.dataset["generalized_force"].values)
    assert np.array_equal(log.time, record.dataset["time"].values)
    assert log.outcome == record.outcome


@pytest.mark.smoke
def test_a_log_is_frozen(rollout):
    with pytest.raises(dataclasses.FrozenInstanceError):
        rollout.run().time = np.zeros(1)


def scenario_reference(setup):
    return PlannedReference().build(setup)


@pytest.mark.parametrize(
    "overrides",
    [
        # numbers soon cease to be finite
        ["payload.nominal.mass=250", "payload.nominal.inertia=[42, 42, 42]"],
        [
            "controllers.tde_aismc.k_s_initial=105",
            "controllers.tde_aismc.k_s_max=105",
            "duration=5",
        ],
        # Leaves the bound for a while only, and so is unremarkable at every stop.
        ["divergence_speed=0.012", "duration=20"],
    ],
)
def test_a_diverging_run_ends_where_a_monitor_of_every_step_stops_it(overrides, capfd, recwarn):
    scenario = load_scenario("postcapture", overrides)
    log = Rollout(scenario).run()
    assert log.outcome.status == "diverged"
    # With a user-supplied block, a monitor watches every step; this one is the scenario's own.
    watched = Rollout(scenario, blocks={"reference": scenario_reference}).run()
    assert log.outcome == watched.outcome
    assert np.array_equal(log.time, watched.time)
    for name, values in watched.series.items():
        assert np.array_equal(log.series[name], values), name
    assert capfd.readouterr().err == ""
    assert not recwarn.list


def test_steps_between_the_samples_are_watched_too():
    """The velocity leaves the bound between two samples; the run stops there."""
    scenario = load_scenario(
        "postcapture", ["divergence_speed=0.012", "simulator_config.max_step_size=0.0025"]
    )
    log = Rollout(scenario).run()
    assert log.outcome.status == "diverged"
    stopped = float(log.outcome.message.split("t = ")[1].split(" s:")[0])
    assert stopped == pytest.approx(log.time[-1], abs=0.01)
    assert np.abs(log.series["state"][:-1, 12:]).max() <= 0.012


class Damper(LeafSystem):
    """The least that a controller must have: no optional outputs, no applied_force."""

    def __init__(self, setup, damping=10.0):
        super().__init__()
        self.damping = damping
        self.state = self.DeclareVectorInputPort("estimated_state", 23)
        self.DeclareVectorInputPort("desired_state", 23)
        self.DeclareVectorInputPort("desired_acceleration", 11)
        self.DeclareStateOutputPort("generalized_force", self.DeclareDiscreteState(11))
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.0, self.update)

    def update(self, context, values):
        velocity = self.state.Eval(context)[12:]
        if not np.abs(velocity).max() < 1e3:
            raise ValueError("too fast for me")
        values.set_value(0, -self.damping * velocity)


class Pusher(Damper):
    def __init__(self, setup):
        super().__init__(setup, -200.0)


def test_a_user_supplied_controller_needs_the_ports_only():
    scenario = load_scenario("postcapture", ["duration=2", "sensing.velocity_noise=0"])
    record = simulate(scenario, blocks={"controller": Damper}, check_stability=False)
    assert record.outcome.completed
    assert not {"sliding_variable", "reaching_gain", "switching_gain"} & set(record.dataset)
    force, velocity = (
        record.dataset["generalized_force"].values,
        record.dataset["measured_velocity"].values,
    )
    assert np.array_equal(force, -10.0 * velocity)
    assert force.any()


def test_a_run_that_diverges_stops_before_the_controller_refuses():
    scenario = load_scenario("postcapture", ["duration=3"])
    assert Rollout(scenario, blocks={"controller": Pusher}).run().outcome.status == "diverged"
    with pytest.raises(
        BlockError,
        match=r"controller 'Pusher' failed at .*: ValueError: too fast "
        r"for me",
    ):
        Rollout(
            override_scenario(scenario, ["divergence_speed=1e6"]), blocks={"controller": Pusher}
        ).run()
