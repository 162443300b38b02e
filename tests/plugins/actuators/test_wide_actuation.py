"""The actuators of several runs as one block: each run has the bits that it has alone."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion

from ffsm_drake import load_scenario, make_closed_loop
from ffsm_drake.plugins.actuators.allocation import Allocation
from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.plugins.actuators.row import Actuators
from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.systems.side_by_side import SideBySide

WHEELS = (
    "actuation.wheels.units={x: {axis: [1, 0, 0], coulomb_friction: 0.01, initial_momentum: 3.0}, "
    "y: {axis: [0, 1, 0], viscous_friction: 1.0e-4}, z: {}, s: {axis: [1, 1, 1]}}"
)
DRIVES = (
    "actuation.limit={joints: 4.0}",
    "actuation.drives.coulomb_friction={joints: 0.2}",
    "actuation.drives.static_friction={joints: 0.3}",
    "actuation.drives.viscous_friction={joint_1: 0.1}",
    "actuation.drives.smoothing_rate={all: 0.05}",
    "actuation.drives.rate_limit={joint_1: 0.05, joint_2: 0.1}",
)
CASES = {
    "limits": ("flight_sensors", ()),
    "late and coarse": (
        "postcapture",
        ("actuation.delay=2", "actuation.quantization={joints: 0.01}", "controller=pd_plus"),
    ),
    "drives": ("flight_sensors", DRIVES),
    "friction alone": ("postcapture", (DRIVES[1], DRIVES[4])),
    "wheels": ("flight_sensors", (WHEELS,)),
    "wheels that are full": (
        "thrusters_and_wheels",
        (
            "actuation.wheels.desaturate_above=0.02",
            "actuation.wheels.desaturate_below=0.01",
            "actuation.wheels.assist_above=1",
        ),
    ),
    "both": ("thrusters_and_wheels", ()),
    "both, and drives": ("thrusters_and_wheels", DRIVES[1:5]),
    "sigma-delta": ("thrusters_only", ("actuation.thrusters.modulator=sigma_delta",)),
    "pulse widths": (
        "thrusters_only",
        ("actuation.thrusters.modulator=pulse_width", "actuation.thrusters.minimum_on_time=0.008"),
    ),
    "triggers": (
        "thrusters_only",
        ("actuation.thrusters.modulator=pwpf", "actuation.thrusters.minimum_on_time=0.03"),
    ),
    "slow valves and failures": (
        "thrusters_only",
        (
            "actuation.thrusters.rise_time=0.004",
            "actuation.thrusters.fall_time=0.006",
            "actuation.thrusters.frame=3",
            "actuation.thrusters.failures={top_1_x: stuck_on, bottom_2_y: stuck_off}",
        ),
    ),
}


def varied(scenario, number, *, limits):
    """Another seed, payload, velocity, noise, and limit of the force."""
    payload, actuation, sensing = scenario.payload, scenario.actuation, scenario.sensing
    truth = dataclasses.replace(payload.truth, mass=payload.truth.mass * (1.0 + 0.02 * number))
    noise = {name: value * (1.0 + number) for name, value in sensing.velocity_noise.items()}
    if limits:
        limit = {"joints": 50.0 - 14.0 * number, "base_position": 22.0 - 5.0 * number}
        actuation = dataclasses.replace(actuation, limit=limit if number else None)
    return dataclasses.replace(
        scenario,
        random_seed=number,
        initial_velocity={"joint_1": 2e-3 * number, "base_rotation_z": 1e-3 * number},
        payload=dataclasses.replace(payload, truth=truth),
        sensing=dataclasses.replace(sensing, velocity_noise=noise),
        actuation=actuation,
    )


def check(scenarios):
    """As one block, with the bits of each run alone."""
    rollout = Rollout(scenarios)
    assert isinstance(rollout.loop.blocks["actuation"], Actuators)
    for log, scenario in zip(rollout.run_all(), scenarios, strict=True):
        alone = Rollout(scenario).run()
        if log is None:  # put aside
            assert alone.outcome.status == "diverged"
            continue
        assert set(log.series) == set(alone.series)
        for name, values in alone.series.items():
            np.testing.assert_array_equal(log.series[name], values, err_msg=name)


@pytest.mark.parametrize("case", CASES)
def test_actuators_have_their_bits(case):
    name, overrides = CASES[case]
    scenario = load_scenario(name, ["duration=0.5", *overrides])
    limits = scenario.actuation.drives is None
    check([varied(scenario, number, limits=limits) for number in range(3)])


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_actuators_have_their_bits_in_long_runs(case):
    name, overrides = CASES[case]
    scenario = load_scenario(name, ["duration=2", *overrides])
    check([varied(scenario, number % 4, limits=False) for number in range(16)])


def test_actuators_that_differ_in_more_stand_side_by_side():
    scenario = load_scenario("thrusters_only", ["duration=0.2"])
    frames = [load_scenario("thrusters_only", [f"actuation.thrusters.frame={n}"]) for n in (2, 3)]
    scenarios = [
        dataclasses.replace(scenario, actuation=frame.actuation, random_seed=seed)
        for seed, frame in enumerate(frames)
    ]
    rollout = Rollout(scenarios)
    assert isinstance(rollout.loop.blocks["actuation"], SideBySide)
    for log, each in zip(rollout.run_all(), scenarios, strict=True):
        for name, values in Rollout(each).run().series.items():
            np.testing.assert_array_equal(log.series[name], values, err_msg=name)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("thrusters_and_wheels", ("actuation.delay=2",)),
        ("flight_sensors", (*DRIVES, "actuation.delay=3")),
    ],
)
def test_a_parked_copy_begins_again_and_leaves_the_others(name, overrides):
    scenario = load_scenario(name, overrides)
    block = make_closed_loop([scenario] * 3).blocks["actuation"]
    parked, fresh = block.CreateDefaultContext(), block.CreateDefaultContext()
    for port in map(block.get_input_port, range(block.num_input_ports())):
        for context in (parked, fresh):
            port.FixValue(context, np.full(port.size(), 0.1))
    groups = [
        index
        for index in range(parked.num_discrete_state_groups())
        if parked.get_discrete_state(index).size() > 1
    ]
    for index in groups:
        size = parked.get_discrete_state(index).size()
        parked.SetDiscreteState(index, np.full(size, np.nan))
    parked.SetContinuousState(np.full(parked.num_continuous_states(), np.nan))
    block.park(parked, 1)
    memory = [parked.get_discrete_state(index).value() for index in groups]
    memory.append(parked.get_continuous_state_vector().CopyToVector())
    for values in memory:
        assert np.isnan(values).sum() * 3 == values.size * 2
    for port in map(block.get_output_port, range(block.num_output_ports())):
        expected, found = (port.Eval(each).reshape(3, -1) for each in (fresh, parked))
        np.testing.assert_array_equal(found[1], expected[1])


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    size=st.integers(1, 5),
    seed=st.integers(0, 1000),
    scale=st.sampled_from([0.1, 3.0, 30.0, 1e4]),
    failed=st.sampled_from([{}, {"top_1_x": "stuck_on"}, {"top_1_x": "stuck_off"}]),
)
def test_wrenches_are_allocated_each_by_itself(size, seed, scale, failed):
    settings_of = load_scenario("thrusters_only").actuation.thrusters
    thrusters = ThrusterSet(dataclasses.replace(settings_of, failures=failed), sample_time=0.01)
    wrenches = scale * np.random.default_rng(seed).normal(size=(size, 6))
    wrenches[0, 0] = np.nan if seed % 3 == 0 else 0.0
    memory = thrusters.initial_memory()
    rows = dataclasses.replace(
        memory,
        **{
            field.name: np.tile(getattr(memory, field.name), (size, 1))
            for field in dataclasses.fields(memory)
        },
    )
    together = thrusters.allocate(wrenches, rows)
    for row, wrench in enumerate(wrenches):
        alone = thrusters.allocate(wrench, memory)
        np.testing.assert_array_equal(together.packed()[row], alone.packed())


def test_a_program_too_is_solved_for_its_own_wrench():
    wrenches = np.hstack([np.eye(6), -np.eye(6)])
    allocation = Allocation(wrenches, largest=np.ones(12), cost=np.ones(12))
    wanted = np.array([[0.5, 0, 0, 0, 0, 0], [4.0, 0, 0, 0, 0, 0]])
    forces, part = allocation.solve(wanted)
    assert part == pytest.approx([1.0, 0.25])
    assert forces @ wrenches.T == pytest.approx(part[:, None] * wanted, abs=1e-9)


@given(seed=st.integers(0, 10_000), time=st.sampled_from([0.0, 0.005, 0.3]))
def test_attitudes_ahead_are_those_of_drake(seed, time):
    rng = np.random.default_rng(seed)
    quaternion, w = rng.normal(size=(3, 4)), rng.normal(size=(3, 3))
    found = attitude_ahead(quaternion, w, time)
    for row in range(3):
        np.testing.assert_array_equal(attitude_ahead(quaternion[row], w[row], time), found[row])
        half = 0.5 * time * w[row]
        angle = np.linalg.norm(half)
        turn = Quaternion(wxyz=[np.cos(angle), *(np.sinc(angle / np.pi) * half)])
        unit = quaternion[row] / np.linalg.norm(quaternion[row])
        expected = turn.multiply(Quaternion(unit / np.linalg.norm(unit))).rotation()
        assert found[row].reshape(3, 3) == pytest.approx(expected, abs=1e-14)
