"""The command ``ffsm export``."""

from pathlib import Path
from typing import Any

import click

from ffsm_drake.cli.common import complete_scenario, located_errors, override_options


@click.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("scenario", metavar="RUN_DIR|SCENARIO", shell_complete=complete_scenario)
@override_options()
@click.option(
    "--float32",
    is_flag=True,
    help="For a .c, or the controller in an .fmu: numbers in single precision.",
)
@click.option("--table", is_flag=True, help="For a .c or .fmu: the reference as a table.")
@click.option(
    "--kit",
    is_flag=True,
    help="For a .c: also a Makefile, a replay, a fuzz target and a UDP client.",
)
@click.option(
    "--part",
    type=click.Choice(["plant", "controller"]),
    help="For an .fmu: its contents (default: plant).",
)
@click.option("--ros2", is_flag=True, help="For an .mcap: messages of ROS 2.")
def export(file: Path, scenario: str, overrides: tuple[str, ...], **options: Any) -> None:
    """Write a control law as C code, a scenario as an FMU, or a run's series for other programs.

    The ending of FILE selects the format. From a scenario, or a run's: .c, .fmu. From a run: .mat,
    .csv, .parquet, .mcap, .aem, .oem. A .c comes with a header of the same name.

    \b
    Examples:
      ffsm export law.c postcapture --kit
      ffsm export law.fmu postcapture --part controller
      ffsm export run.mat out/postcapture
    """
    from ffsm_drake.common.errors import FfsmError
    from ffsm_drake.plugins.exports.export import SCENARIO_EXPORTERS
    from ffsm_drake.plugins.exports.export import export as write
    from ffsm_drake.scenario import load_scenario

    given: Any = scenario
    if file.suffix[1:] in SCENARIO_EXPORTERS.offers():
        with located_errors(scenario, overrides):
            given = load_scenario(scenario, overrides)
    elif overrides:
        raise FfsmError(
            "--controller, --set, --seed: only for a .c or .fmu, which are made from a scenario"
        )
    for line in write(file, given, **options):
        click.echo(line)
