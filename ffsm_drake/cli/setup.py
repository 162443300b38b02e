"""Commands around scenarios: scenarios, validate, schema, completion."""

import os
import sys
import warnings
from pathlib import Path
from typing import Any

import click

from ffsm_drake.cli.common import (
    EXIT_BAD_INPUT,
    complete_scenario,
    json_option,
    located_errors,
    override_options,
    print_json,
    print_result,
    rehearsal_option,
)


@click.command()
@click.argument("name", required=False, shell_complete=complete_scenario)
@click.option(
    "--full", is_flag=True, help="Print every key, including defaults and inherited ones."
)
@json_option
def scenarios(name: str | None, full: bool, as_json: bool) -> None:
    """List the shipped scenarios, or print one as YAML to start from.

    \b
    Examples:
      ffsm scenarios
      ffsm scenarios postcapture > mine.yaml
      ffsm scenarios flight_sensors --full
    """
    from ffsm_drake.scenario import (
        find_scenario,
        load_scenario,
        scenario_to_dict,
        scenario_to_yaml,
        shipped_scenarios,
    )

    if name is not None:
        scenario = load_scenario(name)
        if as_json:
            print_json(scenario_to_dict(scenario))
        elif full:
            click.echo(scenario_to_yaml(scenario), nl=False)
        else:
            click.echo(find_scenario(name).read_text(encoding="utf-8"), nl=False)
        return
    if full:
        raise click.UsageError("--full: needs a scenario; write ffsm scenarios NAME --full")
    found = {name: load_scenario(name).description for name in shipped_scenarios()}
    width = max(map(len, found)) + 2
    lines = [f"{name:<{width}}{description}" for name, description in found.items()]
    print_result(as_json, found, "\n".join(lines))


@click.command()
@click.argument(
    "scenarios",
    nargs=-1,
    default=["postcapture"],
    metavar="[SCENARIO]...",
    shell_complete=complete_scenario,
)
@override_options()
@rehearsal_option
@json_option
def validate(
    scenarios: tuple[str, ...], overrides: tuple[str, ...], rehearsal: bool, as_json: bool
) -> None:
    """Check scenarios, their models and controllers, and print a verdict on the mission.

    A scenario is valid if it loads, its model and controller can be built, and it can start. The
    verdict on the mission follows, one line for each check. Exits with 2 if a scenario cannot be
    used. An unstable loop, or a plan beyond joint limits, gives a warning and exit code 0. With
    --json, 'warnings' lists the warnings.

    \b
    Examples:
      ffsm validate mine.yaml
      ffsm validate postcapture --set payload.truth.mass=-5
    """
    from ffsm_drake.common.errors import FfsmError
    from ffsm_drake.common.numbers import counted
    from ffsm_drake.runs.exceeded_limits import Closest
    from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

    results: dict[str, dict[str, Any]] = {}
    for name in scenarios:
        try:
            with located_errors(name, overrides):
                found, lines = _validated(name, overrides, rehearsal=rehearsal)
        except FfsmError as error:
            results[name] = {"valid": False, "error": str(error)}
            if not as_json:
                click.echo(f"error: {error}", err=True)
            continue
        results[name] = found
        if as_json:
            continue
        for text in found["warnings"]:
            click.echo(f"warning: {name}: {text}", err=True)
        nearest = "".join(f"; plan: {Closest(**each)}" for each in found.get("nearest", ()))
        joints = counted(len(found["coordinates"]) - NUM_BASE_VELOCITIES, "joint")
        click.echo(f"{name}: valid; {found['controller']}, free base and {joints}{nearest}")
        for line in (*found["faults"], *lines):
            click.echo(f"{name}: {line}")
    if as_json:
        print_json(results)
    sys.exit(0 if all(result["valid"] for result in results.values()) else EXIT_BAD_INPUT)


def _validated(
    name: str, overrides: tuple[str, ...], *, rehearsal: bool
) -> tuple[dict[str, Any], list[str]]:
    """Return the results of ``validate`` for a scenario, as plain data, and lines on the
    mission.
    """
    from ffsm_drake.runs.judge import JUDGES
    from ffsm_drake.runs.simulate import check_start
    from ffsm_drake.scenario import load_scenario
    from ffsm_drake.spacecraft.plant import check_pictures
    from ffsm_drake.systems.faults import faults_in_words

    found = dict[str, Any](warnings=[])
    lines = ["no installed plug-in evaluates the mission"]
    with warnings.catch_warnings(record=True) as caught:
        scenario = load_scenario(name, overrides)
        check_pictures(scenario.model)
        loop = check_start(scenario)
        if (judge := JUDGES.first()) is not None:
            found, lines = judge.validate(loop.scenario, rehearsal=rehearsal)
    told = [*(str(item.message) for item in caught), *found["warnings"]]
    if judge is not None:
        told += judge.layers(name, overrides)
    return {
        "valid": True,
        "controller": loop.scenario.controller,
        "coordinates": list(loop.coordinates.names),
        **found,
        "faults": list(faults_in_words(scenario, loop.coordinates)),
        "warnings": list(dict.fromkeys(told)),
    }, lines


@click.command()
def schema() -> None:
    """Print the JSON Schema of scenario files: unit and meaning of every key, for editors.

    \b
    Example:
      ffsm schema > scenario.schema.json
      # first line of a scenario, for editors:  # yaml-language-server: $schema=scenario.schema.json
    """
    from ffsm_drake.scenario.json_schema import scenario_schema
    from ffsm_drake.systems.controllers import gains_schema
    from ffsm_drake.systems.faults import kind_names

    data = scenario_schema()
    data["properties"]["controllers"]["properties"] = gains_schema()
    faults = data["properties"]["faults"]["anyOf"][0]["properties"]
    faults["events"]["additionalProperties"]["properties"]["kind"]["enum"] = kind_names()
    print_json(data)


@click.command()
@click.argument("shell", type=click.Choice(("bash", "zsh", "fish")), required=False)
def completion(shell: str | None) -> None:
    """Print a shell's completion script for ffsm's commands, options and scenarios.

    \b
    Examples:
      ffsm completion bash >> ~/.bashrc
      ffsm completion zsh >> ~/.zshrc
      ffsm completion fish > ~/.config/fish/completions/ffsm.fish
    """
    from click.shell_completion import get_completion_class

    shell = shell or Path(os.environ.get("SHELL", "bash")).name
    completer = get_completion_class(shell)
    if completer is None:
        raise click.UsageError(f"shell '{shell}' is not known; choose one of bash, zsh, fish")
    ffsm = click.get_current_context().find_root().command
    click.echo(completer(ffsm, {}, "ffsm", "_FFSM_COMPLETE").source())
