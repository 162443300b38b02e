"""Users' stages of sensing in compiled runs."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from compared_runs import check
from near_captures import SHORT
from own_stage import Mean, Pull

from ffsm_drake import Metric, Part, Phase, Signal, load_scenario, setting, simulate_many
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.compiled.missions import Lane
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.systems.reference import timed


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


@dataclass(frozen=True, kw_only=True)
class Measured(Part):
    """``Pull`` with a signal and a metric, which need more of the settings than its force."""

    share: float = setting(1.0, "1", "share of the force that is shown")

    def signals(self, setup):
        def shown(run):
            return self.share * run["force_own"][:, 2:3]

        about = {"name": "shown", "unit": "N m", "meaning": "share of the torque"}
        return (Signal(**about, components=[f"x{self.share}"], of=shown),)

    def metrics(self):
        return (Metric(key="own.share", unit="1", of=lambda run: self.share),)

    def flow(self, setup):
        return Pull.from_setup(setup)

    def build(self, setup):
        return self.flow(setup)


@pytest.mark.slow
def test_runs_with_one_code_have_parts_of_their_own():
    """Settings of a user's part, and sensors that faults draw, which their signals name."""
    block = "blocks.forces.own={{system: 'test_own_stages:Measured', settings: {}}}"
    lost = "faults.events.a={unit: sensing, kind: dropout, time: 0.05, size: 0.5}"
    for each in (
        [[block.format(f"{{share: {share}}}")] for share in (0.5, 2.0)],
        [[lost, f"random_seed={seed}"] for seed in range(4)],
    ):
        check([load_scenario("postcapture", ["duration=0.2", *given]) for given in each])


@dataclass(frozen=True, kw_only=True)
class Doubled(Measured):
    """Another default of its setting."""

    share: float = setting(2.0, "1", "share of the force that is shown")


def measured(setup):
    """A phase with a part, which is not built yet."""
    return Phase(blocks={"forces.own": Doubled})


@pytest.mark.slow
@pytest.mark.parametrize("share", [None, 0.5])
def test_a_part_of_a_phase_is_built_with_its_settings(share):
    """With those of the scenario's choice, if there is one."""
    given = [*SHORT, "blocks.phases.own.system=test_own_stages:measured", "duration=7"]
    given.append("blocks.phases.own.duration=1")
    if share is not None:
        choice = f"{{system: 'test_own_stages:Measured', settings: {{share: {share}}}}}"
        given.append(f"blocks.forces.own={choice}")
    lane = Lane(timed(make_mission(load_scenario("tumbling_capture", given))))
    assert lane.plan(), lane.result
    part = lane.run.case.made.placed["forces.own"].part
    assert (type(part).__name__, part.share) == ("Doubled", share or 2.0)


def pulled(setup):
    """A phase with a force."""
    return Phase(blocks={"forces.own": Pull})


@pytest.mark.parametrize(
    ("name", "given", "kept"),
    [
        ("postcapture", ["blocks.sensing.own.system=own_stage:Mean"], False),
        ("postcapture", ["blocks.forces.own.system=own_stage:Pull"], False),
        ("tumbling_capture", ["blocks.phases.own.system=test_own_stages:pulled"], False),
        ("tumbling_capture", ["blocks.phases.own.system=own_phases:wait"], True),
        ("flight_sensors", [], True),
    ],
)
def test_only_code_of_shipped_blocks_is_kept_on_disk(name, given, kept):
    """A user's block may change without another name."""
    if name == "tumbling_capture":
        folder = Path(__file__).parents[1] / "capture"
        given = [*SHORT, *given, "blocks.phases.own.duration=1", "duration=7"]
        given += [f"python_path=[{folder}]"]
    mission = timed(make_mission(load_scenario(name, given)))
    lane = Lane(mission, None if mission.scenario.grasps else Run(mission))
    assert lane.plan()
    assert (lane.run.key_on_disk is not None) == kept


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
