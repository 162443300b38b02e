"""Runs on compiled code against those on Drake's plant."""

import dataclasses
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from drawn_trees import drawn_tree
from pydrake.systems.analysis import GetIntegrationSchemes
from pydrake.systems.framework import LeafSystem

from ffsm_drake import (
    BlockError,
    FfsmError,
    RunRecord,
    ScenarioError,
    load_scenario,
    override_scenario,
    simulate,
    simulate_many,
)
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.generated import dynamics
from ffsm_drake.runs.integration import integration_remarks
from ffsm_drake.scenario.schema import FIXED_STEP_SCHEMES
from ffsm_drake.spacecraft.dynamics import NotCovered, find_dynamics

SAME = 1e-10  # m, rad, and per second
LAWS = ("tde_aismc", "tdc", "pd_plus", "computed_torque")


def seeded(scenario, count):
    return [dataclasses.replace(scenario, random_seed=seed) for seed in range(count)]


def varied(scenario, count):
    """With a seed and masses of their own."""
    payload = scenario.payload
    return [
        dataclasses.replace(
            scenario,
            random_seed=seed,
            payload=dataclasses.replace(
                payload,
                truth=dataclasses.replace(
                    payload.truth, mass=payload.truth.mass * (1.0 + 0.02 * seed)
                ),
            ),
        )
        for seed in range(count)
    ]


def assert_near(generated, drake, *, bound=SAME):
    """Equal but for rounding."""
    assert generated.outcome.status == drake.outcome.status
    for name in ("position", "velocity", "error"):
        found, expected = generated.dataset[name].values, drake.dataset[name].values
        assert np.abs(found - expected).max() < bound, name


def check(scenarios, *, bound=SAME):
    found = simulate_many(scenarios, dynamics="generated")
    assert {record.dynamics for record in found} == {"generated"}
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert other.dynamics == "drake"
        assert_near(record, other, bound=bound)


@pytest.mark.smoke
@pytest.mark.parametrize("controller", LAWS)
def test_every_kind_of_law_has_the_runs_of_drake(controller):
    check(varied(load_scenario("postcapture", ["duration=0.3", f"controller={controller}"]), 3))


@pytest.mark.parametrize(
    "name",
    [
        "flexible_panels",
        "thrusters_and_wheels",
        pytest.param("flight_sensors", marks=pytest.mark.slow),
        pytest.param("free_floating", marks=pytest.mark.slow),
        pytest.param("reaction_null", marks=pytest.mark.slow),
        pytest.param("seven_joint", marks=pytest.mark.slow),
        pytest.param("planar_detumble", marks=pytest.mark.slow),
    ],
)
def test_shipped_scenarios_have_the_runs_of_drake(name):
    check(seeded(load_scenario(name, ["duration=0.3"]), 3))


@pytest.mark.long
def test_a_whole_run_is_that_of_drake():
    check(varied(load_scenario("postcapture"), 3))


@pytest.mark.slow
def test_slosh_and_beams_have_the_runs_of_drake():
    parts = (
        "model.flexible={tank: {kind: pendulum, body: 'servicer::base', mass: 20, length: 0.3, "
        "frequency: 0.4, damping_ratio: 0.02}, boom: {kind: beam, body: 'servicer::base', mass: 5,"
        " length: 3, frequencies: [0.5, 2.0]}, weight: {kind: mass, body: 'servicer::base', "
        "mass: 3, frequency: 1.0}}"
    )
    check(varied(load_scenario("flexible_panels", ["duration=2", parts]), 3))


@pytest.mark.long
def test_captures_have_the_runs_of_drake():
    scenarios = varied(load_scenario("tumbling_capture", ["duration=24"]), 2)
    check(scenarios, bound=1e-7)  # thrusters switch


@pytest.mark.smoke
def test_a_run_has_its_bits_in_every_batch():
    scenarios = varied(load_scenario("postcapture", ["duration=0.1"]), 16)
    whole = simulate_many(scenarios, dynamics="generated", batch=16)
    for batch in (1, 5, 8):
        for own, other in zip(
            simulate_many(scenarios, dynamics="generated", batch=batch), whole, strict=True
        ):
            assert own.dynamics == "generated"
            for name, variable in other.dataset.variables.items():
                np.testing.assert_array_equal(own.dataset[name].values, variable.values, name)


