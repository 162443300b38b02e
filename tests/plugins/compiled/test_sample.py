"""The map of a compiled sample: its derivative against differences of the map, and the linear loop
against finite differences of Drake's.
"""

import numpy as np
import pytest

from ffsm_drake import load_scenario
from ffsm_drake.plugins.design.stability import linearization
from ffsm_drake.plugins.design.stability.linearization import Linearizer

LAWS = (
    "tde_aismc", "aismc", "asmc", "tdc", "computed_torque", "pd_plus", "super_twisting",
    "terminal_sliding_mode", "fixed_time", "torque_against_momentum",
)  # fmt: skip
SCENARIOS = (
    ("postcapture", ()),
    ("postcapture", ("sensing.delay=1",)),
    ("postcapture", ("actuation.delay=1", "estimator.kind=kalman")),
    ("flight_sensors", ()),
    ("slow_navigation", ()),
    ("flexible_panels", ()),
    ("paper", ()),
    ("seven_joint", ()),
    ("planar_detumble", ()),
    ("envisat", ()),
)
STEPS = 10.0 ** np.arange(-11, -2)


def differences(sample, index, state, entry):
    """Richardson's from central differences by an entry of the state, with several steps."""
    for step in STEPS * max(1.0, abs(state[entry])):
        slopes = []
        for each in (step, 0.5 * step):
            change = np.zeros(sample.size)
            change[entry] = each
            ends = [sample.after(index, state + sign * change) for sign in (1.0, -1.0)]
            up, down = (np.concatenate(end) for end in ends)
            slopes.append((up - down) / (2.0 * each))
        yield (4.0 * slopes[1] - slopes[0]) / 3.0


def check_derivative(name, law, overrides):
    with Linearizer(load_scenario(name, [f"controller={law}", *overrides])) as linearizer:
        assert linearizer.is_exact
        loop, sample = linearizer._loop, linearizer._loop._sample
        first = round(linearizer.part(0.4) / sample.sample_time)
        loop.place(first, {})
        for each in range(5):
            loop.go_on(first + each, {})
        held = [sample.memory[name] for name in linearizer.law.held()]
        index, state = first + 5, loop.save()
        _, found = sample.derivative(index, state)
        free = np.ones(sample.size, dtype=bool)
        for part in held:
            free[part] = False
        for entry in np.flatnonzero(free):
            exact = np.concatenate([found.state[:, entry], found.force[:, entry]])
            scale = max(1.0, np.abs(exact).max())
            off = [np.abs(each - exact).max() for each in differences(sample, index, state, entry)]
            # in `paper`, a corner of a law is 1e-9 m away
            assert min(off) < (1e-7 if name == "paper" else 1e-8) * scale, entry


def check_loop(name, law, overrides, share, monkeypatch):
    """The differences' steps of 1e-7 are large against the curvature of some laws, and small
    against the rounding of large forces.
    """
    scenario = load_scenario(name, [f"controller={law}", *overrides])
    with Linearizer(scenario) as linearizer:
        assert linearizer.is_exact
        exact = linearizer.at(linearizer.part(share))
    monkeypatch.setattr(linearization, "traced_sample", lambda scenario: None)
    with Linearizer(scenario) as linearizer:
        assert not linearizer.is_exact
        differenced = linearizer.at(linearizer.part(share))
    monkeypatch.undo()
    radii = exact.spectral_radius, differenced.spectral_radius
    large = name == "envisat"
    assert radii[0] == pytest.approx(radii[1], abs=0.04 if large else 5e-4)
    if max(radii) < 1.0 and not large:
        expected = differenced.noise_response(500)
        for key, found in exact.noise_response(500).items():
            np.testing.assert_allclose(found, expected[key], rtol=0.05, atol=1e-12)


@pytest.mark.parametrize(
    ("law", "given"), [("tdc", SCENARIOS[0]), ("asmc", SCENARIOS[1])], ids=lambda each: str(each)
)
def test_the_derivative_is_exact(law, given):
    check_derivative(given[0], law, given[1])


def test_the_loop_is_that_of_differences(monkeypatch):
    check_loop("postcapture", "tde_aismc", (), 0.5, monkeypatch)


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("name", "overrides"), SCENARIOS)
def test_any_derivative_is_exact(name, law, overrides):
    check_derivative(name, law, overrides)


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("name", "overrides"), SCENARIOS)
def test_any_loop_is_that_of_differences(name, law, overrides, monkeypatch):
    for share in (0.0, 0.5, 1.0):
        check_loop(name, law, overrides, share, monkeypatch)
