"""Stability with thrusters and wheels as they are, against simulation from both sides."""

import dataclasses
import functools
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario, override_scenario, simulate
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.rehearsal import Rehearsal, rehearse, shares_diverged
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.spacecraft.plant import coordinates_of, make_plant
from ffsm_drake.systems.limits import actuation_limit, base_limits
from ffsm_drake.systems.reference import timed


def diverges(scenario):
    return simulate(scenario, check_stability=False).outcome.status == "diverged"


@pytest.mark.parametrize(
    ("frame", "stable"), [(4, True), pytest.param(10, False, marks=pytest.mark.slow)]
)
def test_a_long_control_frame(frame, stable):
    """The frame's mean is held: 40 ms are well, 100 ms are not."""
    duration = 5.0 if stable else 9.0
    scenario = load_scenario(
        "thrusters_only", [f"actuation.thrusters.frame={frame}", f"duration={duration}"]
    )
    with Linearizer(scenario) as linearizer:
        assert (linearizer.at(0.0).spectral_radius < 1.0) is stable
    assert diverges(scenario) is not stable


def test_wheels_take_the_delay_out_of_torque():
    with Linearizer(
        load_scenario("thrusters_and_wheels", ["actuation.thrusters.frame=16"])
    ) as linearizer:
        assert linearizer.at(0.0).spectral_radius == pytest.approx(0.997, abs=1e-4)


@pytest.fixture(scope="module")
def with_wheels():
    """The proposed law on wheels of some torque (N m) up to the first seconds of the largest
    rates.
    """

    def make(torque, *overrides):
        limits = [f"actuation.wheels.units.wheel_{i}.torque_limit={torque}" for i in range(1, 5)]
        return load_scenario(
            "thrusters_and_wheels", ["duration=13", "controller=tde_aismc", *limits, *overrides]
        )

    return make


@pytest.mark.long
def test_wheels_that_give_too_little_are_told(with_wheels):
    """Predicted; that it is so: below."""
    (told,) = verdict(with_wheels(1.0), rehearsal=False).warnings
    assert "thrusters and wheels give 1.3 to 2.3 N m" in told


@pytest.mark.parametrize(
    ("torque", "stable"),
    [
        pytest.param(1.0, False, marks=pytest.mark.long),
        pytest.param(1.6, True, marks=pytest.mark.long),
    ],
)
def test_saturated_wheels(with_wheels, torque, stable):
    """Without limits the loop is the same."""
    scenario = with_wheels(torque)
    assert verdict(scenario, rehearsal=False).is_alarm is not stable
    assert diverges(scenario) is not stable


@pytest.mark.long
def test_verdict(with_wheels):
    margins = stability(dataclasses.replace(with_wheels(1.0), duration=12.0), postures=3)
    assert margins.starts_stable
    assert not margins.is_stable
    assert margins.verdict.startswith("unstable with its actuators: ")
    assert "thrusters and wheels give 1.3 to 2.3 N m and 10 to 17 N" in margins.verdict


@pytest.mark.long
def test_assisted_wheels_are_enough(with_wheels):
    scenario = with_wheels(1.0, "actuation.wheels.assist_above=2")
    assert rehearse(scenario, seeds=1).share_diverged == 0.0
    assert not diverges(scenario)


@pytest.mark.slow
def test_the_share_of_saturated_samples(with_wheels):
    scenario = dataclasses.replace(with_wheels(1.0), controller="tdc", duration=8.0)
    figures = simulate(scenario, check_stability=False).metrics["wheels"]
    assert rehearse(scenario, seeds=3).saturated["wheels"].mean() == pytest.approx(
        figures["torque_limited"], rel=0.3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["thrusters_only", "thrusters_and_wheels"])
def test_each_noise_is_rehearsed_as_it_is_alone(name):
    scenario = load_scenario(name, ["duration=2", "controller=tde_aismc"])
    several, alone = rehearse(scenario, seeds=3), rehearse(scenario, seeds=1)
    assert several.diverged.size == 3
    np.testing.assert_array_equal(several.diverged[:1], alone.diverged)
    for actuator, share in alone.saturated.items():
        np.testing.assert_array_equal(several.saturated[actuator][:1], share)


@functools.cache
def own_actuators():
    scenario = load_scenario("thrusters_and_wheels")
    return scenario, coordinates_of(make_plant(scenario.model))


@settings(max_examples=10, deadline=None)
@example(share=0.996)
@example(share=1e-5)
@given(share=st.floats(0.0, 1.0))
def test_a_share_of_the_samples_is_told_in_percent(share):
    scenario, coordinates = own_actuators()
    zero = np.zeros(len(coordinates.names))
    told = Rehearsal(
        scenario=scenario,
        coordinates=coordinates,
        noise_force=zero,
        motion_force=zero,
        diverged=np.array([np.nan]),
        saturated={"wheels": np.array([share])},
        largest_error=zero,
        rms_error=zero,
    )
    found = re.search(r"wheels in ([\d.]+) % of the samples|none saturates", str(told))
    assert float(found[1] or 0.0) == pytest.approx(100.0 * share, abs=0.051)


