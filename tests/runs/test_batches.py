"""Runs side by side: each has the bits that it has alone, whatever the others do."""

import dataclasses
import itertools
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder, FirstOrderLowPassFilter, RandomSource

from ffsm_drake import (
    BlockError,
    ScenarioError,
    load_scenario,
    make_closed_loop,
    override_scenario,
    simulate,
    simulate_many,
)
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.batches import batches_of, usual_batch
from ffsm_drake.runs.rollout import Rollout, make_rollout
from ffsm_drake.scenario import Scenario, scenario_to_dict
from ffsm_drake.scenario.layers import flatten
from ffsm_drake.systems.controllers import ControlLaw
from ffsm_drake.systems.controllers.law import is_wide
from ffsm_drake.systems.controllers.pd_plus import PdPlus
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.side_by_side import SideBySide

SHORT = "duration=0.3"
LAB = "lab_of_batches"  # the module of users' blocks
ORBIT = (
    "environment={altitude: 7.0e5, gravity_gradient: true, tidal: true, hill_rpy: [0.1, 0.2, 0.3],"
    " solar_pressure: {area: 10.0, center_of_pressure: [0.1, 0.2, 0.3], sun: [1, 1, 0]}}"
)
DRIFT = (
    "sensing.velocity_bias_walk={joints: 1e-6}",
    "sensing.position_correlated_noise={all: 1e-6}",
)
NOISE = "sensing.position_noise={all: 1e-6}"
ALL_DRIVEN = ("reference.frame=null", "actuation.driven=[all]")
COUPLED = ("estimator.kind=coupled", "estimator.force_walk={all: 1.0}", NOISE)
# Overrides of a scenario for which every block is one for all copies.
WIDE = {
    "bias": ("postcapture", "sensing.position_bias={base_rotation: 1e-4, joints: 1e-5}"),
    "drift": ("postcapture", *DRIFT),
    "in the base's axes": (
        "flight_sensors",
        "sensing.velocity_bias={all: 1e-4}",
        "sensing.velocity_bias_walk={base_rotation: 1e-6}",
        "sensing.velocity_noise={all: 1e-5, base_rotation_z: 1e-4}",
        "sensing.velocity_quantization={base_position: 1e-5}",
        "estimator.velocity_bias_walk={base_rotation: 1e-6, joints: 1e-6}",
    ),
    "coupled biases": (
        "flight_sensors",
        "estimator.kind=coupled",
        "sensing.position_bias={base_position_x: 1e-3}",
        "estimator.velocity_bias_walk={all: 1e-6}",
    ),
    "late": ("slow_navigation", "actuation.limit={}"),
    "coupled": ("postcapture", *COUPLED),
    "tvlqr": ("postcapture", "controller=tvlqr"),
    "torque": ("postcapture", "controller=torque_against_momentum"),
    "reduced": ("free_floating", "controller=tde_aismc"),
    "reduced torque": ("free_floating", "controller=computed_torque"),
    "task": ("free_floating",),
    "task torque": ("free_floating", "controller=task_computed_torque"),
    "task, no path": ("free_floating", "controller=task_computed_torque", *ALL_DRIVEN),
    "task rate": ("free_floating", "controller=resolved_rate"),
    "task, kalman": ("free_floating", "estimator.kind=kalman", NOISE),
    "task, coupled": ("free_floating", *COUPLED),
    "task, late": ("slow_navigation", "controller=task_time_delay", "actuation.limit={}"),
    "reaction": ("reaction_null",),
}
SETTLING = ("tdc", "asmc", "aismc", "tde_aismc", "pd_plus", "computed_torque")


def assert_equal(record, alone):
    """The same bits in every variable, and all else that a run gives."""
    assert set(record.dataset.variables) == set(alone.dataset.variables)
    for name, variable in alone.dataset.variables.items():
        np.testing.assert_array_equal(record.dataset[name].values, variable.values, err_msg=name)
    assert record.outcome == alone.outcome
    assert record.metrics == alone.metrics
    assert record.parts == alone.parts
    assert record.scenario.random_seed == alone.scenario.random_seed


def alone(scenario):
    return simulate(scenario, check_stability=False)


def run_once(scenarios):
    """The logs of a new rollout, which is freed: Drake would keep it."""
    rollout = make_rollout(scenarios)
    try:
        return rollout.run_all() if isinstance(scenarios, list) else rollout.run()
    finally:
        rollout.release()


