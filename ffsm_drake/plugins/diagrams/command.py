"""The command ``ffsm diagram``."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import out_option, scenario_options

if TYPE_CHECKING:
    from ffsm_drake.scenario import Scenario


@click.command()
@scenario_options
@click.option("--logged", is_flag=True, help="Also draw logged outputs and the visualizer.")
@out_option("FILE", help="Write FILE.dot and FILE.svg.")
def diagram(scenario: "Scenario", logged: bool, out: Path | None) -> None:
    """Print the closed loop's block diagram as Graphviz text, or write it to files.

    \b
    Examples:
      ffsm diagram
      ffsm diagram flight_sensors --controller pd_plus --out out/loop.svg
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.plugins.diagrams.block_diagram import closed_loop_dot, write_diagram

    if out is not None:
        if not out.name:
            raise click.UsageError(f"--out: '{out}' is not a file name; give one, such as loop.svg")
        check_writable(out.parent)
    dot = closed_loop_dot(scenario, logged=logged)
    if out is None:
        click.echo(dot)
        return
    remark = write_diagram(dot, out.with_suffix(".dot"))
    click.echo(
        f"Written to {out.with_suffix('.dot')}"
        + ("" if remark else f" and {out.with_suffix('.svg').name}")
    )
    if remark:
        click.echo(remark, err=True)
