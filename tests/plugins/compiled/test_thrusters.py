"""Thrusters compiled: their allocation, pulses, failures and faults, against Drake's."""

import os

import numpy as np
import pytest
from compared_runs import check, of_seeds
from compiled_equations import of_copies, text_of_traced

from ffsm_drake import load_scenario, simulate_many
from ffsm_drake.plugins.actuators.allocation import lost_direction
from ffsm_drake.plugins.actuators.plume import allocated
from ffsm_drake.plugins.actuators.row import acting_blocks
from ffsm_drake.plugins.actuators.thrusters import ThrusterSet
from ffsm_drake.plugins.compiled.compiling import registers
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.spacecraft.plant import coordinates_of, make_plant
from ffsm_drake.systems.sampled import phases_of

DRAWS = int(os.environ.get("FFSM_DRAWS", "1"))
LAWS = ("tdc", "tde_aismc", "computed_torque", "pd_plus", "fixed_time", "tvlqr")


def thrusters(random):
    """Thrusters of any geometry and modulator, with or without wheels; disturbances and, in some
    draws, faults and payloads by run.
    """
    name = str(random.choice(["thrusters_only", "thrusters_and_wheels"]))
    layout = {"12x1N": "abcd", "12x5N": "abcd", "16x22N": ["top_1", "top_2", "top_3", "top_4"]}
    own, frame = str(random.choice([*layout, "units"])), random.integers(1, 5)
    section = "actuation.thrusters"
    if own == "units":
        given, names = [f"{section}.layout=null", f"{section}.units={units(random)}"], ["u_0"]
    else:
        given, names = [f"{section}.layout={own}"], [f"{each}_x" for each in layout[own]]
    fails = str(random.choice(["stuck_off", "stuck_on", ""], p=[0.2, 0.2, 0.6]))
    given += [
        f"{section}.modulator={random.choice(['sigma_delta', 'pulse_width', 'pwpf'])}",
        f"{section}.frame={frame}",
        f"{section}.minimum_on_time={round(0.01 * frame * random.uniform(), 4)}",
        f"{section}.threshold={random.uniform(0.5, 0.99):.3f}",
        f"{section}.rise_time={random.choice([0.0, 0.004])}",
        f"{section}.fall_time={random.choice([0.0, 0.006])}",
        *([f"{section}.failures={{{names[-1]}: {fails}}}"] if fails and own != "units" else []),
        f"actuation.delay={random.integers(2)}",
        f"sensing.velocity_noise.base_position={random.choice([0.001, 0.01])}",
    ]
    span = random.choice(["", ", duration: 0.07", ", duration: 0.03, period: 0.1"])
    event = "unit: thrusters.{}, kind: {}, time: [0.0, 0.2]" + span
    fault = f"faults.events={{{{one: {{{{{event}}}}}}}}}"
    kinds = random.choice(["stuck_on", "stuck_off", "leaking", "weak"], size=3)
    breaks = random.random() < 0.5
    each = []
    for k, kind in enumerate(kinds):
        changes = [f"disturbance.amplitude_scale={k}", f"payload.truth.mass={90 + 10 * k}"]
        each.append([*changes, *([fault.format(names[0], kind)] if breaks else [])])
    return name, given, each


def units(random):
    """Twelve to sixteen thrusters of drawn places and specific impulses, which give any wrench."""
    wrenches = None
    while wrenches is None or lost_direction(wrenches) is not None:
        places, along = np.round(random.uniform(-1.0, 1.0, size=(2, random.integers(12, 17), 3)), 3)
        wrenches = np.vstack([np.cross(places, along).T, along.T])
    own = (
        f"u_{k}: {{position: {place}, direction: {way}, force: {random.uniform(2, 40):.2f}, "
        f"specific_impulse: {random.choice([220.0, 225.0, 227.0])}}}"
        for k, (place, way) in enumerate(zip(places.tolist(), along.tolist(), strict=True))
    )
    return f"{{{', '.join(own)}}}"