def varied(scenario, number):
    """Another seed, payload, guess of it, initial velocity, gain, disturbance and noise."""
    payload, share = scenario.payload, 0.01 * (number % 7)
    noise = {key: value * (1.0 + share) for key, value in scenario.sensing.velocity_noise.items()}
    gains = {**scenario.controllers.get(scenario.controller, {})}
    if "k_d" in gains:
        gains["k_d"] = {"all": gains["k_d"]} if not isinstance(gains["k_d"], dict) else gains["k_d"]
        gains["k_d"] = {name: value * (1.0 + share) for name, value in gains["k_d"].items()}
    return dataclasses.replace(
        scenario,
        random_seed=number,
        payload=dataclasses.replace(
            payload,
            truth=dataclasses.replace(payload.truth, mass=payload.truth.mass * (1.0 + share)),
            nominal=dataclasses.replace(payload.nominal, mass=payload.nominal.mass * (1.0 - share)),
        ),
        initial_velocity={"joints": 1e-3 * number},
        controllers={**scenario.controllers, scenario.controller: gains},
        disturbance=dataclasses.replace(scenario.disturbance, amplitude_scale=1.0 + share),
        sensing=dataclasses.replace(scenario.sensing, velocity_noise=noise),
    )


def check_side_by_side(scenario, count, *, batches):
    scenarios = [varied(scenario, number) for number in range(count)]
    expected = [alone(each) for each in scenarios]
    for batch in batches:
        for indices in batches_of(scenarios, batch):
            assert len(indices) == batch or len(scenarios) % batch
            rollout = Rollout([scenarios[index] for index in indices])
            rollout.check()  # an error here would make them run alone
            rollout.release()
        for record, each in zip(simulate_many(scenarios, batch=batch), expected, strict=True):
            assert_equal(record, each)


def check_wide(scenarios):
    """No block stands once for each copy, and every run has the bits it has alone."""
    rollout = Rollout(scenarios)
    assert not [n for n, block in rollout.loop.blocks.items() if isinstance(block, SideBySide)]
    logs = rollout.run_all()
    rollout.release()
    for log, scenario in zip(logs, scenarios, strict=True):
        own = run_once(scenario)
        assert set(log.series) == set(own.series)
        for name, values in own.series.items():
            np.testing.assert_array_equal(log.series[name], values, err_msg=name)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if kind == "reduced" else pytest.mark.long)
        for kind in WIDE
    ],
)
def test_blocks_of_all_copies_have_their_bits(kind):
    name, *overrides = WIDE[kind]
    scenario = load_scenario(name, ["duration=0.1", *overrides])
    check_wide([varied(scenario, number) for number in range(3)])


small = st.floats(-1e-4, 1e-4)
errors = st.fixed_dictionaries(
    {
        "position_bias": st.fixed_dictionaries({"base_rotation": small, "joint_1": small}),
        "velocity_bias": st.fixed_dictionaries({"base_rotation": small, "base_position_x": small}),
        "velocity_bias_walk": st.fixed_dictionaries({"base_rotation": st.floats(1e-9, 1e-5)}),
        "velocity_correlated_noise": st.fixed_dictionaries({"joints": st.floats(1e-9, 1e-6)}),
        "correlation_time": st.fixed_dictionaries({"all": st.floats(0.01, 10.0)}),
        "position_noise": st.fixed_dictionaries({"all": st.floats(0.0, 1e-6)}),
    }
)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(each=st.lists(errors, min_size=2, max_size=4), delay=st.integers(0, 3))
def test_sensors_of_all_copies_have_their_bits(each, delay):
    scenario = load_scenario("postcapture", ["duration=0.1", "controller=pd_plus"])
    check_wide(
        [
            dataclasses.replace(
                scenario,
                random_seed=seed,
                sensing=dataclasses.replace(scenario.sensing, delay=delay, **given_errors),
            )
            for seed, given_errors in enumerate(each)
        ]
    )


@pytest.mark.smoke
@pytest.mark.parametrize("controller", SETTLING)
def test_every_law_has_its_bits(controller):
    check_side_by_side(
        load_scenario("postcapture", [SHORT, f"controller={controller}"]), 4, batches=(4,)
    )


