"""Commands around scenarios and the installation: new, scenarios, validate, schema, doctor,
completion.
"""

import dataclasses
import os
import sys
import warnings
from contextlib import suppress
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


def _packages(
    ctx: click.Context, param: click.Parameter, values: tuple[str, ...]
) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for value in values:
        name, equals, folder = value.partition("=")
        if not (name and equals and folder):
            raise click.BadParameter(f"'{value}' must have the form NAME=FOLDER")
        if name in found:
            raise click.BadParameter(f"'{name}' is given more than once")
        found[name] = Path(folder).expanduser()
    return found


def _sizes(
    ctx: click.Context, param: click.Parameter, value: str | None
) -> tuple[float, ...] | None:
    try:
        return None if value is None else tuple(float(part) for part in value.split(","))
    except ValueError:
        raise click.BadParameter(
            f"'{value}' must be a side in m, or three such as 1.2,1.2,1.5"
        ) from None


def _target(value: str | None) -> tuple[float | None, Path | None]:
    """A target's mass, kg, or its file."""
    try:
        return (None if value is None else float(value)), None
    except ValueError:
        return None, Path(value or "")


@click.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--urdf",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="URDF of base and arm.",
)
@click.option(
    "--tip",
    metavar="FRAME",
    help="Link or frame that holds the target (default: the end of the longest chain).",
)
@click.option(
    "--package",
    "packages",
    multiple=True,
    callback=_packages,
    metavar="NAME=FOLDER",
    help="Folder of package://NAME/ in mesh addresses; repeatable. Folders above the URDF are "
    "always searched.",
)
@click.option(
    "--target",
    "--payload-mass",
    "target",
    metavar="KG|FILE",
    help="The target: the mass of a 1 m cube, or a URDF (default: a cube with a quarter of the "
    "base's mass).",
)
@click.option(
    "--bus-mass",
    type=float,
    metavar="KG",
    help="Mount an arm without a base on a box of this mass.",
)
@click.option(
    "--bus-size",
    callback=_sizes,
    metavar="M|X,Y,Z",
    help="Sides of that box (default: a cube of 50 kg/m^3).",
)
@click.option(
    "--sensors",
    metavar="NAME",
    help="Sensors of a shipped scenario: flight, slow, ... (default: the paper's, near perfect).",
)
@click.option("--thrusters", metavar="LAYOUT", help="On/off thrusters: 12x1N, 12x5N or 16x22N.")
@click.option(
    "--wheels",
    metavar="N[xTORQUENm]",
    help="Reaction wheels, sized for the load unless a torque is given: 4, or 4x0.5Nm.",
)
@click.option("--panels", metavar="NxMASSkg", help="Flexible solar panels: 2x5kg.")
@click.option(
    "--capture",
    metavar="RATE",
    help="Approach and grasp a target tumbling at this rate, such as 3deg/s or 0.05rad/s.",
)
@click.option(
    "--driven",
    metavar="GROUPS",
    help="Actuated groups: all (default), base_rotation,joints, or joints.",
)
@json_option
def new(
    directory: Path,
    urdf: Path,
    tip: str | None,
    packages: dict[str, Path],
    target: str | None,
    bus_mass: float | None,
    bus_size: tuple[float, ...] | None,
    as_json: bool,
    **words: str | None,
) -> None:
    """Start a scenario for your own servicer from its URDF.

    DIR is a new folder. It gets DIR/<name of DIR>.yaml, commented and ready to run with every
    shipped controller, a copy of the URDF for Drake, and its meshes. The folder can be edited,
    moved or sent.

    \b
    Examples:
      ffsm new mine --urdf my_robot.urdf
      ffsm new mine --urdf my_robot.urdf --tip left_tool --target 30
      ffsm new mine --urdf ur5.urdf --bus-mass 400 --bus-size 1.2,1.2,1.5 --target stage.urdf
      ffsm new mine --urdf my_robot.urdf --sensors flight --thrusters 12x5N --wheels 4
          --panels 2x5kg --capture 3deg/s
      ffsm new mine --urdf my_robot.urdf --package
      my_robot_description=~/ws/src/my_robot_description
    """
    from ffsm_drake.plugins.design.verdict import verdict
    from ffsm_drake.plugins.new.asked import Asked
    from ffsm_drake.plugins.new.first_scenario import new_scenario
    from ffsm_drake.scenario import load_scenario

    mass, file = _target(target)
    made = new_scenario(
        urdf,
        directory,
        tip=tip,
        packages=packages,
        payload_mass=mass,
        target=file,
        bus_mass=bus_mass,
        bus_size=bus_size,
        asked=Asked.parsed(**words),
    )
    mission = verdict(load_scenario(str(made.scenario_file)))
    text = "\n".join([made.summary(), "", *mission.lines, mission.conclusion])
    print_result(as_json, made.data() | {"mission": mission.as_data()}, text)


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
        raise click.UsageError("--full: name the scenario")
    found = {name: load_scenario(name).description for name in shipped_scenarios()}
    width = max(map(len, found)) + 2
    lines = [f"{name:<{width}}{description}" for name, description in found.items()]
    print_result(as_json, found, "\n".join(lines))


