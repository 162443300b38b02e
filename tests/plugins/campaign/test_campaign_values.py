"""Every kind of dispersed value reaches the plant or the controller: the run's series change."""

import dataclasses
import gc

import pytest
from campaign_tools import write_spec

from ffsm_drake.common.errors import LimitError, ScenarioError
from ffsm_drake.plugins.campaign.cases import Case, scenario_of
from ffsm_drake.plugins.campaign.evaluate import Evaluator, evaluate
from ffsm_drake.plugins.campaign.rows import PREDICTIONS, differing_columns, metrics_of
from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_data
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import load_scenario, scenario_from_dict, scenario_to_dict

# key, value, controller, and the series that must differ
DISPERSED = [
    ("payload.truth.mass", 150.0, "tdc", "state"),
    ("payload.truth.center_of_mass.0", 0.1, "tdc", "state"),
    ("payload.truth.inertia", [20.0, 20.0, 20.0], "tdc", "state"),
    ("payload.nominal.mass", 60.0, "tdc", "generalized_force"),
    ("payload.nominal.center_of_mass.1", 0.1, "tdc", "generalized_force"),
    ("payload.nominal.inertia", [9.0, 9.0, 9.0], "tdc", "generalized_force"),
    ("sensing.velocity_noise", 5e-6, "tdc", "measurement"),
    ("sensing.velocity_noise.joint_2", 5e-6, "tdc", "measurement"),
    ("sensing.position_noise", 1e-6, "tdc", "measurement"),
    ("sensing.velocity_bias.joint_1", 1e-4, "tdc", "measurement"),
    ("disturbance.amplitude_scale", 2.0, "tdc", "disturbance_force"),
    ("disturbance.harmonics.joint_1.amplitude", 0.5, "tdc", "disturbance_force"),
    ("disturbance.harmonics.joint_1.frequency", 3.0, "tdc", "disturbance_force"),
    ("disturbance.harmonics.joint_1.phase", 1.0, "tdc", "disturbance_force"),
    ("sample_time", 0.005, "tdc", "state"),
    ("controllers.tdc.k_d", 80.0, "tdc", "generalized_force"),
    ("controllers.tdc.k_p.joint_3", 60.0, "tdc", "generalized_force"),
    ("controllers.asmc.k_s", 60.0, "asmc", "generalized_force"),
    ("controllers.aismc.k_s_initial", 60.0, "aismc", "reaching_gain"),
    ("controllers.tde_aismc.k_s_max.joint_1", 60.001, "tde_aismc", "reaching_gain"),
    ("initial_posture.base_position.2", -0.1, "tdc", "state"),
    ("initial_posture.base_rpy.0", 0.2, "tdc", "state"),
    ("initial_posture.joints.joint_2", 0.4, "tdc", "state"),
    ("initial_velocity.joint_1", 0.01, "tdc", "state"),
    ("initial_velocity.base_rotation", 0.001, "tdc", "generalized_force"),
    ("actuation.limit.joint_1", 0.05, "tdc", "applied_force"),
    ("estimator.kind", "kalman", "tdc", "generalized_force"),
]


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return load_spec(write_spec(tmp_path_factory.mktemp("spec") / "s.yaml"))


@pytest.fixture(scope="module")
def plain(spec):
    """Series of the run without any case's values, by controller."""
    runs = {}

    def get(controller):
        if controller not in runs:
            runs[controller] = (
                Rollout(scenario_of(spec, Case(index=0, seed=1, values={}), controller))
                .run()
                .series
            )
        return runs[controller]

    return get


@pytest.mark.parametrize(
    ("key", "value", "controller", "series"), DISPERSED, ids=lambda item: str(item)[:40]
)
def test_a_value_changes_the_run(key, value, controller, series, spec, plain):
    scenario = scenario_of(spec, Case(index=0, seed=1, values={key: value}), controller)
    changed = Rollout(scenario).run().series[series]
    samples = min(len(changed), len(plain(controller)[series]))
    assert (changed[1:samples] != plain(controller)[series][1:samples]).any()


def test_the_seed_changes_the_noise(spec, plain):
    other = Rollout(scenario_of(spec, Case(index=0, seed=2, values={}), "tdc")).run().series
    assert (other["measurement"] != plain("tdc")["measurement"]).any()
    assert (other["disturbance_force"] == plain("tdc")["disturbance_force"]).all()