@pytest.mark.parametrize(
    "name",
    [
        "flight_sensors",
        "flexible_panels",
        "slow_navigation",
        "seven_joint",
        "planar_detumble",
        "paper",
        "thrusters_and_wheels",
        pytest.param("thrusters_only", marks=pytest.mark.long),
        pytest.param("free_floating", marks=pytest.mark.long),
        pytest.param("reaction_null", marks=pytest.mark.long),
    ],
)
def test_every_shipped_scenario_has_its_bits(name):
    scenario = load_scenario(name, ["duration=0.2"])
    scenarios = [dataclasses.replace(scenario, random_seed=seed) for seed in range(3)]
    assert batches_of(scenarios, 3) == [[0, 1, 2]]
    assert None not in run_once(scenarios)
    for record, each in zip(simulate_many(scenarios, batch=3), scenarios, strict=True):
        assert_equal(record, alone(each))


LONG_RUNS = [
    *(("postcapture", controller) for controller in SETTLING),
    *(("flight_sensors", controller) for controller in SETTLING[:4]),
    *(("flexible_panels", controller) for controller in SETTLING[:4]),
    *(("seven_joint", controller) for controller in ("tdc", "tde_aismc")),
    *(("slow_navigation", controller) for controller in ("tdc", "tde_aismc")),
    ("thrusters_and_wheels", "tdc"),
    ("free_floating", "tdc"),
]
ON_EACH_CHANGE = [("flight_sensors", "tdc")]


@pytest.mark.parametrize(
    ("name", "controller"),
    [
        pytest.param(*each, marks=pytest.mark.slow if each in ON_EACH_CHANGE else pytest.mark.long)
        for each in LONG_RUNS
    ],
)
def test_long_runs_have_their_bits(name, controller):
    scenario = load_scenario(name, ["duration=4", f"controller={controller}"])
    check_side_by_side(scenario, 16, batches=(4, 16))


@pytest.mark.long
def test_batches_of_one_have_their_bits():
    check_side_by_side(load_scenario("flight_sensors", ["duration=4"]), 4, batches=(1,))


@pytest.mark.parametrize(
    "scheme", ["explicit_euler", "semi_explicit_euler", "runge_kutta2", "runge_kutta5"]
)
def test_every_explicit_scheme_has_its_bits(scheme):
    scenario = load_scenario(
        "postcapture",
        [
            SHORT,
            f"simulator_config.integration_scheme={scheme}",
            "simulator_config.max_step_size=0.005",
        ],
    )
    assert batches_of([scenario] * 3, 3) == [[0, 1, 2]]
    check_side_by_side(scenario, 3, batches=(3,))


KINDS = {
    "plain": (),
    "kalman": ("estimator.kind=kalman", "sensing.position_noise=1e-6"),
    "asmc": ("controller=asmc",),
    "longer": ("duration=0.25",),
    "quantised": ("sensing.position_quantization={joints: 1e-5}",),
    "biased": ("sensing.velocity_bias={joints: 1e-5}",),
    "drifting": ("sensing.velocity_bias_walk={joints: 1e-6}",),
    "late": ("sensing.delay=1", "controller=tdc"),
    "diverging": ("controllers.tde_aismc.k_s_initial=400", "controllers.tde_aismc.k_s_max=null"),
    "error control": ("simulator_config.use_error_control=true",),
}


@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(
    kinds=st.lists(
        st.tuples(st.sampled_from(sorted(KINDS)), st.integers(0, 20)), min_size=1, max_size=8
    ),
    batch=st.integers(1, 5),
)
def test_mixed_lists_come_back_in_order_with_their_bits(kinds, batch):
    scenarios = [
        varied(load_scenario("postcapture", ["duration=0.15", *KINDS[kind]]), number)
        for kind, number in kinds
    ]
    places = sorted(itertools.chain(*batches_of(scenarios, batch)))
    assert places == list(range(len(scenarios)))
    for record, each in zip(simulate_many(scenarios, batch=batch), scenarios, strict=True):
        assert_equal(record, alone(each))


@pytest.mark.slow
@pytest.mark.parametrize("others", [(), DRIFT])
def test_a_run_that_diverges_leaves_the_others_alone(others):
    wild = ("controllers.tde_aismc.k_s_initial=400", "controllers.tde_aismc.k_s_max=null")
    tame, diverging = (
        load_scenario("postcapture", ["duration=1.5", *others, *more]) for more in ((), wild)
    )
    scenarios = [varied(tame, 0), varied(diverging, 1), varied(tame, 2), varied(diverging, 3)]
    logs = run_once(scenarios)
    assert [log.outcome.status for log in logs] == ["completed", "diverged"] * 2
    records = simulate_many(scenarios, batch=4)
    assert [record.outcome.status for record in records] == ["completed", "diverged"] * 2
    for record, each in zip(records, scenarios, strict=True):
        assert_equal(record, alone(each))


