"""The command new."""

import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from ffsm_drake.cli.common import EXIT_GOOD, EXIT_UNSTABLE, json_option, print_result


def _packages(
    ctx: click.Context, param: click.Parameter, values: tuple[str, ...]
) -> dict[str, Path]:
    return {name: Path(value).expanduser() for name, value in _named(ctx, param, values).items()}


def _named(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    found: dict[str, str] = {}
    for each in values:
        name, equals, value = each.partition("=")
        if not (name and equals and value):
            raise click.BadParameter(f"'{each}' must have the form {param.metavar}")
        if name in found:
            raise click.BadParameter(f"'{name}' is given more than once")
        found[name] = value
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


_CUBE = re.compile(r"([\d.eE+-]+)(?:kg)?(?:,([\d.eE+-]+)m)?")


def _target(value: str) -> tuple[float | None, float | None, Path | None]:
    """Return the mass (kg) and side (m) of a target, or its file."""
    if found := _CUBE.fullmatch(value):
        with suppress(ValueError):
            return float(found[1]), None if found[2] is None else float(found[2]), None
    return None, None, Path(value)


@click.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option(
    "--urdf",
    "--model",
    "urdf",
    required=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Base and arm: URDF, xacro, MJCF or SDFormat.",
)
@click.option(
    "--xacro-arg",
    "xacro_args",
    multiple=True,
    callback=_named,
    metavar="NAME=VALUE",
    help="An argument of a xacro file; repeatable.",
)
@click.option(
    "--trust",
    is_flag=True,
    help="Allow xacro files load_yaml, environment variables, and files outside the folder of the "
    "model and of packages.",
)
@click.option(
    "--tip",
    metavar="FRAME",
    help="Link or frame that holds the target (default: the end of the longest chain).",
)
@click.option(
    "--tips",
    metavar="FRAME,FRAME",
    help="Hands of two arms that hold the target together.",
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
    metavar="KG[,M]|FILE",
    help="The target: mass and side of a cube, such as 20kg,0.3m, or a model file (default: a "
    "quarter of the base's mass, and no longer than the arm).",
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
@click.option(
    "--thrusters",
    metavar="N[xTHRUSTN]",
    help="12 or 16 on/off thrusters, sized for the base unless a thrust is given: 12, 12x5N, "
    "12x0.1N.",
)
@click.option(
    "--wheels",
    metavar="N[xTORQUENm][,MOMENTUMNms][,SPEEDrpm]",
    help="Reaction wheels, sized unless a data sheet's values are given: 4, 4x0.5Nm, "
    "3x0.02Nm,0.5Nms,6000rpm.",
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
@click.option(
    "--friction",
    is_flag=True,
    help="Damping and friction of the model's joints, as friction of their drives.",
)
@json_option
def new(
    directory: Path,
    urdf: Path,
    target: str | None,
    as_json: bool,
    friction: bool,
    **options: Any,
) -> None:
    """Start a scenario for your own servicer from its model file.

    DIR is a new folder for DIR/<name of DIR>.yaml, commented and ready to run, a copy of the
    URDF for Drake, and its meshes. The folder can be edited, moved or sent. The command runs the
    mission once. Exit code 0: it is expected to go as planned, or the verdict is uncertain; 3: it
    is not. The last line then names an option that helps, if the command finds one.

    \b
    Examples:
      ffsm new mine --urdf my_robot.urdf
      ffsm new mine --urdf my_robot.urdf --tip left_tool --target 30
      ffsm new mine --model servicer.xml --target 20kg,0.3m
      ffsm new mine --urdf two_arms.urdf --tips left_hand,right_hand
      ffsm new mine --urdf ur5.urdf --bus-mass 400 --bus-size 1.2,1.2,1.5 --target stage.urdf
      ffsm new mine --urdf my_robot.urdf --sensors flight --thrusters 12x5N --wheels 4
          --panels 2x5kg --capture 3deg/s
      ffsm new mine --urdf my_robot.urdf --package
      my_robot_description=~/ws/src/my_robot_description
    """
    from ffsm_drake.plugins.new.asked import ASKED, Asked
    from ffsm_drake.plugins.new.first_scenario import new_scenario

    mass, side, file = (None, None, None) if target is None else _target(target)
    words = {name: options.pop(name) for name in ASKED}
    made = new_scenario(
        urdf, directory, payload_mass=mass, payload_size=side, target=file,
        asked=Asked.parsed(friction=friction, **words), rehearse=True, **options,
    )  # fmt: skip
    mission = made.mission
    assert mission is not None
    lines = [made.summary(), "", *mission.lines, mission.conclusion]
    if not made.is_as_planned:
        helps = f"what helps: {made.remedy}: with it, the mission is expected to go as planned"
        if not made.remedy:
            helps = f"no single change that was tried helps ({', '.join(made.tried)})"
        lines.append(helps)
    print_result(as_json, made.data() | {"mission": mission.as_data()}, "\n".join(lines))
    sys.exit(EXIT_GOOD if made.is_as_planned else EXIT_UNSTABLE)