@pytest.mark.smoke
def test_what_the_actuators_give():
    """Four wheels of 1 N m along the diagonals of a cube: 4/sqrt(3) about its axes, 4/3 about a
    diagonal.
    """
    found = base_limits(load_scenario("thrusters_and_wheels"))
    assert found.torque.max() == pytest.approx(4.0 / np.sqrt(3.0))
    assert found.torque.min() == pytest.approx(4.0 / 3.0)
    assert found.force.min() == pytest.approx(10.0)
    assert base_limits(load_scenario("flight_sensors")).torque.min() == np.inf


def test_a_stop_of_any_duration_keeps_what_the_wheels_give():
    overrides = ["capture.approach=null", "reference.duration=auto", "actuation.limit={joints: 50}"]
    wheels = load_scenario("thrusters_and_wheels").actuation.wheels
    found = []
    for torque in (1.0, 4.0):
        units = {
            name: dataclasses.replace(unit, torque_limit=torque)
            for name, unit in wheels.units.items()
        }
        scenario = load_scenario(
            "tumbling_capture", [*overrides, "actuation.thrusters.layout=12x5N"]
        )
        actuation = dataclasses.replace(
            scenario.actuation, wheels=dataclasses.replace(wheels, units=units)
        )
        scenario = dataclasses.replace(scenario, actuation=actuation)
        found.append(timed(scenario).reference.duration)
        force = actuation_limit(scenario, coordinates_of(make_plant(scenario.model))).upper
        assert force[:6] == pytest.approx([4.0 / 3.0 * torque] * 3 + [10.0] * 3)
    assert found[0] > 1.2 * found[1]


@pytest.mark.parametrize(
    ("layout", "torque", "stop"),
    [("16x22N", None, 8.0), pytest.param("12x5N", 2.0, 20.0, marks=pytest.mark.long)],
)
def test_a_tumbling_target_is_brought_to_rest(layout, torque, stop):
    """From the grasp on, with either kind of actuators."""
    overrides = ["capture.approach=null", f"reference.duration={stop}", f"duration={stop + 3.0}"]
    overrides += ["actuation.limit={joints: 50}", f"actuation.thrusters.layout={layout}"]
    scenario = load_scenario("tumbling_capture", overrides)
    if torque is not None:
        wheels = load_scenario("thrusters_and_wheels").actuation.wheels
        units = {
            name: dataclasses.replace(unit, torque_limit=torque)
            for name, unit in wheels.units.items()
        }
        actuation = dataclasses.replace(
            scenario.actuation, wheels=dataclasses.replace(wheels, units=units)
        )
        scenario = dataclasses.replace(scenario, actuation=actuation)
    record = simulate(scenario, check_stability=False)
    assert record.outcome.status == "completed"
    error = record.dataset["error"].values[record.dataset["time"].values > stop + 1.0]
    assert np.abs(error).max() < 1e-3


@pytest.mark.long
def test_predicted_divergence_is_that_of_runs_with_these_noises():
    """Faults play no part, and a run that is not covered has that of the linear loop."""
    base = load_scenario("thrusters_and_wheels", ["duration=0.5"])
    broken = "faults.events={a: {unit: thrusters.a_x, kind: stuck_on, time: [0.1]}}"
    changes = ["divergence_speed=1e-4", broken], ["divergence_speed=2.2e-3"]
    adaptive = ["simulator_config.use_error_control=true"]
    cases = [base, *(override_scenario(base, each) for each in (*changes, adaptive))]
    found = shares_diverged([timed(each) for each in cases], seeds=3)
    for case, share in zip(cases[:3], found, strict=False):
        runs = [override_scenario(case, [f"random_seed={seed}"]) for seed in range(3)]
        assert share == np.mean([diverges(each) for each in runs])
    assert found[:2] == [0.0, 1.0]
    assert found[3] == rehearse(timed(cases[3]), seeds=3).share_diverged


@pytest.mark.long
def test_a_check_and_its_report_rehearse_once():
    """And at other values again."""
    scenario = load_scenario("capture_on_thrusters", ["capture.approach=null"])
    checked = verdict(scenario, rehearsal=False).noises
    shown = stability(scenario).rehearsal
    assert np.shares_memory(checked.largest_error, shown.largest_error)
    other = override_scenario(scenario, ["sensing.position_noise.all=1e-5"])
    assert not np.shares_memory(stability(other).rehearsal.largest_error, shown.largest_error)