def test_a_copy_that_is_too_fast_for_one_step_diverges():
    calm = load_scenario("postcapture", ["duration=0.1"])
    speeds = np.abs(run_once(calm).series["state"][:, 12:]).max(axis=1)
    others, fastest = np.sort(speeds)[-2:]
    assert speeds[1] == fastest > 1.5 * others  # the disturbance's step, from rest
    tight = dataclasses.replace(calm, divergence_speed=float(0.5 * (others + fastest)))
    logs = run_once([calm, tight, dataclasses.replace(calm, random_seed=1)])
    assert [log.outcome.status for log in logs] == ["completed", "diverged", "completed"]
    assert logs[1].outcome == alone(tight).outcome


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(
    kinds=st.lists(st.integers(0, 2), min_size=2, max_size=5),
    name=st.sampled_from(["postcapture", "seven_joint"]),
)
def test_equal_disturbances_are_computed_once_with_their_bits(kinds, name):
    base = load_scenario(name, ["duration=0.05"])
    scenarios = [
        dataclasses.replace(
            base,
            random_seed=seed,
            disturbance=dataclasses.replace(base.disturbance, frequency_scale=1.0 + 0.3 * kind),
        )
        for seed, kind in enumerate(kinds)
    ]
    for log, each in zip(run_once(scenarios), scenarios, strict=True):
        own = run_once(each).series
        np.testing.assert_array_equal(log.series["disturbance_force"], own["disturbance_force"])


def test_runs_that_all_diverge_stop():
    scenario = load_scenario(
        "postcapture",
        [
            "duration=300",
            "controllers.tde_aismc.k_s_initial=400",
            "controllers.tde_aismc.k_s_max=null",
        ],
    )
    records = simulate_many([scenario, dataclasses.replace(scenario, random_seed=1)], batch=2)
    assert [record.outcome.status for record in records] == ["diverged"] * 2


class Fragile(ControlLaw):
    """Raises where the run's seed says so; commands nothing."""

    def __init__(self, seed):
        self._seed = seed

    def step(self, sample, state):
        if self._seed == 2:
            raise ZeroDivisionError("by zero")
        return np.zeros_like(sample.v), state

    @classmethod
    def from_setup(cls, setup):
        return cls(setup.scenario.random_seed)


