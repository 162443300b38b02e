"""The command ``ffsm audit``."""

import sys
from pathlib import Path

import click

from ffsm_drake.cli.common import EXIT_UNSTABLE, FiniteFloat, json_option, print_result

_file = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("log", type=_file)
@click.option(
    "--urdf",
    "--model",
    "urdf",
    type=_file,
    required=True,
    help="The model: URDF, MJCF, SDFormat or model directives.",
)
@click.option(
    "--column",
    "columns",
    multiple=True,
    metavar="NAME=COLUMN",
    help="The log's name of a column, such as base_quaternion_w=att_0; repeatable.",
)
@click.option(
    "--tolerance",
    type=FiniteFloat(min=0.0, min_open=True),
    default=1e-3,
    show_default=True,
    help="Of momentum and energy, as a share of what the bodies exchange.",
)
@json_option
def audit(log: Path, urdf: Path, columns: tuple[str, ...], tolerance: float, as_json: bool) -> None:
    """Check another simulator's log: is it physics?

    LOG is CSV, netCDF or MATLAB with named columns: time, quaternion, position and velocities of
    the base, position and rate of each joint, and efforts if they are known. MCAP with standard
    messages of ROS 2 or Foxglove is read too. The audit finds frames, units and the order of
    joints, then checks momentum and energy with the model. Exit code 3: a check does not hold.

    \b
    Examples:
      ffsm audit mujoco.csv --urdf servicer.urdf
      ffsm audit log.nc --urdf servicer.urdf --column time=t_sim --column joint_1=shoulder
      ffsm audit run.mcap --urdf servicer.urdf --column base=base_link
    """
    from ffsm_drake.plugins.audit.verdict import audit as check

    for text in columns:
        if not all(text.partition("=")):
            raise click.BadParameter(f"must be NAME=COLUMN, not '{text}'", param_hint="--column")
    named = dict(text.split("=", 1) for text in columns)
    found = check(log, urdf, columns=named, tolerance=tolerance)
    print_result(as_json, found.as_data(), str(found))
    sys.exit(0 if found.is_physics else EXIT_UNSTABLE)
