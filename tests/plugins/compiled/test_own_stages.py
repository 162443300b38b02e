"""Users' stages of sensing in compiled runs."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from compared_runs import check
from own_stage import Mean, Pull

from ffsm_drake import BlockError, load_scenario, make_closed_loop, simulate_many


def scenarios(system, given=()):
    stage = "blocks.sensing.own.system=" + system
    return [
        load_scenario("postcapture", ["duration=0.3", f"random_seed={k}", stage, *given])
        for k in range(2)
    ]


@pytest.mark.parametrize(
    "given",
    [
        (),
        pytest.param(
            ("controller=pd_plus", "sensing.velocity_bias=1e-4", "sensing.velocity_period=2"),
            marks=pytest.mark.slow,
        ),
        pytest.param(("controller=tdc", "estimator.kind=kalman"), marks=pytest.mark.slow),
    ],
)
def test_a_stage_of_a_user_joins_by_itself(given):
    for record in check(scenarios("own_stage:Mean", given)):
        assert record.engine == "compiled"


class Branching(Mean):
    """Its phase takes one sample, and depends on it by a branch."""

    def start(self, state=None):  # in another order
        own = {"unused": np.zeros(2), **super().start(state)}
        return own if state is None else dict(reversed(own.items()))

    def phase(self, sample):
        return [1.0 if sample >= self.begin else 0.0]

    def step(self, inputs, memory, now):
        outputs, after = super().step(inputs, memory, now)
        return outputs, {**memory, **after}


@pytest.mark.slow
def test_a_phase_takes_one_sample_and_names_of_memory_have_no_order():
    (record, _) = check(scenarios("test_own_stages:Branching"))
    assert record.engine == "compiled"


@dataclass(frozen=True, kw_only=True)
class Often(Pull):
    per_sample = 4


@pytest.mark.slow
def test_a_force_can_step_several_times_in_a_sample():
    def of(name, *given):
        block = f"blocks.forces.own.system={name}"
        return load_scenario("postcapture", ["duration=0.1", "random_seed=1", block, *given])

    (record,) = check([of("test_own_stages:Often", "simulator_config.max_step_size=0.00125")])
    assert record.engine == "compiled"
    (other,) = simulate_many([of("own_stage:Pull")])
    own, once = (each.dataset["force_own"].values for each in (record, other))
    assert np.abs(own - once).max() > 1e-9
    uneven = of("test_own_stages:Often", "simulator_config.max_step_size=0.002")
    (record,) = simulate_many([uneven], engine="compiled")
    assert record.engine == "drake (not covered: steps that do not divide a sample)"


@dataclass(frozen=True, kw_only=True)
class Phased(Often):
    def phase(self, sample):
        return [sample]


@dataclass(frozen=True, kw_only=True)
class Oftener(Pull):
    per_sample = 5


@pytest.mark.parametrize("names", [("Often", "Oftener"), ("Phased",)])
def test_forces_with_other_instants_are_not_compiled(names):
    blocks = [f"blocks.forces.{each}.system=test_own_stages:{each}" for each in names]
    run = load_scenario("postcapture", ["duration=0.05", *blocks])
    (record,) = simulate_many([run], engine="compiled")
    assert record.outcome.completed
    assert record.engine.startswith("drake (not covered: ")
    assert ("4 and 5 times" if len(names) == 2 else "phase of a force") in record.engine


@pytest.mark.parametrize("value", [-1, 2.5, "4", 10**9, None])
@pytest.mark.parametrize("place", ["forces", "sensing"])
def test_steps_in_a_sample_are_a_whole_number_of_forces(monkeypatch, value, place):
    of = Often if place == "forces" else Mean
    monkeypatch.setattr(of, "per_sample", 4 if place == "sensing" else value)
    with pytest.raises(BlockError, match="per_sample must be"):
        make_closed_loop(load_scenario("postcapture"), blocks={f"{place}.own": of.from_setup})


class _Hostile(Mean):
    """``Mean`` with a fault."""


class Branch(_Hostile):
    def step(self, inputs, memory, now):
        if inputs["state"][4] > 1e-3:
            return super().step(inputs, memory, now)
        return {"estimated_state": inputs["state"]}, memory


class Random(_Hostile):
    def step(self, inputs, memory, now):
        outputs, memory = super().step(inputs, memory, now)
        shown = outputs["estimated_state"] + 1e-6 * np.random.default_rng().random()
        return {"estimated_state": shown}, memory


class Counts(_Hostile):
    count: ClassVar = [0]

    def step(self, inputs, memory, now):
        self.count[0] += 1
        outputs, memory = super().step(inputs, memory, now)
        return {"estimated_state": outputs["estimated_state"] + 1e-6 * self.count[0]}, memory


class Unknown(_Hostile):
    inputs = ("state", "told_force")


class Converts(_Hostile):
    def step(self, inputs, memory, now):
        return {"estimated_state": np.array(inputs["state"], dtype=float)}, memory


HOSTILE = (Branch, Random, Counts, Unknown, Converts)
HOSTILE = {each.__name__: dataclass(frozen=True, kw_only=True)(each) for each in HOSTILE}
globals().update(HOSTILE)


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTILE)
def test_a_stage_that_is_no_pure_function_is_not_compiled(name):
    found = simulate_many(scenarios(f"test_own_stages:{name}"), engine="compiled", keep_errors=True)
    for record in found:
        assert record.engine.startswith("drake (not covered: "), record.engine
        assert "object" not in record.engine
