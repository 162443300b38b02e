"""The command ``ffsm export``."""

from pathlib import Path

import click

from ffsm_drake.cli.common import run_argument


@click.command()
@run_argument
@click.option(
    "--to",
    "file",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Its extension selects the format: .mat, .csv, .parquet, .mcap, .aem, .oem or .fmu.",
)
@click.option(
    "--part",
    type=click.Choice(["plant", "controller"]),
    help="For an .fmu: its contents (default: plant).",
)
@click.option("--ros2", is_flag=True, help="For an .mcap: write ROS 2 messages.")
def export(run: Path, file: Path, part: str | None, ros2: bool) -> None:
    """Write a recorded run's series, or a scenario as an FMU, for other programs.

    An .fmu (FMI 3.0, co-simulation) is made from a scenario, by name or file, or from a run's.

    \b
    Examples:
      ffsm export out/postcapture --to run.mat
      ffsm export out/postcapture --to run.csv
      ffsm export postcapture --to law.fmu --part controller
    """
    from ffsm_drake.common.errors import FfsmError
    from ffsm_drake.plugins.exports.tables import export as write
    from ffsm_drake.runs.record import RunRecord

    if ros2 and file.suffix != ".mcap":
        raise FfsmError(f"--ros2: only for an .mcap, not for '{file}'")
    if part and file.suffix != ".fmu":
        raise FfsmError(f"--part: only for an .fmu, not for '{file}'")
    if file.suffix == ".fmu":
        from ffsm_drake.plugins.exports.fmu import export as write_fmu
        from ffsm_drake.scenario import load_scenario

        write_fmu(load_scenario(str(run)), file, part or "plant")
    else:
        write(RunRecord.load(run), file, ros2=ros2)
    click.echo(f"Written to {file}")