def test_a_run_that_diverges_leaves_the_others_alone():
    tame = load_scenario("postcapture", ["duration=1"])
    wild = override_scenario(
        tame, ["controllers.tde_aismc.k_s_initial=400", "controllers.tde_aismc.k_s_max=null"]
    )
    scenarios = [tame, dataclasses.replace(tame, random_seed=1), wild]
    scenarios = [dataclasses.replace(each, divergence_speed=5.0) for each in scenarios]
    records = simulate_many(scenarios, dynamics="generated")
    assert [record.outcome.status for record in records] == ["completed"] * 2 + ["diverged"]
    (alone,) = simulate_many(scenarios[:1], dynamics="generated")
    np.testing.assert_array_equal(
        records[0].dataset["velocity"].values, alone.dataset["velocity"].values
    )


class Faulty(LeafSystem):
    """A user's force that fails in its own way with some seeds, after some samples."""

    def __init__(self, setup):
        super().__init__()
        self._size, self._seed = len(setup.coordinates.names), setup.scenario.random_seed
        self.DeclareVectorOutputPort("generalized_force", self._size, self._calc)

    def _calc(self, context, output):
        force = np.zeros(self._size)
        if context.get_time() > 0.05 and self._seed == 1:
            force[:] = np.nan
        if context.get_time() > 0.05 and self._seed == 2:
            raise ZeroDivisionError("by zero")
        output.SetFromVector(force)


@pytest.mark.parametrize("faulty", [1, 2])
def test_a_force_that_fails_leaves_the_others_alone(faulty, monkeypatch):
    module = types.ModuleType("lab_of_generated")
    module.Faulty = Faulty
    monkeypatch.setitem(sys.modules, module.__name__, module)
    scenario = load_scenario(
        "postcapture", ["duration=0.2", f"blocks.forces.own={module.__name__}:Faulty"]
    )
    sound = [dataclasses.replace(scenario, random_seed=seed) for seed in (0, 3, 4)]
    scenarios = [*sound, dataclasses.replace(scenario, random_seed=faulty)]
    *records, error = simulate_many(scenarios, dynamics="generated", keep_errors=True)
    assert isinstance(error, BlockError)
    expected = simulate_many(sound, dynamics="generated")
    for record, other in zip(records, expected, strict=True):
        assert record.dynamics == "generated"
        np.testing.assert_array_equal(
            record.dataset["velocity"].values, other.dataset["velocity"].values
        )


