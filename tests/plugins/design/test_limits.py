"""What ``ffsm stability --limits`` prints holds: stable as printed, unstable just beyond, at the
K_s that adaptation reaches.
"""

import dataclasses
import os

import numpy as np
import pytest

from ffsm_drake import load_scenario, simulate
from ffsm_drake.common.numbers import power_of_ten
from ffsm_drake.common.steps import current_step
from ffsm_drake.plugins.design.rounding import rounded_down
from ffsm_drake.plugins.design.stability import boundaries
from ffsm_drake.plugins.design.stability.adaptation import reached_gains
from ffsm_drake.plugins.design.stability.boundaries import (
    Boundaries,
    find_boundaries,
    probed_radius,
    variations,
)
from ffsm_drake.plugins.design.stability.linear_loop import radius_told
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.tables import boundaries_table
from ffsm_drake.scenario import controller_key
from ffsm_drake.systems.controllers import complete_gains

LAWS = (
    "tdc", "asmc", "aismc", "tde_aismc", "computed_torque", "pd_plus", "test_linearization:Damper",
)  # fmt: skip
# The initial posture is held, after a small kick.
HELD = [
    "sensing.velocity_noise=0",
    "disturbance.amplitude_scale=0",
    "initial_velocity={joint_1: 1e-6, base_rotation_x: 1e-6}",
    "target_posture.base_position=[0.1, 0.3, -0.2]",
    "target_posture.base_rpy=[0.11, 0.08, -0.1]",
    *(
        f"target_posture.joints.joint_{i}={np.deg2rad(angle)}"
        for i, angle in enumerate((10, 20, 60, 35, -40), start=1)
    ),
]


def drawn(random, law):
    """A scenario that holds its posture, with drawn gains, sample time and nominal payload."""
    mass = round(float(random.uniform(60.0, 110.0)), 1)
    given = [*HELD, f"controller={law}", f"payload.nominal.mass={mass}"]
    given += ["controllers.Damper.k_d=50"] if law.endswith("Damper") else []
    given += [f"sample_time={random.choice([0.005, 0.008, 0.01])}"]
    if law in ("aismc", "tde_aismc"):
        start, more = random.uniform(5.0, 30.0), random.uniform(1.0, 4.0)
        given += [f"controllers.{law}.k_s_initial={start:.3g}"]
        given += [f"controllers.{law}.k_s_max={start * more:.3g}"]
    return complete_gains(load_scenario("postcapture", given))


def changes_of(scenario, found):
    """Parameter -> the scenario as printed, and the one just beyond."""
    for name, vary in variations(scenario).items():
        limit = found.values[name]
        if np.isfinite(limit):
            ends = (limit, limit + 1) if name == "delay" else (rounded_down(limit), 1.02 * limit)
            yield name, *map(vary, ends)


def settled(scenario):
    """The scenario with K_s constant, where adaptation leaves it, and without the sign term."""
    with Linearizer(scenario) as linearizer:
        held = {}
        for held, _ in reached_gains(linearizer):  # the first that is stable, or the last
            if linearizer.at(0.0, held=held).spectral_radius < 1.0:
                break
        names = linearizer.coordinates.names
    if not held:
        return scenario
    k_s, key = dict(zip(names, held["reaching_gain"].tolist(), strict=True)), scenario.controller
    gains = {**scenario.controllers[controller_key(key)], "k_s_initial": k_s, "k_s_max": k_s}
    gains |= {name: {"all": 0.0} for name in ("g_initial", "g_max") if name in gains}
    return dataclasses.replace(scenario, controllers={**scenario.controllers, key: gains})


