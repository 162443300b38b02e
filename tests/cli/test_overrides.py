"""--controller, --set and --seed mean the same in every command; what repeats is said once."""

import warnings

import click
import pytest
from click.testing import CliRunner

from ffsm_drake.cli import main
from ffsm_drake.common.errors import ScenarioError, warnings_as_lines
from ffsm_drake.runs.simulate import prepare
from ffsm_drake.scenario import (
    PerCoordinate,
    Scenario,
    load_scenario,
    scenario_to_dict,
    schema_fields,
)
from ffsm_drake.scenario.resolving import without_null

SHARED = {"controller", "overrides", "seed"}


def commands(group=main, path=()):
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))
        else:
            yield (*path, name), command


OPTIONS = {path: {option.name: option for option in each.params} for path, each in commands()}
FIRST = {("export",): ["law.c"]}  # arguments before the scenario
TAKE_SCENARIOS = sorted(path for path, options in OPTIONS.items() if "overrides" in options)


@pytest.mark.smoke
def test_every_command_has_all_three_or_none():
    assert {("compare",), ("run",), ("validate",)} <= set(TAKE_SCENARIOS)
    for path, options in OPTIONS.items():
        takes_scenario = {"scenario", "scenarios"} & set(options)
        assert (path in TAKE_SCENARIOS) == bool(takes_scenario), path
        if takes_scenario:
            assert set(options) >= SHARED, path
        for name in SHARED & set(options):
            mine, usual = options[name], OPTIONS[("run",)][name]
            assert (mine.opts, mine.type, mine.metavar) == (usual.opts, usual.type, usual.metavar)


@pytest.mark.parametrize("path", TAKE_SCENARIOS, ids=" ".join)
@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (["--set", "payload.truth.mass=-5"], "--set payload.truth.mass: must be > 0 kg"),
        (["--set", "no_key=1"], "--set no_key: unknown key"),
        (["--seed", "-1"], "--set random_seed: must be from 0"),
        (["--set", "random_seed=4", "--seed", "-2"], "random_seed: must be from 0"),
        (["-c", "no_such_law"], "no_such_law"),
        (["--controller", "no such"], "--set controller: 'no such' must be a name"),
    ],
)
def test_what_is_wrong_reads_the_same_in_every_command(path, given, problem, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, [*path, *FIRST.get(path, []), "postcapture", *given])
    assert result.exit_code == 2
    assert problem in result.stderr
    assert len([line for line in result.stderr.splitlines() if "error: " in line]) == 1


def test_compare_takes_no_controller_by_set():
    result = CliRunner().invoke(main, ["compare", "paper", "--set", "controller=tdc"])
    assert result.exit_code == 2
    assert "write --controller " in result.stderr


def test_validate_takes_controller_and_seed():
    given = ["-c", "tdc", "--seed", "3", "--set", "duration=0.1", "--no-rehearsal"]
    result = CliRunner().invoke(main, ["validate", "postcapture", *given])
    assert result.exit_code == 0, result.output
    assert "postcapture: valid; tdc, " in result.stdout


def test_a_warning_that_repeats_is_said_once(capsys):
    with warnings_as_lines():
        warnings.simplefilter("always")
        for text in ("a remark", "another", "a remark"):
            warnings.warn(text, stacklevel=1)
    assert capsys.readouterr().err.splitlines() == ["warning: a remark", "warning: another"]


@pytest.mark.slow
def test_compare_says_a_remark_of_several_runs_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = ["--set", "duration=0.05", "--set", "clearance=5", "-c", "tdc", "-c", "pd_plus"]
    result = CliRunner().invoke(main, ["compare", "postcapture", *given, "--no-report"])
    told = [line for line in result.stderr.splitlines() if line.startswith("warning: ")]
    remarks = [line.split(": ", 2)[-1] for line in told]
    assert told
    assert len(set(remarks)) == len(remarks), told


def test_full_scenarios_are_whole():
    from ffsm_drake.scenario import load_scenario, read_yaml, scenario_to_dict

    result = CliRunner().invoke(main, ["scenarios", "flight_sensors", "--full"])
    assert read_yaml(result.stdout) == scenario_to_dict(load_scenario("flight_sensors"))
    alone = CliRunner().invoke(main, ["scenarios", "flight_sensors"])
    assert "extends: postcapture" in alone.stdout
    assert CliRunner().invoke(main, ["scenarios", "--full"]).exit_code == 2


def test_errors_after_loading_name_the_file_that_is_extended(tmp_path):
    (tmp_path / "base.yaml").write_text("controllers: {tdc: {k_dd: 3}}\n")
    (tmp_path / "mine.yaml").write_text("extends: base.yaml\ncontroller: tdc\n")
    result = CliRunner().invoke(main, ["validate", str(tmp_path / "mine.yaml"), "--no-rehearsal"])
    assert f"{tmp_path / 'base.yaml'}: controllers.tdc.k_dd: unknown" in result.stderr


def mappings(schema, data, path=""):
    """The keys of all mappings by coordinate in the sections that a scenario has."""
    schema = without_null(schema)
    for key, kind in (schema_fields(schema) or {}).items():
        if data is not None:
            yield from mappings(kind, data.get(key), f"{path}.{key}" if path else key)
    if schema == PerCoordinate:
        yield path


@pytest.mark.long
@pytest.mark.parametrize("name", ["capture_on_thrusters", "tumbling_capture"])
def test_a_misspelt_coordinate_is_named_with_its_whole_key(name):
    warnings.simplefilter("ignore")
    keys = list(mappings(Scenario, scenario_to_dict(load_scenario(name))))
    assert {f"{key}.joints" for key in load_scenario(name).postures} < set(keys)
    for key in keys:
        if key.startswith("planning."):  # of another command
            continue
        with pytest.raises(ScenarioError) as caught:
            prepare(load_scenario(name, [f"{key}.elbo=0.3"])).release()
        given = (f"{key}.elbo", "capture.servicer_velocity")  # without effect there
        assert caught.value.key in given, (key, str(caught.value))


@pytest.mark.parametrize("key", ["initial_posture", "target_posture", "capture.approach.posture"])
def test_a_run_is_checked_before_the_one_that_it_replaces_is_named(key, tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    given = ["--set", f"{key}.joints.elbo=0.3", "--out", str(tmp_path)]
    result = CliRunner().invoke(main, ["run", "tumbling_capture", *given])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: --set {key}.joints.elbo: unknown coordinate")


@pytest.mark.parametrize(
    ("second", "given", "problem"),
    [
        ("tdk", (), "--controller: 'tdk' is unknown; give module:attribute, or choose one of"),
        ("asmc", ("--set", "controllers.asmc.k_x=1"), "--set controllers.asmc.k_x: unknown"),
        ("nowhere:Law", (), "controller 'nowhere:Law' cannot be loaded"),
    ],
)
@pytest.mark.parametrize("order", [1, -1])
def test_compare_checks_every_law_before_the_first_run(second, given, problem, order, tmp_path):
    laws = [f"--controller={law}" for law in ("tdc", second)[::order]]
    out = ["--out", str(tmp_path / "both")]
    result = CliRunner().invoke(main, ["compare", "postcapture", *laws, *given, *out])
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {problem}"), result.stderr
    assert not list(tmp_path.iterdir())
