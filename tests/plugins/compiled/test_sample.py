"""The map of a compiled sample: its derivative against differences of the map, and the linear loop
against finite differences of Drake's.
"""

import dataclasses
import itertools

import numpy as np
import pytest
from law_lists import frame_laws, joint_laws

from ffsm_drake import load_scenario
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.compiled.sample import TracedSample
from ffsm_drake.plugins.design.stability import linearization
from ffsm_drake.plugins.design.stability.linear_settings import without_limits
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.sampled_loop import SampledLoop, traced_sample
from ffsm_drake.scenario import HELD

LAWS = joint_laws("coordinated", "slotine_li", "tvlqr")
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
    (
        "thrusters_and_wheels",
        ("actuation.thrusters=null", "actuation.drives={viscous_friction: {joints: 0.2}}"),
    ),
)
# Laws with a task, or with gains along the plan; and scenarios with undriven coordinates, or with
# an estimator that has gains along the plan.
FURTHER_LAWS = (*frame_laws(), "tvlqr")
SHORT = ("duration=4", "reference.duration=3")
AT_ORIGIN, UPRIGHT = "initial_posture.base_position=[0, 0, 0]", "initial_posture.base_rpy=[0, 0, 0]"
FURTHER_SCENARIOS = (
    ("free_floating", SHORT),
    ("reaction_null", ()),
    ("ets_vii", ()),
    ("tumbling_capture", ()),
    ("postcapture", ("actuation.driven=[base_rotation, joints]", AT_ORIGIN)),
    ("flexible_panels", ("actuation.driven=[joints]", AT_ORIGIN, UPRIGHT, "sensing.delay=1")),
)
GIVEN = [
    *itertools.product((*LAWS, *FURTHER_LAWS), SCENARIOS),
    *itertools.product((*LAWS, *FURTHER_LAWS, "coordinated", "slotine_li"), FURTHER_SCENARIOS),
]
# A corner of a law is 1e-9 m away, or the law has large rounding.
LOOSE = {"paper": 1e-7, "ets_vii": 2e-6, "slotine_li": 1e-5, "prescribed_performance": 1e-7}
# Forces are large; or poles are multiple: a difference of 2e-7 moves three equal poles by 6e-3.
LARGE = {"envisat": 0.04, "asmc": 0.01}
WHEELS = "{units: {x: {axis: [1, 0, 0]}, y: {axis: [0, 1, 0]}, z: {axis: [0, 0, 1]}}}"
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
        loop, sample = linearizer._loop, linearizer._loop.sample
        first = round(linearizer.part(0.4) / sample.sample_time)
        state = loop.placed(first, {})
        for index in range(first, first + 5):
            state, _ = loop.after(index, state, {})
        held, index = [part for part, _ in sample.held.values()], first + 5
        _, *found = sample.derivative(index, state, None, np.eye(sample.size + sample.num_noise))
        free = np.ones(sample.size, dtype=bool)
        for part in held:
            free[part] = False
        for entry in np.flatnonzero(free):
            exact = np.concatenate([each[:, entry] for each in found])
            scale = max(1.0, np.abs(exact).max())
            off = [np.abs(each - exact).max() for each in differences(sample, index, state, entry)]
            assert min(off) < LOOSE.get(law, LOOSE.get(name, 1e-8)) * scale, entry


def with_thrusters(seed):
    """A drawn mission with thrusters: scenario, law, and overrides."""
    rng = np.random.default_rng(seed)
    pick = lambda *values: str(rng.choice(values))  # noqa: E731
    craft = ("postcapture", "flexible_panels", "seven_joint", "two_arms", "two_arms_capture")
    modulator = pick("pulse_width", "sigma_delta", "pwpf")
    thrusters = f"layout: 16x22N, frame: {rng.integers(2, 6)}, modulator: {modulator}"
    delay = rng.integers(0, 2)
    drives = pick("null", "{viscous_friction: {joints: 0.2}}")
    plume = pick("", ", plume: {}")
    given = (
        f"actuation.thrusters={{{thrusters}{plume}}}", f"actuation.wheels={pick('null', WHEELS)}",
        f"actuation.drives={drives}", f"actuation.delay={delay}",
        f"estimator.kind={pick('one_sample', 'kalman')}", f"sensing.delay={delay}",
    )  # fmt: skip
    return craft[seed % len(craft)], pick("tdc", "computed_torque", "asmc"), given


def check_loop(name, law, overrides, share, monkeypatch, most=5e-4):
    """The differences' steps of 1e-7 are large against the curvature of some laws, and small
    against the rounding of large forces.
    """
    scenario = load_scenario(name, [f"controller={law}", *overrides])
    with Linearizer(scenario) as linearizer:
        assert linearizer.is_exact
        exact = linearizer.at(linearizer.part(share))
    monkeypatch.setattr(linearization, "traced_sample", lambda *given: None)
    with Linearizer(scenario) as linearizer:
        assert not linearizer.is_exact
        differenced = linearizer.at(linearizer.part(share))
    monkeypatch.undo()
    radii = exact.spectral_radius, differenced.spectral_radius
    assert radii[0] == pytest.approx(radii[1], abs=LARGE.get(name, LARGE.get(law, most)))
    to_limit = 1.0 - max(radii)  # how slowly noise is forgotten
    if abs(radii[0] - radii[1]) < 0.01 * to_limit and name not in LARGE:
        expected = differenced.noise_response(500)
        for key, found in exact.noise_response(500).items():
            np.testing.assert_allclose(found, expected[key], rtol=0.05, atol=1e-12)