@click.command()
@click.argument(
    "scenarios", nargs=-1, required=True, metavar="SCENARIO...", shell_complete=complete_scenario
)
@override_options()
@rehearsal_option
@json_option
def validate(
    scenarios: tuple[str, ...], overrides: tuple[str, ...], rehearsal: bool, as_json: bool
) -> None:
    """Check scenarios, their models and controllers, and print a verdict on the mission.

    Valid means: it loads, its model and controller can be built, and it starts. The verdict on the
    whole mission follows, in lines with their scope. Exits with 2 if a scenario cannot be used. An
    unstable loop, or a plan beyond the joints' limits, can be run: it gives a warning and exit code
    0. With --json, 'warnings' lists them.

    \b
    Examples:
      ffsm validate mine.yaml
      ffsm validate postcapture --set payload.truth.mass=-5
    """
    from ffsm_drake.common.errors import FfsmError
    from ffsm_drake.plugins.capture.momentum import momentum_lines
    from ffsm_drake.runs.limits import Closest
    from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

    results: dict[str, dict[str, Any]] = {}
    for name in scenarios:
        try:
            with located_errors(name, overrides):
                found = results[name] = _validated(name, overrides, rehearsal=rehearsal)
        except FfsmError as error:
            results[name] = {"valid": False, "error": str(error)}
            if not as_json:
                click.echo(f"error: {error}", err=True)
            continue
        if as_json:
            continue
        for text in found["warnings"]:
            click.echo(f"warning: {name}: {text}", err=True)
        nearest = "".join(f"; plan: {Closest(**each)}" for each in found["nearest"])
        joints = len(found["coordinates"]) - NUM_BASE_VELOCITIES
        click.echo(f"{name}: valid; {found['controller']}, free base and {joints} joints{nearest}")
        mission = found["mission"]
        for line in (
            *mission["lines"],
            mission["conclusion"],
            *momentum_lines(found.get("momentum_budget")),
        ):
            click.echo(f"{name}: {line}")
    if as_json:
        print_json(results)
    sys.exit(0 if all(result["valid"] for result in results.values()) else EXIT_BAD_INPUT)


def _validated(name: str, overrides: tuple[str, ...], *, rehearsal: bool) -> dict[str, Any]:
    """The results of ``validate`` for a scenario, as plain data."""
    from ffsm_drake.common.errors import ModelError
    from ffsm_drake.plugins.capture.momentum import momentum_budget
    from ffsm_drake.plugins.design.remarks import plan_clearance, plan_remarks
    from ffsm_drake.plugins.design.verdict import verdict
    from ffsm_drake.runs.simulate import prepare
    from ffsm_drake.scenario import load_scenario
    from ffsm_drake.spacecraft.plant import check_pictures

    closest = []
    with warnings.catch_warnings(record=True) as caught:
        scenario = load_scenario(name, overrides)
        check_pictures(scenario.model)
        rollout = prepare(scenario, check_stability=False)
        rollout.check()
        loop = rollout.loop
        with suppress(ModelError):  # already among the warnings
            closest = plan_clearance(scenario)
        rollout.release()
        budget = momentum_budget(loop.scenario)
        remarks = plan_remarks(loop.scenario)
        mission = verdict(loop.scenario, rehearsal=rehearsal)
    return {
        "valid": True,
        "controller": loop.scenario.controller,
        "coordinates": list(loop.coordinates.names),
        "nearest": [dataclasses.asdict(each) for each in closest],
        **({} if budget is None else {"momentum_budget": dataclasses.asdict(budget)}),
        "mission": mission.as_data(),
        "warnings": list(
            dict.fromkeys([*(str(item.message) for item in caught), *remarks, *mission.warnings])
        ),
    }


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

    data = scenario_schema()
    data["properties"]["controllers"]["properties"] = gains_schema()
    print_json(data)


@click.command()
@json_option
def doctor(as_json: bool) -> None:
    """Check the installation: versions, models, controllers, a short run, the browser, Graphviz.

    Exits with 2 when something required is missing.

    \b
    Example:
      ffsm doctor
    """
    from ffsm_drake.cli.doctor import examine

    checks = examine()
    lines = [f"[{check['status']:^7}] {check['name']}: {check['detail']}" for check in checks]
    print_result(as_json, checks, "\n".join(lines))
    sys.exit(EXIT_BAD_INPUT if any(check["status"] == "missing" for check in checks) else 0)


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