@pytest.mark.long
@pytest.mark.parametrize("seed", range(DRAWS))
def test_drawn_thrusters_have_the_pulses_of_drake(seed):
    """Only pulse widths depend on the digits of Drake's linear program, with a tolerance of 1e-7
    of its bounds. Runs that they move too far are Drake's.
    """
    random = np.random.default_rng(seed)
    name, given, each = thrusters(random)
    scenarios = of_seeds(name, ["duration=0.5", f"controller={random.choice(LAWS)}", *given], each)
    found = simulate_many(scenarios, engine="compiled")
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert record.outcome == other.outcome
        is_wide = "actuation.thrusters.modulator=pulse_width" in given
        assert record.engine == "compiled" or is_wide
        for each_name, values in other.dataset.data_vars.items():
            if values.dtype == float:
                bound = (1e-4 if is_wide else 1e-6) * max(1.0, float(np.abs(values).max()))
                difference = np.abs(record.dataset[each_name].values - values.values).max()
                assert difference < bound, each_name


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "law"),
    [
        *(("thrusters_only", law) for law in ("tdc", "tde_aismc", "computed_torque")),
        *(("thrusters_and_wheels", law) for law in ("tdc", "asmc", "computed_torque", "pd_plus")),
    ],
)
def test_no_pulse_moves(name, law):
    """In whole runs."""
    check(of_seeds(name, [f"controller={law}"], DRAWS * [[]]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(DRAWS))
def test_the_compiled_allocation_is_that_of_the_tables(seed):
    """Wrenches of all sizes and kinds; the linear program has its solver's tolerance."""
    random = np.random.default_rng(seed)
    name, given, _ = thrusters(random)
    scenario = load_scenario(name, [*given, "actuation.thrusters.modulator=sigma_delta"])
    own = ThrusterSet(allocated(scenario).thrusters, sample_time=scenario.sample_time)
    memory, n = own.initial_memory(), len(own.names)
    tape = Tape()
    made = own.allocate(inputs(tape, "wrench", (6,)), memory)
    row = [*made["wanted"], *made["given"]]
    run = of_copies(text_of_traced(registers(), tape, {"wrench": 6}, row), registers(), 1, n + 1)
    wrenches = random.normal(size=(200, 6)) * 10.0 ** random.uniform(-2, 3, size=(200, 1))
    wrenches[::3, :3] = 0.0
    wrenches[::7, 3:] = 0.0
    wrenches[1::5] = wrenches[1::5].round()
    found = run(wrenches)
    expected = [own.allocate(wrench, memory) for wrench in wrenches]
    wanted = np.array([each["wanted"] for each in expected])
    part = np.array([each["given"] for each in expected])
    np.testing.assert_allclose(found[:, n:], part, atol=1e-9)
    largest = own.force.max()
    is_whole = (part == 1.0).all(axis=1) & (wanted < 0.999 * own.force).all(axis=1)
    assert 20 < is_whole.sum() < 180
    np.testing.assert_allclose(found[is_whole, :n], wanted[is_whole], atol=1e-11 * largest)
    np.testing.assert_allclose(found[:, :n], wanted, atol=1e-5 * largest)


@pytest.mark.parametrize("seed", range(3))
def test_faults_of_many_samples_are_those_of_each(seed):
    random, names = np.random.default_rng(seed), ["a_x", "b_y", "c_z"]
    kinds = ["stuck_on", "stuck_off", "leaking", "weak"]
    spans = ["", ", duration: 0.07", ", duration: 0.03, period: 0.1"]
    events = [
        f"e{k}: {{unit: thrusters.{random.choice(names)}, kind: {random.choice(kinds)}, "
        f"time: {random.uniform(0, 0.3):.3f}{random.choice(spans)}}}"
        for k in range(random.integers(1, 4))
    ]
    scenario = load_scenario(
        "thrusters_and_wheels", ["duration=0.5", f"faults.events={{{', '.join(events)}}}"]
    )
    (block,), _ = acting_blocks(scenario, coordinates_of(make_plant(scenario.model)))
    rows = phases_of(block, 50, place="thrusters")
    assert len(np.unique(rows[:, 1:], axis=0)) > 1
    np.testing.assert_array_equal(rows, [block.phase(sample) for sample in range(50)])
