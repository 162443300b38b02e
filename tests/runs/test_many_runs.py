"""Many runs: each has the bits that it has alone, whatever ran before it."""

import dataclasses
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common import RandomDistribution
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Adder, FirstOrderLowPassFilter, RandomSource

from ffsm_drake import BlockError, ScenarioError, load_scenario, simulate, simulate_many
from ffsm_drake.runs.batches import usual_batch
from ffsm_drake.runs.engine import Engine
from ffsm_drake.systems.controllers import ControlLaw

SHORT = "duration=0.3"
LAB = "lab_of_many_runs"  # the module of users' blocks
WILD = ("controllers.tde_aismc.k_s_initial=400", "controllers.tde_aismc.k_s_max=null")
KINDS = {
    "plain": (),
    "another law": ("controller=tdc",),
    "slow": ("sample_time=0.02",),
    "drift": ("sensing.velocity_bias_walk={joints: 1e-6}",),
    "posture": ("initial_posture.joints.joint_1=0.3",),
    "limit": ("actuation.limit={joints: 4.0}",),
    "error control": ("simulator_config.use_error_control=true",),
    "orbit": ("environment={altitude: 7.0e5, gravity_gradient: true}",),
    "faults": ("faults.events={one: {unit: sensing.joint_1, kind: frozen, time: [0.05]}}",),
    "user's": (f"blocks.forces.drag={LAB}:noisy_drag",),
    "user's number": ("blocks.forces.spring={system: " + LAB + ":Spring, settings: {pull: 3.0}}",),
}


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


def varied(scenario, number):
    """Another seed, payload, guess of it, initial velocity and disturbance."""
    payload, share = scenario.payload, 0.01 * (number % 7)
    return dataclasses.replace(
        scenario,
        random_seed=number,
        payload=dataclasses.replace(
            payload,
            truth=dataclasses.replace(payload.truth, mass=payload.truth.mass * (1.0 + share)),
            nominal=dataclasses.replace(payload.nominal, mass=payload.nominal.mass * (1.0 - share)),
        ),
        initial_velocity={"joints": 1e-3 * number},
        disturbance=dataclasses.replace(scenario.disturbance, amplitude_scale=1.0 + share),
    )


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
    """A user's force."""

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
        self._pull = setup.settings["pull"] * (1.0 + setup.scenario.random_seed)
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


def check_in_order(kinds):
    scenarios = [
        varied(load_scenario("postcapture", ["duration=0.1", *KINDS[kind]]), number)
        for kind, number in kinds
    ]
    for record, each in zip(simulate_many(scenarios), scenarios, strict=True):
        assert_equal(record, alone(each))


def test_runs_that_share_a_loop_have_their_bits():
    """The third is run in the loop of the first two, the fourth in another."""
    check_in_order([("plain", 1), ("plain", 2), ("plain", 1), ("drift", 1), ("plain", 3)])


@pytest.mark.long
@settings(max_examples=12, deadline=None)
@given(
    kinds=st.lists(
        st.tuples(st.sampled_from(sorted(KINDS)), st.integers(0, 20)), min_size=1, max_size=8
    )
)
def test_mixed_lists_come_back_in_order_with_their_bits(kinds):
    check_in_order(kinds)


def test_a_run_that_diverges_leaves_the_others_alone():
    tame, diverging = (load_scenario("postcapture", ["duration=1", *more]) for more in ((), WILD))
    scenarios = [varied(tame, 0), varied(diverging, 1), varied(diverging, 3), varied(tame, 2)]
    records = simulate_many(scenarios)
    assert [record.outcome.status for record in records] == [
        "completed", "diverged", "diverged", "completed",
    ]  # fmt: skip
    for record, each in zip(records, scenarios, strict=True):
        assert_equal(record, alone(each))


def test_an_exception_is_that_of_its_run(lab):
    scenario = load_scenario("postcapture", [SHORT, f"controller={lab}:Fragile"])
    scenarios = [dataclasses.replace(scenario, random_seed=seed) for seed in range(4)]
    results = simulate_many(scenarios, keep_errors=True)
    assert [isinstance(result, BlockError) for result in results] == [False, False, True, False]
    for seed in (0, 1, 3):
        assert_equal(results[seed], alone(scenarios[seed]))
    with pytest.raises(BlockError, match="by zero") as raised:
        simulate_many(scenarios)
    assert raised.value.__notes__ == ["in run 2 of 4"]


def test_a_scenario_that_cannot_be_built_fails_alone():
    good = load_scenario("postcapture", [SHORT])
    bad = dataclasses.replace(good, initial_velocity={"no_such_joint": 1e-3})
    first, second, third = simulate_many([good, bad, good], keep_errors=True)
    assert isinstance(second, ScenarioError)
    assert_equal(first, alone(good))
    assert_equal(third, alone(good))


def test_the_logs_of_runs_at_once_fit_into_memory():
    engine = Engine()
    assert usual_batch() == 1
    assert usual_batch(engine) == engine.batch
    assert usual_batch(engine, samples=10**7) < engine.batch
