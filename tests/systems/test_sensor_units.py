"""Sensors in densities and seconds: the same sensors at any sample time."""

import os
import re

import numpy as np
import pytest
from click.testing import CliRunner

from ffsm_drake import FfsmError, ScenarioError, load_scenario, override_scenario, simulate
from ffsm_drake.cli import main

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


@pytest.mark.parametrize("seed", range(10 * DRAWS))
def test_a_time_stays_or_is_refused_with_the_nearest(seed):
    random = np.random.default_rng(seed)
    step, samples = random.choice(STEPS), int(random.integers(1, 9))
    time = samples * step if random.random() < 0.6 else random.uniform(0.2, 8.0) * step
    key = random.choice(["delay_time", "velocity_delay_time.joints", "position_period_time.joints"])
    given = [f"sample_time={step}", f"sensing.{key}={float(time)!r}"]
    whole = abs(time / step - round(time / step)) < 1e-6
    if not whole:
        below = np.floor(time / step) * step
        near = re.escape(f"the nearest are {below:.6g} and {below + step:.6g} s")
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
