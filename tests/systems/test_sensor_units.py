"""Sensors in densities and seconds: the same sensors at any sample time."""

import os
import re

import numpy as np
import pytest
from click.testing import CliRunner
from pydrake.common import RandomGenerator
from pydrake.systems.analysis import Simulator

from ffsm_drake import (
    FfsmError,
    ScenarioError,
    load_scenario,
    make_nominal_plant,
    override_scenario,
    simulate,
)
from ffsm_drake.cli import main
from ffsm_drake.scenario import scenario_from_dict, scenario_to_dict
from ffsm_drake.systems.sensing.part import Sensing

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
STEPS = (0.01, 0.005)


def recorded(scenario):
    return simulate(scenario, check_stability=False).dataset


@pytest.mark.parametrize("seed", range(DRAWS))
def test_a_density_keeps_the_continuous_spectrum(seed):
    """The power in a band below both Nyquist frequencies is the density's, at every sample time."""
    random = np.random.default_rng(seed)
    density = {"velocity": 10 ** random.uniform(-6, -4), "position": 10 ** random.uniform(-6, -4)}
    sensing = {f"{of}_noise_density": value for of, value in density.items()}
    given = {"duration": 2.0, "random_seed": seed, "sensing": sensing}
    scenario = load_scenario("postcapture", [given, "simulator_config.max_step_size=0.01"])
    for step in STEPS:
        data = recorded(override_scenario(scenario, [f"sample_time={step}"]))
        joints = data.coordinate.values[6:]
        for of, name in (("velocity", "coordinate"), ("position", "position_name")):
            off = (data[f"measured_{of}"] - data[of]).sel({name: joints}).values[:-1]
            power = np.abs(np.fft.rfft(off, axis=0)[1:80]) ** 2 * step**2 / 2.0  # to 40 Hz
            found = np.sqrt(power.mean())  # 79 * 5 values: 5 % of deviation of the power
            assert found == pytest.approx(density[of], rel=0.15), (step, of)


def shown(sensing, step, count):
    """What sensors show of a state at rest (count, nq + nv), without that state."""
    state = np.zeros(sensing.GetInputPort("state").size())
    state[0] = 1.0
    simulator = Simulator(sensing)
    context = simulator.get_mutable_context()
    sensing.GetInputPort("state").FixValue(context, state)
    sensing.SetRandomContext(context, RandomGenerator(1))
    found = []
    for k in range(count):
        simulator.AdvanceTo((k + 0.25) * step)  # after the updates of sample k
        found.append(sensing.GetOutputPort("estimated_state").Eval(context) - state)
    return np.array(found)


@pytest.mark.parametrize("seed", range(4 * DRAWS))
def test_a_density_keeps_the_spectrum_of_a_slow_sensor(seed):
    """The power far below the sensor's rate is the density's, at any sample time and period."""
    random = np.random.default_rng(seed)
    density = {of: float(10 ** random.uniform(-6, -4)) for of in ("velocity", "position")}
    period = {of: 0.01 * int(random.integers(1, 5)) for of in density}
    sensing = {f"{of}_noise_density": value for of, value in density.items()}
    sensing |= {f"{of}_period_time": {"joints": value} for of, value in period.items()}
    scenario = load_scenario("postcapture", [{"sensing": sensing}])
    coordinates = make_nominal_plant(scenario).coordinates
    for step in STEPS:
        own = override_scenario(scenario, [f"sample_time={step}"]).sensing
        off = shown(Sensing(own, coordinates, sample_time=step), step, round(12.0 / step))
        nv = len(coordinates.names)
        for of, first in (("position", 7), ("velocity", nv + 7)):
            joints = off[:, first : first + nv - 6]
            count = round(1.2 / period[of])  # to a tenth of the sensor's rate
            power = np.abs(np.fft.rfft(joints, axis=0)[1:count]) ** 2 * step**2 / 12.0
            allowed = 2.5 / np.sqrt((count - 1) * joints.shape[1])  # 5 deviations of the root
            assert np.sqrt(power.mean()) == pytest.approx(density[of], rel=allowed), (step, of)


@pytest.mark.parametrize("seed", range(10 * DRAWS))
def test_a_time_stays_or_is_refused_with_the_nearest(seed):
    random = np.random.default_rng(seed)
    step, samples = random.choice(STEPS), int(random.integers(1, 9))
    time = samples * step if random.random() < 0.6 else random.uniform(0.2, 8.0) * step
    key = random.choice(["delay_time", "velocity_delay_time.joints", "position_period_time.joints"])
    given = [f"sample_time={step}", f"sensing.{key}={float(time)!r}"]
    whole = abs(time / step - round(time / step)) < 1e-6
    if not whole:
        near = re.escape(f"the nearest is {max(round(time / step), 1) * step:.6g} s")
        with pytest.raises(ScenarioError, match=near):
            load_scenario("postcapture", given)
        return
    scenario = load_scenario("postcapture", given)
    name = key.partition("_time")[0]
    for period in (step, step / 2.0):
        again = override_scenario(scenario, [f"sample_time={period}"])
        value = getattr(again.sensing, name)
        value = value["joints"] if isinstance(value, dict) else value
        assert value * period == pytest.approx(time)


