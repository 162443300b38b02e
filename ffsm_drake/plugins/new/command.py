"""The command new."""

from pathlib import Path

import click

from ffsm_drake.cli.common import json_option, print_result


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
