"""Runs of a mission with other noise: their figures, with the engine and without it, and what is
said of thrusters and wheels as they are, against simulation from both sides.
"""

import dataclasses
import functools
import os
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario, override_scenario, simulate
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.design.stability import rehearsal, stability
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.rehearsal import (
    FEW,
    Rehearsal,
    rehearse,
    shares_diverged,
)
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.runs.ending import Ending
from ffsm_drake.spacecraft.plant import coordinates_of, make_plant
from ffsm_drake.systems.mission_limits import actuation_limit, base_limits
from ffsm_drake.systems.reference import timed


def diverges(scenario):
    return simulate(scenario, check_stability=False).outcome.status == "diverged"


@pytest.mark.parametrize(
    ("frame", "stable"), [(2, True), pytest.param(10, False, marks=pytest.mark.slow)]
)
def test_a_long_control_frame(frame, stable):
    """The mean is held over the frame, and the law reads it: 20 ms are well, 100 ms are not."""
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
@pytest.mark.parametrize(("torque", "stable"), [(1.0, False), (1.6, True)])
def test_saturated_wheels(with_wheels, torque, stable):
    """Without limits the loop is the same."""
    scenario = with_wheels(torque)
    found = verdict(scenario, rehearsal=False)
    assert found.is_alarm is not stable
    if not stable:
        (told,) = found.warnings
        assert "thrusters and wheels give 1.3 to 2.3 N m" in told
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
    found = rehearse(scenario, seeds=3, on_drake=False)  # thrusters and wheels are compiled
    assert found.saturated["wheels"].mean() == pytest.approx(figures["torque_limited"], rel=0.3)


def drawn(seed):
    """A short mission in which some noise sequences fail: its limits, or its actuators, and the
    bound of its rates are drawn.
    """
    rng = np.random.default_rng(seed)
    kind = rng.integers(3)
    name = ("flight_sensors", "thrusters_only", "thrusters_and_wheels")[kind]
    limits = [f"actuation.limit={rng.uniform(1.0, 30.0):.4g}"] if kind == 0 else []
    speed = 10.0 ** rng.uniform(-3.0, -1.8)
    changes = ["duration=1.5", f"divergence_speed={speed:.4g}", "supervisor={}", *limits]
    law = ("tdc", "asmc", "tde_aismc")[rng.integers(3)]
    return load_scenario(name, [f"controller={law}", f"random_seed={seed}", *changes])


def alike(one, other):
    """Whether two rehearsals are the same but for rounding."""
    np.testing.assert_array_equal(one.diverged, other.diverged)
    for name in ("noise_force", "motion_force", "rms_error"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-4, atol=1e-9)
    for name, shares in one.saturated.items():
        np.testing.assert_allclose(shares, other.saturated[name], atol=0.02)
    assert one.ending.status == other.ending.status


@pytest.mark.long
@pytest.mark.parametrize("seed", range(int(os.environ.get("FFSM_DRAWS", "4"))))
def test_compiled_rehearsals_are_those_of_drake(seed, monkeypatch):
    scenario = drawn(seed)
    compiled = rehearse(scenario, seeds=FEW)
    (share,) = shares_diverged([scenario], seeds=FEW)
    with monkeypatch.context() as patch:
        patch.setattr(rehearsal, "_engine", lambda: None)
        alike(compiled, rehearse(scenario, seeds=FEW))
        assert shares_diverged([scenario], seeds=FEW) == [share] == [compiled.share_diverged]
        few = rehearse(scenario, seeds=16)
        assert rehearse(scenario, seeds=16, on_drake=False) is None
    assert few.noises == FEW
    assert str(few).endswith("with pip install 'ffsm-drake[compiled]' there are 16 sequences")
    assert compiled.diverged.tolist() == few.diverged.tolist()


@pytest.mark.long
def test_what_is_not_compiled_is_run_few_times():
    """Without a word of an engine, which would not help."""
    scenario = load_scenario("flight_sensors", ["duration=0.5"])
    adaptive = override_scenario(scenario, ["simulator_config.use_error_control=true"])
    assert rehearse(adaptive, on_drake=False) is None
    found = rehearse(adaptive)
    assert found.noises == FEW
    assert "compiled" not in str(found)
    called = override_scenario(scenario, ["controller=mpc"])
    assert rehearse(called).noises == FEW


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
        diverged=np.array([False]),
        saturated={"wheels": np.array([share])},
        ending=Ending(status="settled", sentence=""),
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
        found.append(timed(make_mission(scenario)).scenario.reference.duration)
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
    """Faults play no part."""
    base = load_scenario("thrusters_and_wheels", ["duration=0.5"])
    broken = "faults.events={a: {unit: thrusters.a_x, kind: stuck_on, time: [0.1]}}"
    changes = ["divergence_speed=1e-4", broken], ["divergence_speed=2.2e-3"]
    cases = [base, *(override_scenario(base, each) for each in changes)]
    found = shares_diverged([timed(make_mission(each)) for each in cases], seeds=3)
    for case, share in zip(cases, found, strict=True):
        first = case.random_seed + 1000
        runs = [override_scenario(case, [f"random_seed={first + k}"]) for k in range(3)]
        assert share == np.mean([diverges(each) for each in runs])
    assert found[:2] == [0.0, 1.0]


@pytest.mark.long
def test_a_check_and_its_report_rehearse_once():
    """And at other values again."""
    scenario = load_scenario("thrusters_only", ["duration=1"])
    mission = make_mission(scenario)
    checked = verdict(mission, rehearsal=False).noises
    shown = stability(mission).rehearsal
    assert np.shares_memory(checked.rms_error, shown.rms_error)
    other = override_scenario(scenario, ["sensing.position_noise.all=1e-5"])
    assert not np.shares_memory(stability(other).rehearsal.rms_error, shown.rms_error)
