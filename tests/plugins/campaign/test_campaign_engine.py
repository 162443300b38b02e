"""Campaigns on compiled runs: rows as with Drake but for rounding, and what computed them."""

import numpy as np
import pytest
import yaml
from campaign_tools import HERE, run_here, sql, write_spec
from click.testing import CliRunner

from ffsm_drake import load_scenario
from ffsm_drake.cli import main
from ffsm_drake.common.errors import CampaignError, FfsmError
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.campaign.cases import make_cases, with_controller
from ffsm_drake.plugins.campaign.evaluate import Evaluator
from ffsm_drake.plugins.campaign.plan import plan_text, status_text
from ffsm_drake.plugins.campaign.prediction import predict_many
from ffsm_drake.plugins.campaign.run import repeat_run, resume_campaign, start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_data, why_not_compiled
from ffsm_drake.plugins.campaign.store import create_store, open_store

needs_compiled = pytest.mark.skipif(bool(why_not_compiled()), reason=why_not_compiled())
NUMBERS = ("itae", "isv", "peak_effort_joints", "outcome_time", "predicted_radius_starting")
NOT_COVERED = {
    "overrides": {"duration": 0.1, "simulator_config.use_error_control": True},
    "cases": 2,
    "controllers": ["tdc"],
    "settled": {"hold": 0.1},
}


def rows(database, *columns):
    names = ", ".join(("case_index", "controller", *columns))
    return sql(database, f"SELECT {names} FROM runs ORDER BY 1, 2")


@pytest.fixture(scope="module")
def databases(tmp_path_factory):
    """The same cases, with Drake and with the default."""
    folder = tmp_path_factory.mktemp("engine")
    return {
        name: run_here(write_spec(folder / f"{name}.yaml", cases=5, **key), folder / f"{name}.db")
        for name, key in (("drake", {"engine": "drake"}), ("compiled", {}))
    }


@pytest.mark.long
@needs_compiled
def test_rows_are_those_of_drake_but_for_rounding(databases):
    found, expected = (rows(databases[name], *NUMBERS) for name in ("compiled", "drake"))
    assert [row[:2] for row in found] == [row[:2] for row in expected]
    for own, other in zip(found, expected, strict=True):
        assert own[2:] == pytest.approx(other[2:], rel=1e-9)
    outcomes = [rows(database, "outcome") for database in databases.values()]
    assert outcomes[0] == outcomes[1]


@pytest.mark.slow
@needs_compiled
def test_one_case_in_a_hundred_runs_with_both(databases):
    stored = rows(databases["compiled"], "engine", "drake_outcome", "drake_difference")
    assert {row[2] for row in stored} == {"compiled"}
    for case, _, _, outcome, difference in stored:
        assert (outcome is None, difference is None) == (case > 0, case > 0)
        assert difference is None or difference < 1e-10
    with open_store(databases["compiled"]) as store:
        said = status_text(store)
    assert "engine: compiled, 10 runs; 2 runs with Drake too: 0 with another outcome" in said
    with open_store(databases["drake"]) as store:
        assert "engine" not in store.columns
        assert "engine: " not in status_text(store)


@needs_compiled
def test_a_case_has_its_bits_again(databases):
    with open_store(databases["compiled"]) as store:
        found = repeat_run(store, store.case(3), "tdc")
    assert found.differences == []
    assert found.record.engine == "compiled"


@needs_compiled
def test_the_reason_is_named_why_a_law_is_called(tmp_path):
    own = {"overrides": {"duration": 0.1}, "controllers": ["tdc", "mpc"]}
    database = run_here(write_spec(tmp_path / "s.yaml", **NOT_COVERED | own), tmp_path / "s.db")
    engines = {controller: engine for _, controller, engine in rows(database, "engine")}
    assert engines["tdc"] == "compiled"
    assert engines["mpc"].startswith("compiled (law called: mpc.py:")
    with open_store(database) as store:
        said = status_text(store)
    assert "engine: compiled, 4 runs; 2 runs with Drake too: 0 with another outcome" in said
    assert f"engine: {engines['mpc']}, 2 runs" in said


@needs_compiled
def test_what_is_not_covered_is_left_to_drake_with_its_reason(tmp_path):
    spec = write_spec(tmp_path / "s.yaml", **NOT_COVERED)
    database, reason = run_here(spec, tmp_path / "s.db"), "drake (not covered: error control)"
    for *_, outcome, engine in rows(database, "outcome", "engine"):
        assert (outcome != "error", engine) == (True, reason)
    with open_store(database) as store:
        said = status_text(store)
    assert "engine: compiled, 0 runs\n" in said
    assert f"engine: {reason}, 2 runs" in said
    assert f"engine: {reason}, 2 runs" in plan_text(load_spec(spec), workers=1)