def grows(scenario, radius):
    """Whether the motion after a kick of 1e-6 rad/s grows, perhaps into a limit cycle, instead of
    dying out.
    """
    samples = np.clip(8.0 / abs(np.log(radius)), 900.0, 9000.0)
    changed = dataclasses.replace(scenario, duration=float(samples) * scenario.sample_time)
    record = simulate(changed, check_stability=False)
    rate = np.abs(record.dataset["error_rate"].values).max(axis=1)
    return not record.outcome.completed or rate[-len(rate) // 4 :].max() > 1e-6


def checked_limits(seed, law, *, runs):
    """Check the limits of a drawn scenario: rows (law, kind, limit, radius inside, outside)."""
    scenario = drawn(np.random.default_rng(seed), law)
    found, rows = find_boundaries(scenario, time=0.0), []
    assert (found.starting is not None) == (law in ("aismc", "tde_aismc"))
    for kind, inside, outside in changes_of(scenario, found):
        radii = [probed_radius(each, [0.0], adapted=True) for each in (inside, outside)]
        assert radii[0] < 1.0 <= radii[1], (law, seed, kind, radii)
        if runs:
            assert not grows(settled(inside), radii[0]), (law, seed, kind)
            assert grows(settled(outside), radii[1]), (law, seed, kind)
        rows.append((law, kind, found.values[kind], *radii))
        if found.starting is not None:
            assert found.values[kind] <= 1.002 * found.starting.values[kind]
    assert rows or np.isnan(found.delay)
    return rows


NUMBER = int(os.environ.get("FFSM_DRAWN_LIMITS", "1"))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(NUMBER))
@pytest.mark.parametrize("law", LAWS if NUMBER > 1 else ("tde_aismc",))
def test_drawn_limits_hold_as_printed_and_no_further(seed, law):
    checked_limits(seed, law, runs=False)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3, 3 + NUMBER))
@pytest.mark.parametrize("law", LAWS if NUMBER > 1 else ("tde_aismc", "pd_plus", LAWS[-1]))
def test_drawn_limits_against_runs(seed, law):
    for row in checked_limits(seed, law, runs=True):
        print(seed, *row)


def test_a_search_for_limits_says_at_which_parameter_it_is(monkeypatch):
    told = []

    def stable(*_, **__):
        told.append(current_step())
        return 0.5

    monkeypatch.setattr(boundaries, "probed_radius", stable)
    find_boundaries(load_scenario("postcapture", ["controller=tdc"]), time=0.0)
    names = ("gains", "nominal payload", "sample time", "delay")
    assert [*dict.fromkeys(told)] == [f"computing stability limits ({name})" for name in names]


def test_the_table_names_both_limits_rounded_down():
    values = {"gains": 1.2399, "nominal_payload": float("inf"), "sample_time": 2.6285}
    starting = Boundaries(**values, flexible_mass={}, delay=16.0)
    after = dataclasses.replace(starting, sample_time=1.9999, delay=0.0, starting=starting)
    scenario = load_scenario("postcapture")
    one = boundaries_table(starting, scenario)
    assert "x 1.23\n" in one
    assert "x 2.62 (26.2 ms)" in one
    assert "16 samples (160 ms)" in one
    assert "adaptation" not in one
    assert "without actuator limits and noise:\n" in one
    both = boundaries_table(after, scenario)
    assert "after adaptation" in both
    assert "x 1.99 (19.9 ms)" in both
    assert "x 2.62 (26.2 ms)" in both
    assert "0 samples (0 ms)" in both
    nan = float("nan")
    none = dataclasses.replace(after, delay=nan)
    assert "unstable at the K_s that adaptation reaches" in boundaries_table(none, scenario)
    none = dataclasses.replace(starting, delay=nan)
    assert "unstable at the given values" in boundaries_table(none, scenario)


def test_a_number_rounded_down_has_three_digits_and_is_no_larger():
    for value in 10.0 ** np.random.default_rng(0).uniform(-3, 6, 40):
        found = rounded_down(value)
        assert 0.98999 * value <= found <= value * (1.0 + 1e-12)
        assert found == float(f"{found:.3g}") == rounded_down(found)


@pytest.mark.parametrize(
    ("radius", "told"),
    [(0.999812, "0.99981"), (8.77e18, f"8.77{power_of_ten(18)}"), (123.4, "123")],
)
def test_a_spectral_radius_has_few_digits(radius, told):
    assert radius_told(radius) == told