def test_initial_velocity_is_the_state_at_the_start(spec):
    values = {
        "initial_velocity": {"base_rotation": 0.01, "base_position_y": -0.02, "joint_3": 0.03}
    }
    log = Rollout(scenario_of(spec, Case(index=0, seed=1, values=values), "tdc")).run()
    velocity = dict(
        zip(
            log.coordinates.names,
            log.series["state"][0][-len(log.coordinates.names) :],
            strict=True,
        )
    )
    wanted = dict.fromkeys(log.coordinates.names, 0.0) | {"base_position_y": -0.02, "joint_3": 0.03}
    wanted |= {f"base_rotation_{axis}": 0.01 for axis in "xyz"}
    assert velocity == wanted
    assert not log.series["desired_state"][0][-len(wanted) :].any()


def evaluate_alone(spec, case):
    (row,) = evaluate(spec.to_json(), ((case, "tdc"),))
    return row


def test_a_reused_build_has_the_bits_of_a_fresh_one(tmp_path):
    mass = {"distribution": "uniform", "low": 20, "high": 300}
    spec = load_spec(
        write_spec(
            tmp_path / "s.yaml",
            parameters={"payload.truth.mass": mass},
            factors={},
            derive={},
            engine="drake",
        )
    )
    evaluator = Evaluator(spec)
    for index, value in enumerate((50.0, 250.0, 50.0)):
        case = Case(index=index, seed=index % 2, values={"payload.truth.mass": value})
        reused = evaluator.evaluate(case, "tdc")
        fresh = simulate(scenario_of(spec, case, "tdc"), check_stability=False).metrics
        assert reused["itae"] == fresh["itae"]
        assert reused["isv"] == fresh["isv"]
        for group in ("base_rotation", "base_position", "joints"):
            assert reused[f"peak_error_{group}"] == fresh["peak_error"][group]
            assert reused[f"final_error_{group}"] == fresh["final_error"][group]
            assert reused[f"peak_effort_{group}"] == fresh["peak_effort"][group]
        assert not differing_columns(reused, evaluate_alone(spec, case))


def test_a_case_that_cannot_be_built_leaves_nothing_of_the_one_before(spec, monkeypatch):
    """A released loop was kept, and released or run again by the next case: a crash."""
    first, refused, last = (
        Case(index=index, seed=1, values={"controllers.tdc.k_d": gain})
        for index, gain in enumerate((1.0, 2.0, 1.0))
    )

    def refuse(*arguments, **settings):
        raise LimitError("capture.approach.start", "no start is clear", limit="clearance")

    evaluator = Evaluator(dataclasses.replace(spec, engine="drake"))
    before = evaluator.evaluate(first, "tdc")
    with monkeypatch.context() as patched:
        patched.setattr("ffsm_drake.runs.phases.Rollout", refuse)
        assert evaluator.evaluate(refused, "tdc")["outcome"] == "refused"
    gc.collect()
    after = evaluator.evaluate(last, "tdc")
    assert before["outcome"] != "error"
    assert not differing_columns(before, after)


@pytest.mark.smoke
def test_a_run_that_cannot_be_is_a_row(spec):
    row = evaluate_alone(spec, Case(index=0, seed=1, values={"payload.truth.mass": -5.0}))
    assert row["outcome"] == "error"
    assert row["message"] == "ScenarioError: payload.truth.mass: must be > 0 kg, not -5"
    assert all(row[name] is None for name in metrics_of(spec))


@pytest.mark.smoke
def test_a_diverging_run_says_when(spec):
    case = Case(index=0, seed=1, values={"controllers.tdc.k_d": 400.0})
    row = evaluate_alone(spec, case)
    assert row["outcome"] == "diverged"
    assert 0.0 < row["outcome_time"] < 0.3
    assert "diverged at t =" in row["message"]
    assert row["predicted_radius_starting"] > 1.0


def test_predictions_can_be_left_out(spec):
    without = spec_from_data({**spec.data, "predictions": False})
    case = Case(index=0, seed=1, values={"controllers.tdc.k_d": 400.0})
    row = evaluate_alone(without, case)
    assert row["outcome"] == "diverged"
    assert all(row[name] is None for name in PREDICTIONS)


@pytest.mark.parametrize("name", ["postcapture", "paper", "flight_sensors"])
def test_typing_without_yaml_text_gives_what_drake_loads(name):
    from pydrake.common.yaml import yaml_dump, yaml_load_typed

    from ffsm_drake.scenario import Scenario

    data = scenario_to_dict(load_scenario(name))
    loaded = yaml_load_typed(schema=Scenario, data=yaml_dump(data), retain_map_defaults=False)
    assert scenario_to_dict(scenario_from_dict(data)) == scenario_to_dict(loaded) == data


def test_initial_velocity_must_be_within_the_divergence_speed(spec):
    with pytest.raises(
        ScenarioError,
        match=r"initial_velocity\.all: must be within "
        r"divergence_speed",
    ):
        scenario_of(spec, Case(index=0, seed=1, values={"initial_velocity": 20.0}), "tdc")
