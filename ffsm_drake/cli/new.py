"""Command that starts a scenario: new."""

from pathlib import Path

import click

from ffsm_drake.cli.common import json_option, print_json


def _packages(ctx: click.Context, param: click.Parameter, values: tuple[str, ...]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for value in values:
        name, equals, folder = value.partition("=")
        if not (name and equals and folder):
            raise click.BadParameter(f"'{value}' must have the form NAME=FOLDER")
        if name in found:
            raise click.BadParameter(f"'{name}' is given more than once")
        found[name] = Path(folder)
    return found


@click.command()
@click.argument("directory", metavar="DIR", type=click.Path(path_type=Path))
@click.option("--urdf", required=True, type=click.Path(path_type=Path), metavar="FILE", help="URDF of base and arm.")
@click.option("--tip", metavar="FRAME", help="Link or frame that holds the target (default: end of the longest chain).")
@click.option(
    "--package", "packages", multiple=True, callback=_packages, metavar="NAME=FOLDER",
    help="Where package://NAME/ of a mesh is; repeatable. Folders above the URDF are looked through anyway.",
)  # fmt: skip
@click.option("--payload-mass", type=float, metavar="KG", help="Mass of the target (default: a quarter of the base's).")
@json_option
def new(
    directory: Path, urdf: Path, tip: str | None, packages: dict[str, Path], payload_mass: float | None, as_json: bool
) -> None:
    """Start a scenario for your own servicer from its URDF.

    DIR is a new folder. It gets DIR/<name of DIR>.yaml, commented and ready to run with every shipped controller, a
    copy of the URDF that Drake loads, and the meshes that can be drawn. It can be edited, moved or sent.

    \b
    Examples:
      ffsm new mine --urdf my_robot.urdf
      ffsm new mine --urdf my_robot.urdf --tip left_tool --payload-mass 30
      ffsm new mine --urdf my_robot.urdf --package my_robot_description=~/ws/src/my_robot_description
    """
    from ffsm_drake.control_design.first_scenario import new_scenario

    folders = {name: folder.expanduser() for name, folder in packages.items()}
    made = new_scenario(urdf, directory, tip=tip, packages=folders, payload_mass=payload_mass)
    if as_json:
        print_json(made.data())
    else:
        click.echo(made.summary())
