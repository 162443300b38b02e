"""The command about the paper: reproduce."""

from pathlib import Path

import click

from ffsm_drake.cli.common import out_option
from ffsm_drake.cli.progress import ProgressLine
from ffsm_drake.plugins.paper import PARTS


@click.command()
@click.argument("what", type=click.Choice(PARTS), default="all")
@out_option(default=Path("out/reproduction"), show_default=True)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Noise seeds per cell.",
)
def reproduce(what: str, out: Path, seeds: int) -> None:
    """Recompute the paper's table and figures, and evaluate its claims.

    \b
    Examples:
      ffsm reproduce                 everything, in out/reproduction/reproduction.html
      ffsm reproduce table2 --seeds 5
    """
    from ffsm_drake.common.numbers import counted
    from ffsm_drake.common.steps import step
    from ffsm_drake.plugins.paper import reproduce as reproduce_paper

    reached = ["the first runs"]

    def show(done: int, total: int, following: str) -> None:
        reached[0] = f"{done} of {counted(total, 'run')}: {following}"
        line.show(reached[0], last=done == total)

    with step(lambda: reached[0]), ProgressLine() as line:
        main_file = reproduce_paper(
            what, out, seeds=seeds, workers=2, progress=show, tell=click.echo
        )
    click.echo(f"Written to {out}; open {main_file}")
