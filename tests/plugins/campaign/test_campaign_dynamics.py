"""Campaigns on generated dynamics: rows as with Drake but for rounding, and what computed them."""

import importlib.util

import pytest
import yaml
from campaign_tools import run_here, write_spec
from click.testing import CliRunner

from ffsm_drake.cli import main
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.campaign.cases import make_cases
from ffsm_drake.plugins.campaign.evaluate import Batch, Evaluator
from ffsm_drake.plugins.campaign.plan import status_text
from ffsm_drake.plugins.campaign.run import repeat_run, start_campaign
from ffsm_drake.plugins.campaign.spec import load_spec
from ffsm_drake.plugins.campaign.store import open_store
from ffsm_drake.spacecraft.dynamics import dynamics_names

CAN = "generated" in dynamics_names() and importlib.util.find_spec("llvmlite")
needs_generated = pytest.mark.skipif(not CAN, reason="needs the dynamics 'generated'")
NUMBERS = ("itae", "isv", "peak_effort_joints", "outcome_time", "predicted_radius_starting")


def rows(database, *columns):
    names = ", ".join(("case_index", "controller", *columns))
    with open_store(database) as store:
        return list(store.query(f"SELECT {names} FROM runs ORDER BY 1, 2"))


@pytest.fixture(scope="module")
def databases(tmp_path_factory):
    """The same cases, with Drake and with generated dynamics."""
    folder = tmp_path_factory.mktemp("dynamics")
    return {
        name: run_here(
            write_spec(folder / f"{name}.yaml", dynamics=name, cases=5), folder / f"{name}.db"
        )
        for name in ("drake", "generated")
    }


@pytest.mark.long
@needs_generated
def test_rows_are_those_of_drake_but_for_rounding(databases):
    found, expected = (rows(databases[name], *NUMBERS) for name in ("generated", "drake"))
    assert [row[:2] for row in found] == [row[:2] for row in expected]
    for own, other in zip(found, expected, strict=True):
        assert own[2:] == pytest.approx(other[2:], rel=1e-9)
    outcomes = [rows(database, "outcome") for database in databases.values()]
    assert outcomes[0] == outcomes[1]


@pytest.mark.slow
@needs_generated
def test_one_case_in_a_hundred_runs_with_both(databases):
    stored = rows(databases["generated"], "dynamics", "drake_outcome", "drake_difference")
    assert {row[2] for row in stored} == {"generated"}
    for case, _, _, outcome, difference in stored:
        assert (outcome is None, difference is None) == (case > 0, case > 0)
        assert difference is None or difference < 1e-10
    with open_store(databases["generated"]) as store:
        said = status_text(store)
    assert "dynamics: generated; 0 runs left to Drake; 2 run with both: 0 outcomes differ" in said
    with open_store(databases["drake"]) as store:
        assert "dynamics" not in store.columns
        assert "dynamics: " not in status_text(store)


@needs_generated
def test_a_case_has_its_bits_again(databases):
    with open_store(databases["generated"]) as store:
        found = repeat_run(store, store.case(3), "tdc")
    assert found.differences == []
    assert found.record.dynamics == "generated"


@needs_generated
def test_what_is_not_covered_is_an_error_or_left_to_drake(tmp_path):
    changes = {
        "overrides": {"duration": 0.1, "simulator_config.use_error_control": True},
        "cases": 1,
        "controllers": ["tdc"],
        "settled": {"hold": 0.1},
    }
    for name in ("generated", "generated_else_drake"):
        run_here(
            write_spec(tmp_path / f"{name}.yaml", dynamics=name, **changes), tmp_path / f"{name}.db"
        )
    ((*_, outcome, message, dynamics),) = rows(
        tmp_path / "generated.db", "outcome", "message", "dynamics"
    )
    assert (outcome, dynamics) == ("error", None)
    assert "not covered" in message
    ((*_, outcome, dynamics),) = rows(tmp_path / "generated_else_drake.db", "outcome", "dynamics")
    assert outcome != "error"
    assert dynamics.startswith("drake (")


@pytest.mark.long
@needs_generated
def test_the_option_replaces_the_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_spec(tmp_path / "s.yaml", cases=3, controllers=["tdc"])
    words = ["campaign", "run", "s.yaml", "--dynamics", "generated", "--cases", "1"]
    result = CliRunner().invoke(main, [*words, "--database", "s.db", "--workers", "1"])
    assert result.exit_code == 0, result.output
    assert "dynamics: generated" in result.output
    status = CliRunner().invoke(main, ["campaign", "status", "s.yaml", "--database", "s.db"])
    assert status.exit_code == 0, status.output


def test_a_worker_without_the_dynamics_reports_it_in_each_row(tmp_path):
    spec = load_spec(write_spec(tmp_path / "s.yaml", dynamics="elsewhere", cases=2))
    rows = Evaluator(spec).evaluate_batch(Batch(tuple((case, "tdc") for case in make_cases(spec))))
    assert [row["outcome"] for row in rows] == ["error"] * 2
    assert all("'elsewhere' is unknown" in row["message"] for row in rows)


@pytest.mark.parametrize(("given", "said"), [("nonsense", "'nonsense' is unknown"), (3, "name")])
def test_other_dynamics_are_refused(tmp_path, given, said):
    file = write_spec(tmp_path / "s.yaml", dynamics=given)
    assert yaml.safe_load(file.read_text())["dynamics"] == given
    with pytest.raises(FfsmError, match=said):
        start_campaign(load_spec(file), tmp_path / "x.db", workers=None)
    assert not (tmp_path / "x.db").exists()