@pytest.mark.slow
@needs_compiled
def test_the_option_replaces_the_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_spec(tmp_path / "s.yaml", cases=3, controllers=["tdc"], engine="drake")
    words = ["campaign", "run", "s.yaml", "--engine", "compiled", "--cases", "1"]
    result = CliRunner().invoke(main, [*words, "--database", "s.db", "--workers", "1"])
    assert result.exit_code == 0, result.output
    assert "engine: compiled, 1 run" in result.output
    status = CliRunner().invoke(main, ["campaign", "status", "s.yaml", "--database", "s.db"])
    assert status.exit_code == 0, status.output


def test_without_llvmlite_drake_runs_with_a_line_that_says_so(tmp_path, monkeypatch):
    def refuse():
        raise FfsmError("engine: compiled: no llvmlite; pip install it")

    monkeypatch.setattr("ffsm_drake.plugins.compiled.engine.llvm", refuse)
    file = write_spec(tmp_path / "s.yaml", **NOT_COVERED)
    assert load_spec(file).engine == "drake"
    result = CliRunner().invoke(main, ["campaign", "plan", str(file)])
    assert result.exit_code == 0, result.output
    (said,) = result.stderr.splitlines()
    assert said.startswith("engine: compiled: no llvmlite; pip install it; this campaign runs on")
    with pytest.raises(FfsmError, match="pip install"):
        start_campaign(
            load_spec(write_spec(file, engine="compiled")), tmp_path / "x.db", workers=None
        )


def test_a_worker_without_the_engine_reports_it_in_each_row(tmp_path):
    spec = load_spec(write_spec(tmp_path / "s.yaml", engine="elsewhere", cases=2))
    rows = Evaluator(spec).evaluate_batch(tuple((case, "tdc") for case in make_cases(spec)))
    assert [row["outcome"] for row in rows] == ["error"] * 2
    assert all("'elsewhere' is unknown" in row["message"] for row in rows)


@pytest.mark.parametrize(
    ("key", "given", "said"),
    [
        ("engine", "nonsense", "'nonsense' is unknown; choose one of drake, compiled"),
        ("engine", 3, "engine: must be text, not 3"),
        ("dynamics", "generated", "dynamics: is now 'engine'; write engine: compiled, or"),
    ],
)
def test_other_engines_and_the_old_key_are_refused(tmp_path, key, given, said):
    file = write_spec(tmp_path / "s.yaml", **{key: given})
    assert yaml.safe_load(file.read_text())[key] == given
    with pytest.raises(FfsmError, match=said) as caught:
        start_campaign(load_spec(file), tmp_path / "x.db", workers=None)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "x.db").exists()


@pytest.mark.parametrize("name", [None, "drake", "generated", "compiled_else_drake"])
def test_a_database_written_before_the_key_is_read_and_goes_on_with_drake(tmp_path, name):
    new = load_spec(write_spec(tmp_path / "s.yaml", **NOT_COVERED, engine="drake"))
    data = {key: value for key, value in new.data.items() if key != "engine"}
    old, path = spec_from_data(data | ({"dynamics": name} if name else {})), tmp_path / "s.db"
    with create_store(path, old, make_cases(old)) as store:
        assert ("dynamics" in store.columns) == (name not in (None, "drake"))
        assert "0 of 2 runs" in status_text(store)
    if name in (None, "drake"):
        resume_campaign(path, workers=HERE)
        assert len(rows(path, "outcome")) == 2
        return
    with pytest.raises(CampaignError) as caught:
        resume_campaign(path, workers=HERE)
    assert str(caught.value) == (
        "dynamics: is now 'engine'; write engine: compiled, or engine: drake, into a new database"
    )
    with open_store(path) as store, pytest.raises(CampaignError, match="into a new database"):
        repeat_run(store, store.case(0), "tdc")


@pytest.mark.parametrize(
    "seed",
    [pytest.param(k, marks=pytest.mark.slow if k < 1 else pytest.mark.long) for k in range(8)],
)
def test_predictions_of_controllers_that_share_a_case_are_those_of_each_alone(seed):
    random, scenarios = np.random.default_rng(seed), []
    for mass in random.uniform(60.0, 140.0, 2).tolist():
        case = load_scenario("postcapture", [f"payload.nominal.mass={mass}"])
        laws = random.permutation(["tdc", "asmc", "aismc", "tde_aismc", "super_twisting"])[:3]
        scenarios += [with_controller(case, law) for law in laws.tolist()]
    random.shuffle(scenarios)
    together = predict_many([make_mission(each) for each in scenarios])
    for scenario, found in zip(scenarios, together, strict=True):
        (alone,) = predict_many([make_mission(scenario)])
        assert repr(found) == repr(alone)