def test_a_delay_in_seconds_is_that_of_the_measurements():
    exact = "sensing={delay_time: 0.03, velocity_noise: 0.0}"
    scenario = load_scenario("postcapture", ["duration=0.2", exact])
    for step in STEPS[:2]:
        data = recorded(override_scenario(scenario, [f"sample_time={step}"]))
        late = round(0.03 / step)
        measured, true = data.measured_position.values, data.position.values
        np.testing.assert_allclose(measured[late:, 7:], true[:-late, 7:], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["sample_time=0.02"], ["velocity_noise", "position_noise"]),
        (["sample_time=0.02", "sensing.velocity_noise=1e-5"], ["position_noise"]),
        (["sample_time=0.02", "sensing={velocity_noise: 1e-5, position_noise: 1e-5}"], []),
        ([], []),
    ],
)
def test_validate_names_what_was_given_for_another_sample_time(overrides, named):
    pytest.importorskip("ffsm_drake.plugins.design")
    words = [word for each in overrides for word in ("--set", each)]
    shown = CliRunner().invoke(main, ["validate", "flight_sensors", "--no-rehearsal", *words])
    assert shown.exit_code == 0
    lines = [line for line in shown.stderr.splitlines() if "given in samples of 0.01 s" in line]
    assert len(lines) == bool(named)
    for name in ("velocity_noise", "position_noise"):
        assert any(f"{name}," in line or f"{name};" in line for line in lines) == (name in named)


def test_a_wrong_density_is_refused():
    with pytest.raises(FfsmError, match="velocity_noise_density"):
        load_scenario("postcapture", ["sensing.velocity_noise_density=-1"])


@pytest.mark.parametrize(
    ("key", "value", "of"),
    [
        ("velocity_noise_density", 2e-5, "velocity_noise"),
        ("position_period_time", 0.2, "position_period"),
        ("velocity_delay_time", 0.03, "velocity_delay"),
    ],
)
def test_other_coordinates_keep_their_own_value(key, value, of):
    """A density or a time of one group needs no entry for the others."""
    given = {"duration": 0.05, "sensing": {key: {"base_rotation": value}}}
    plain, own = (load_scenario("flight_sensors", [more]) for more in ({"duration": 0.05}, given))
    recorded(own)
    before, after = (getattr(each.sensing, of) for each in (plain, own))
    assert after.pop("base_rotation") == pytest.approx(value / 0.01 if "time" in key else 2e-4)
    before.pop("base_rotation", None)
    assert after == before


GROUPS = ("all", "base_rotation", "base_position", "joints")


@pytest.mark.parametrize("seed", range(20 * DRAWS))
def test_a_density_replaces_what_is_below_it_for_its_coordinates(seed):
    """By coordinate, from a drawn stack of deviations and densities by coordinate and group."""
    random = np.random.default_rng(seed)
    spacecraft = load_scenario("postcapture")
    coordinates = make_nominal_plant(spacecraft).coordinates
    names = (*GROUPS, *coordinates.names)

    def drawn(kind):
        return {str(name): float(random.uniform(1, 9)) for name in random.choice(names, kind)}

    below, density = {"all": 1.0} | drawn(3), drawn(2)
    period = {"joints": int(random.integers(1, 5)), "base_rotation": int(random.integers(1, 5))}
    layers = [
        {"sensing": {"velocity_noise": below, "velocity_period": period}},
        {"sensing": {"velocity_noise_density": density}},
    ]
    scenario = load_scenario("postcapture", layers)
    below = spacecraft.sensing.velocity_noise | below
    wanted = coordinates.vector(below, key="")
    dense = coordinates.vector(density, key="", default=-1.0)
    samples = coordinates.vector(scenario.sensing.velocity_period, key="", default=1.0)
    own = dense / np.sqrt(scenario.sample_time * samples)
    found = coordinates.vector(scenario.sensing.velocity_noise, key="")
    np.testing.assert_allclose(found, np.where(dense > 0.0, own, wanted), rtol=1e-12)
    again = scenario_from_dict(scenario_to_dict(scenario), ["sample_time=0.02"]).sensing
    slower = coordinates.vector(again.velocity_noise, key="")
    np.testing.assert_allclose(
        slower, np.where(dense > 0.0, own / np.sqrt(2.0), wanted), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("velocity_noise", "velocity_noise_density"),
        ("position_noise", "position_noise_density"),
        ("delay", "delay_time"),
        ("velocity_delay", "velocity_delay_time"),
        ("position_period", "position_period_time"),
    ],
)
def test_a_value_per_sample_beside_a_density_or_time_is_refused(name, other):
    refused = pytest.raises(ScenarioError, match=rf"sensing\.{name}.*: is set by sensing\.{other}")
    with refused as error:  # in one file
        load_scenario("flight_sensors", [{"sensing": {name: 3, other: 0.04}}])
    assert "\n" not in str(error.value)
    with refused:  # in a later layer
        load_scenario("flight_sensors", [f"sensing.{other}=0.04", f"sensing.{name}=3"])
    scenario = load_scenario("flight_sensors", [f"sensing.{name}=3", f"sensing={{{other}: 0.04}}"])
    assert getattr(scenario.sensing, other) in (0.04, {"all": 0.04})
    with refused:
        override_scenario(scenario, [f"sensing.{name}=3"])
    after = override_scenario(scenario, [f"sensing.{other}=null", f"sensing.{name}=3"])
    assert getattr(after.sensing, name) in (3, {"all": 3})
    if name != "delay":  # of another sensor
        both = {"sensing": {name: {"joints": 3}, other: {"base_rotation": 0.04}}}
        found = getattr(load_scenario("flight_sensors", [both]).sensing, name)
        assert found["joints"] == 3
        whole = {"delay": 4, "period": 4}
        assert found["base_rotation"] == pytest.approx(whole.get(name[9:], 0.4))