REFUSED = {
    "error control": ("simulator_config.use_error_control=true",),
    "scheme": ("simulator_config.integration_scheme=semi_explicit_euler",),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_is_not_covered_is_refused_or_left_to_drake(kind):
    scenario = load_scenario("postcapture", ["duration=0.1", *REFUSED[kind]])
    with pytest.raises(FfsmError) as caught:
        simulate_many([scenario], dynamics="generated")
    assert "\n" not in str(caught.value)
    (record,) = simulate_many([scenario], dynamics="generated_else_drake")
    (drake,) = simulate_many([scenario])
    assert record.dynamics.startswith("drake (")
    assert str(caught.value) in record.dynamics
    np.testing.assert_array_equal(
        record.dataset["velocity"].values, drake.dataset["velocity"].values
    )


def test_a_run_with_a_supervisor_is_that_of_drake_but_for_rounding():
    supervised = ["duration=0.3", "supervisor={}", "actuation.limit={all: 1000}"]
    scenario = load_scenario("postcapture", supervised)
    (record,) = simulate_many([scenario], dynamics="generated")
    (drake,) = simulate_many([scenario])
    velocity = record.dataset["velocity"].values
    np.testing.assert_allclose(velocity, drake.dataset["velocity"].values, rtol=0, atol=1e-9)


# From a posture near that at the grasp; the last two slip and miss, and run again alone.
CLOSING = (
    "duration=1.5",
    "reference.duration=3",
    "capture.approach={duration: 1.0, posture: {base_position: [0.1, 0.3, -0.2], joints: "
    "{joint_1: 0.15, joint_2: 0.33, joint_3: 1.1, joint_4: 0.5, joint_5: -0.75}}}",
    "capture.approach.posture.base_rpy=[0.11, 0.08, -0.1]",
    "capture.closing={time: 0.4, hold: 0.4, rest: 0.05}",
    "supervisor={}",
)
ENDS = {
    "capture.closing.friction=0.3": "completed",
    "payload.truth.mass=80": "completed",
    "capture.closing.friction=1e-4": "slipped",
    "capture.envelope.velocity=1e-6": "missed",
}


@pytest.mark.long
def test_grippers_that_close_end_as_with_drake():
    base = load_scenario("tumbling_capture", CLOSING)
    scenarios = [override_scenario(base, [each]) for each in ENDS]
    drake, generated = (simulate_many(scenarios, dynamics=each) for each in ("drake", "generated"))
    for record, other, end in zip(generated, drake, ENDS.values(), strict=True):
        assert record.outcome.status == other.outcome.status == end
        assert record.dynamics.startswith("generated" if end == "completed" else "drake (")
        for name in ("position", "velocity", "contact_force"):
            own, its = record.dataset[name].values, other.dataset[name].values
            np.testing.assert_allclose(own, its, rtol=1e-7, atol=1e-7, err_msg=name)


def test_code_that_differs_from_drake_is_refused(monkeypatch):
    plant = drawn_tree(11, 1)
    tree = Reader(plant).tree
    monkeypatch.setattr(dynamics, "LARGEST_DIFFERENCE", 1e-20)
    with pytest.raises(NotCovered, match="differs from Drake"):
        dynamics.held_to_drake(tree, plant=plant)
    monkeypatch.undo()
    kernels = dynamics.held_to_drake(tree, plant=plant)
    assert dynamics.held_to_drake(tree, plant=plant) is kernels


def test_an_unknown_name_lists_the_known():
    with pytest.raises(
        FfsmError, match="drake, compiled, compiled_else_drake, generated and 1 more"
    ):
        find_dynamics("generatd")


def test_a_record_keeps_the_name(tmp_path):
    scenario = load_scenario("postcapture", ["duration=0.1"])
    (record,) = simulate_many([scenario], dynamics="generated")
    record.save(tmp_path / "run")
    assert RunRecord.load(tmp_path / "run").dynamics == "generated"


@pytest.mark.parametrize("scheme", GetIntegrationSchemes())
def test_every_integrator_of_drake_runs_or_is_refused(scheme):
    """Alone, in a batch, and in a batch on compiled code, which takes those that the page names."""
    scheme_of = {"duration": 0.02, "simulator_config": {"integration_scheme": scheme}}
    if scheme == "cenic":
        with pytest.raises(ScenarioError, match="'cenic' is unknown"):
            load_scenario("postcapture", [scheme_of])
        return
    scenario = load_scenario("postcapture", [scheme_of])
    alone = simulate(scenario, check_stability=False)
    for record in simulate_many([scenario] * 2):
        assert record.dataset.identical(alone.dataset)
    if scheme in dynamics.SCHEMES:
        check(seeded(scenario, 2))
    else:
        for count in (1, 3):
            with pytest.raises(NotCovered, match=rf"integration_scheme {scheme} \(but "):
                simulate_many(seeded(scenario, count), dynamics="generated")
    remarks = " ".join(integration_remarks(alone_with(alone, norm=1.1)))
    assert ("or runge_kutta3" in remarks) == (scheme in FIXED_STEP_SCHEMES)
    page = (Path(__file__).parents[3] / "docs/many_runs.md").read_text()
    (_, named) = re.findall(r"^\| integrators \| (.+) \|$", page, re.MULTILINE)
    assert (f"`{scheme}`" in named) == (scheme in dynamics.SCHEMES)


def alone_with(record, *, norm):
    """A record whose base's quaternion has another norm."""
    position = record.dataset["position"].copy()
    position.values[:, :4] *= norm
    return dataclasses.replace(record, dataset=record.dataset.assign(position=position))