@pytest.mark.parametrize(
    ("law", "given"),
    [
        ("tdc", SCENARIOS[0]), ("asmc", SCENARIOS[1]), ("tdc", FURTHER_SCENARIOS[0]),
        ("tvlqr", SCENARIOS[0]), ("tdc", SCENARIOS[-1]),
    ],
    ids=str,
)  # fmt: skip
def test_the_derivative_is_exact(law, given):
    check_derivative(given[0], law, given[1])


# With a late sensor, a frame and planned gains, a sample reads all that it can.
@pytest.mark.parametrize(
    ("law", "name", "overrides"),
    [
        ("tde_aismc", "postcapture", ()),
        ("tdc", "free_floating", SHORT),
        ("tvlqr", "free_floating", (*SHORT, "sensing.position_period={base_position: 3}")),
        ("tdc", "flexible_panels", ("environment={altitude: null, mean_motion: 0.01}",)),
        ("tdc", "postcapture", (f"actuation.wheels={WHEELS}",)),
    ],
)
def test_the_loop_is_that_of_differences(law, name, overrides, monkeypatch):
    check_loop(name, law, overrides, 0.5, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "most"), [("tdc", 5e-6), ("tde_aismc", 1e-6)])
def test_poles_in_a_closed_chain_are_those_of_drake(law, most, monkeypatch):
    """But for those that decay within a few samples. The differences split multiple poles."""
    scenario = load_scenario("two_arms_capture", [f"controller={law}"])
    poles = []
    for _ in range(2):
        with Linearizer(scenario) as linearizer:
            assert linearizer.is_exact is not bool(poles)
            found = linearizer.at(linearizer.part(0.5)).poles
        poles.append(found[np.abs(found) > 0.97])
        monkeypatch.setattr(linearization, "traced_sample", lambda *given: None)
    assert poles[0].size == poles[1].size > 10
    apart = np.abs(poles[0][:, None] - poles[1])
    assert apart.min(axis=0).max() < most
    assert apart.min(axis=1).max() < most


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(seed, marks=pytest.mark.slow if seed == 0 else pytest.mark.long)
        for seed in range(15)
    ],
)
def test_loops_with_thrusters_are_those_of_differences(seed, monkeypatch):
    """One-armed and two-armed missions whose thrusters give their mean."""
    name, law, overrides = with_thrusters(seed)
    check_loop(name, law, overrides, 0.5, monkeypatch)


@pytest.mark.slow
def test_forces_that_no_motion_shows_have_poles_at_one_exactly():
    scenario = load_scenario("two_arms", ["controller=tdc", "chain.law=plain"])
    with Linearizer(scenario) as linearizer:
        assert linearizer.is_exact
        loop = linearizer.at(linearizer.end)
        assert loop.unit_poles == 6
        np.testing.assert_allclose(loop.poles[:6], 1.0, atol=1e-7)


def test_a_force_of_a_user_is_left_to_differences():
    """A compiled sample would not have it, and its effect in some samples is small."""
    own = "blocks.forces.own.system=own_stage:Pull"
    scenario = load_scenario("postcapture", ["controller=tdc", own])
    with Linearizer(scenario) as linearizer:
        assert not linearizer.is_exact


@pytest.mark.parametrize("name", ["reaction_null", "flexible_panels"])
def test_the_slope_of_the_momentum(name):
    """Against differences of Drake's momentum, for drawn states and payloads."""
    rng, scenario = np.random.default_rng(0), load_scenario(name, ["controller=tdc", *SHORT])
    mission = Mission(scenario)
    sample = TracedSample(mission, mission)
    loop = SampledLoop(sample, mission, HELD)
    for truth in (None, dataclasses.replace(scenario.payload.truth, mass=40.0)):
        own = (
            scenario.payload
            if truth is None
            else dataclasses.replace(scenario.payload, truth=truth)
        )
        model = mission.flown_by(payload=own).craft.flexible()
        state = sample.start + 0.1 * rng.standard_normal(sample.size)

        def momentum(change, state=state, model=model):
            x = state[: change.size] + change
            model.plant.SetPositionsAndVelocities(model.context, x)
            found = model.plant.CalcSpatialMomentumInWorldAboutPoint(model.context, np.zeros(3))
            return found.get_coeffs()

        steps = 1e-5 * np.eye(model.plant.num_multibody_states())
        expected = [(momentum(step) - momentum(-step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(
            loop.momentum_slope(state, truth), np.transpose(expected), rtol=1e-7, atol=1e-6
        )


@pytest.mark.long
@pytest.mark.parametrize(("law", "given"), GIVEN, ids=str)
def test_any_derivative_is_exact(law, given):
    check_derivative(given[0], law, given[1])


@pytest.mark.long
@pytest.mark.parametrize(("law", "given"), GIVEN, ids=str)
def test_any_loop_is_that_of_differences(law, given, monkeypatch):
    for share in (0.0, 0.5, 1.0):
        check_loop(given[0], law, given[1], share, monkeypatch)


@pytest.mark.parametrize("name", ["flight_sensors", "slow_navigation"])
def test_the_code_of_a_run_without_its_limit(name):
    """The sample of a run whose limit of force is infinite is that of a scenario without one."""
    given = load_scenario(name, ["controller=tdc", "actuation.limit={all: 1.0e-3}", *SHORT])
    bare = without_limits(make_mission(given))
    own, shared = (traced_sample(Mission(bare), Mission(each), HELD) for each in (bare, given))
    changed = own.start + 1e-3 * np.random.default_rng(0).standard_normal(own.size)
    every = np.eye(own.size + own.num_noise)
    expected, found = (each.derivative(3, changed, None, every) for each in (own, shared))
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-12, atol=1e-12)
