"""The engine in ``simulate`` and ``simulate_many``: what it refuses, and what Drake computes."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from compared_runs import check
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import GetIntegrationSchemes

from ffsm_drake import RunRecord, ScenarioError, load_scenario, simulate, simulate_many
from ffsm_drake.cli import main
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.runs.integration import integration_remarks
from ffsm_drake.scenario.schema import FIXED_STEP_SCHEMES


@pytest.mark.smoke
def test_one_run_is_that_of_many_and_its_record_keeps_the_name(tmp_path):
    scenario = load_scenario("postcapture", ["duration=0.2"])
    record = simulate(scenario, engine="compiled")
    (other,) = simulate_many([scenario], engine="compiled")
    assert record.engine == other.engine == "compiled"
    assert record.dataset.identical(other.dataset)
    record.save(tmp_path / "run")
    assert RunRecord.load(tmp_path / "run").engine == "compiled"


def test_a_run_that_diverges_is_that_of_drake():
    scenario = load_scenario("postcapture", ["duration=0.1", "divergence_speed=1e-4"])
    record, other = (
        simulate(scenario, engine=engine, check_stability=False) for engine in ("compiled", "drake")
    )
    assert record.outcome.status == "diverged"
    assert record.engine == "drake (the run fails or diverges)"
    assert record.dataset.identical(other.dataset)


@pytest.mark.parametrize(
    ("given", "more", "said"),
    [
        (["simulator_config.use_error_control=true"], {}, "error control"),
        ([], {"blocks": {"sensing": lambda setup: None}}, "sensing"),
        ([], {"meshcat": True}, "a live view"),
    ],
)
def test_what_is_not_covered_is_refused_in_a_line_with_the_remedy(given, more, said):
    more = more | ({"meshcat": Meshcat()} if "meshcat" in more else {})
    with pytest.raises(NotCovered) as caught:
        simulate(load_scenario("postcapture", given), engine="compiled", **more)
    assert re.fullmatch(
        rf"engine: not covered: .*{said}.*; use the engine drake", str(caught.value)
    )


def test_the_command_refuses_in_a_line_and_repeats_with_the_engine_of_the_run(tmp_path):
    words = ["--no-report", "--engine", "compiled", "--out", str(tmp_path / "run")]
    noisy = ["two_arms", "--set", "contacts.right.force_noise=1"]
    refused = CliRunner().invoke(main, ["run", *noisy, *words])
    assert refused.exit_code == 2
    line = "engine: not covered: forces.contacts; use the engine drake"
    assert refused.stderr.splitlines()[-1] == f"error: {line}"
    short = ["--set", "duration=0.1", "--set", "tolerance={joints: 1}"]
    assert CliRunner().invoke(main, ["run", *short, *words]).exit_code == 0
    again = ["--no-report", "--out", str(tmp_path / "again")]
    result = CliRunner().invoke(main, ["run", str(tmp_path / "run"), *again])
    assert "same record, bit for bit" in result.output
    assert RunRecord.load(tmp_path / "again").engine == "compiled"


@pytest.mark.parametrize("scheme", GetIntegrationSchemes())
def test_every_integrator_of_drake_is_compiled_or_left_to_drake(scheme):
    """The page names those that are compiled."""
    scheme_of = {"duration": 0.02, "simulator_config": {"integration_scheme": scheme}}
    if scheme == "cenic":
        with pytest.raises(ScenarioError, match="'cenic' is unknown"):
            load_scenario("postcapture", [scheme_of])
        return
    scenario = load_scenario("postcapture", [scheme_of])
    alone = simulate(scenario, check_stability=False)
    for record in simulate_many([scenario] * 2):
        assert record.dataset.identical(alone.dataset)
    if scheme in SCHEMES:
        check([scenario, dataclasses.replace(scenario, random_seed=1)])
    else:
        for record in simulate_many([scenario] * 2, engine="compiled"):
            assert record.engine == f"drake (not covered: integration_scheme {scheme})"
            assert record.dataset.identical(alone.dataset)
    position = alone.dataset["position"].copy()
    position.values[:, :4] *= 1.1
    other = dataclasses.replace(alone, dataset=alone.dataset.assign(position=position))
    remarks = " ".join(integration_remarks(other))
    assert ("or runge_kutta3" in remarks) == (scheme in FIXED_STEP_SCHEMES)
    page = (Path(__file__).parents[3] / "docs/many_runs.md").read_text()
    (named,) = re.findall(r"^\| integrators \| (.+) \|$", page, re.MULTILINE)
    assert (f"`{scheme}`" in named) == (scheme in SCHEMES)


def test_runs_on_both_engines_keep_their_places():
    plain = load_scenario("postcapture", ["duration=0.05"])
    other = load_scenario(
        "postcapture", ["duration=0.05", "simulator_config.use_error_control=true"]
    )
    seeds = [
        dataclasses.replace(each, random_seed=k) for k, each in enumerate([plain, other, plain])
    ]
    records, expected = simulate_many(seeds, engine="compiled", batch=2), simulate_many(seeds)
    assert [record.scenario.random_seed for record in records] == [0, 1, 2]
    assert records[1].engine.startswith("drake (not covered: error control")
    assert records[1].dataset.identical(expected[1].dataset)
    for record, drakes in zip(records[::2], expected[::2], strict=True):
        assert record.engine == "compiled"
        velocity = record.dataset["velocity"].values
        np.testing.assert_allclose(velocity, drakes.dataset["velocity"].values, atol=1e-12)