class Drag(LeafSystem):
    """A user's force with memory and noise of its own."""

    def __init__(self, setup):
        super().__init__()
        size = len(setup.coordinates.names)
        self._state = self.DeclareVectorInputPort("state", 2 * size + 1)
        self.DeclareVectorOutputPort("generalized_force", size, self._calc)

    def _calc(self, context, output):
        state = self._state.Eval(context)
        output.SetFromVector(-0.5 * state[len(state) // 2 + 1 :])


class Spring(Drag):
    """A user's force with a number of its own."""

    def __init__(self, setup):
        self._pull = setup.settings["pull"]
        super().__init__(setup)

    def _calc(self, context, output):
        state = self._state.Eval(context)
        output.SetFromVector(-self._pull * state[-output.size() :])


def noisy_drag(setup):
    """A force that draws numbers and has continuous state."""
    size, builder = len(setup.coordinates.names), DiagramBuilder()
    drag = builder.AddSystem(Drag(setup))
    noise = builder.AddSystem(
        RandomSource(RandomDistribution.kGaussian, num_outputs=size, sampling_interval_sec=0.02)
    )
    smooth = builder.AddSystem(FirstOrderLowPassFilter(0.1, size))
    both = builder.AddSystem(Adder(2, size))
    builder.Connect(noise.get_output_port(), smooth.get_input_port())
    builder.Connect(drag.get_output_port(), both.get_input_port(0))
    builder.Connect(smooth.get_output_port(), both.get_input_port(1))
    builder.ExportInput(drag.get_input_port(), "state")
    builder.ExportOutput(both.get_output_port(), "generalized_force")
    return builder.Build()


@pytest.fixture(scope="module", autouse=True)
def lab():
    module = types.ModuleType(LAB)
    module.Fragile, module.noisy_drag, module.Spring = Fragile, noisy_drag, Spring
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, LAB, module)
        yield LAB


def test_systems_of_a_user_go_side_by_side(lab):
    scenario = load_scenario(
        "postcapture",
        [SHORT, f"blocks.forces.drag={lab}:noisy_drag", "sensing.position_noise=1e-7"],
    )
    assert batches_of([scenario] * 4, 4) == [[0, 1, 2, 3]]
    check_side_by_side(scenario, 4, batches=(4,))


def test_an_exception_is_that_of_its_run(lab):
    scenario = load_scenario("postcapture", [SHORT, f"controller={lab}:Fragile"])
    scenarios = [dataclasses.replace(scenario, random_seed=seed) for seed in range(4)]
    results = simulate_many(scenarios, batch=4, keep_errors=True)
    assert [isinstance(result, BlockError) for result in results] == [False, False, True, False]
    for seed in (0, 1, 3):
        assert_equal(results[seed], alone(scenarios[seed]))
    with pytest.raises(BlockError, match="by zero") as raised:
        simulate_many(scenarios, batch=4)
    assert raised.value.__notes__ == ["in run 2 of 4"]


def test_a_scenario_that_cannot_be_built_fails_alone():
    good = load_scenario("postcapture", [SHORT])
    bad = dataclasses.replace(good, initial_velocity={"no_such_joint": 1e-3})
    first, second, third = simulate_many([good, bad, good], batch=3, keep_errors=True)
    assert isinstance(second, ScenarioError)
    assert_equal(first, alone(good))
    assert_equal(third, alone(good))


def test_error_control_implicit_schemes_and_captures_run_alone():
    controlled = load_scenario("postcapture", ["simulator_config.use_error_control=true"])
    implicit = load_scenario("postcapture", ["simulator_config.integration_scheme=implicit_euler"])
    captured = load_scenario("tumbling_capture", [SHORT, "capture.approach=null"])
    for scenario in (controlled, implicit, captured):
        assert batches_of([scenario, scenario], 16) == [[0], [1]]


def test_batches_are_even_and_hold_runs_of_one_length():
    short, long = load_scenario("postcapture", [SHORT]), load_scenario("postcapture")
    assert batches_of([short] * 5 + [long] * 2, 4) == [[0, 1, 2], [3, 4], [5, 6]]
    assert batches_of([short] * 2, 1) == [[0], [1]]
    assert 4 <= usual_batch() <= 24


def test_ports_of_a_wide_loop_hold_copy_after_copy():
    scenario = load_scenario("flexible_panels", [SHORT])
    single, wide = make_closed_loop(scenario), make_closed_loop([scenario] * 3)
    assert set(single.sources) == set(wide.sources)
    for signal in single.sources:
        assert wide.output_port(signal).size() == 3 * single.output_port(signal).size()
    assert isinstance(wide.blocks["controller"], SampledController)
    rows = np.arange(3.0 * single.plant.num_multibody_states()).reshape(3, -1)
    np.testing.assert_array_equal(wide.copies.rows(wide.copies.whole(rows)), rows)


def test_a_law_that_inherits_a_wide_one_is_not_wide():
    class Own(PdPlus):
        """Another step."""

    assert PdPlus.wide
    assert not is_wide(object.__new__(Own))
    assert is_wide(object.__new__(PdPlus))


DRIVES = (
    "actuation.limit={joints: 40}",
    "actuation.drives={rate_limit: {all: 1}, coulomb_friction: {joints: 0.01}}",
    "actuation.delay=1",
)
FLEXIBLE = (
    "model.flexible.beam={kind: beam, position: [0, 0, 1], direction: [0, 0, 1], mass: 1, "
    "frequencies: [0.5, 2]}",
    "model.flexible.slosh={kind: mass, mass: 1, frequency: 0.4}",
    "model.flexible.tank={kind: pendulum, mass: 1, length: 0.3, frequency: 0.4}",
)
FILTERED = ("command_filter={low_pass: 20, notch: 5}", "reference.shaper={frequencies: [3.0]}")
# Scenarios of which one value is changed, on every kind of block.
BASES = {
    "plain": ("postcapture", *FILTERED),
    "coupled": ("postcapture", *COUPLED),
    "drives": ("postcapture", "controller=tdc", *DRIVES),
    "wheels": ("thrusters_and_wheels",),
    "slow": ("slow_navigation",),
    "flexible": ("flexible_panels", *FLEXIBLE),
    "frame": ("free_floating",),
    "user's": (
        "postcapture",
        f"blocks.forces.own={{system: '{LAB}:Spring', settings: {{pull: 0.5}}}}",
    ),
}
WORDS = {  # of settings that are a choice, by their last name
    "kind": ("kalman", "one_sample", "coupled", "zvd", "beam", "pendulum", "quintic"),
    "base_rotation": ("rpy", "eigenaxis"),
    "controller": ("tdc", "asmc", "pd_plus", "computed_torque"),
    "integration_scheme": ("runge_kutta2", "explicit_euler"),
    "modulator": ("pulse_width", "pwpf"),
    "task": ("position", "attitude"),
    "servicer": ("rest", "track_all"),
    "joints": ("braked",),
}
# What may be none, as something.
GIVEN = (0.02, 3, {"all": 30.0}, {}, {"joints": 5.0})


def others_of(key, value):
    """Values that may stand in the place of one."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, max(value - 1, 0)]
    if isinstance(value, float):
        return [1.1 * value, 0.0, 0.01, 1.0]
    if isinstance(value, list):
        return [[1.1 * item for item in value], []] if value and value[0] != str(value[0]) else []
    if value is None:
        return list(GIVEN)
    return [*WORDS.get(key.rpartition(".")[2], ()), "another", None]


def changes_of(base):
    """Every value of a scenario with others in its place, as overrides."""
    for key, value in flatten(scenario_to_dict(base)).items():
        for other in others_of(key, value):
            yield f"{key}={yaml.safe_dump(other, default_flow_style=True).partition(chr(10))[0]}"


def check_together_or_apart(base, change):
    """Whether two runs that differ by an override go side by side; then they have their bits. None:
    the override cannot be used.
    """
    try:
        scenarios = [base, override_scenario(base, [change])]
        own = [run_once(each) for each in scenarios]
    except FfsmError:
        return None
    if batches_of(scenarios, 2) != [[0, 1]]:
        return False
    for log, alone_log in zip(run_once(scenarios), own, strict=True):
        assert (log is None) <= (alone_log.outcome.status != "completed"), change
        if log is not None:
            assert log.scenario == alone_log.scenario
            assert set(log.series) == set(alone_log.series), change
            for name, values in alone_log.series.items():
                np.testing.assert_array_equal(log.series[name], values, err_msg=change)
    return True


def base_of(kind):
    name, *overrides = BASES[kind]
    return load_scenario(name, ["duration=0.06", *overrides])


@pytest.mark.slow
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(kind=st.sampled_from(sorted(BASES)), data=st.data())
def test_runs_that_differ_in_any_value_go_side_by_side_or_apart(kind, data):
    base = base_of(kind)
    change = data.draw(st.sampled_from(list(changes_of(base))))
    assume(check_together_or_apart(base, change) is not None)


# Values of each kind of block that make no other diagram.
@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("plain", "command_filter.low_pass=10"),
        ("drives", "actuation.limit={joints: 30}"),
        ("drives", "actuation.drives.coulomb_friction={joints: 0.02}"),
        ("flexible", "model.flexible.port.frequency=0.3"),
        ("flexible", "model.flexible.tank={frequency: null, stiffness: 1.0}"),
        ("flexible", "model.flexible.port.damping_ratio=0.01"),
        pytest.param("wheels", "actuation.wheels.desaturation_time=5", marks=pytest.mark.slow),
        ("user's", "blocks.forces.own.settings.pull=0.2"),
    ],
)
def test_runs_that_differ_in_numbers_go_side_by_side(kind, change):
    base = base_of(kind)
    run_once(override_scenario(base, [change]))  # an override that can be used
    assert check_together_or_apart(base, change)


def test_every_section_is_in_the_docs():
    page = (Path(__file__).parents[2] / "docs" / "many_runs.md").read_text(encoding="utf-8")
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    told = re.findall(r"`(\w+)`", " ".join(rows))
    assert set(scenario_to_dict(Scenario())) <= set(told)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", BASES)
def test_every_value_of_a_scenario(kind):
    base = base_of(kind)
    found = [check_together_or_apart(base, change) for change in changes_of(base)]
    assert found.count(True) > 200
    assert found.count(False) > 30
