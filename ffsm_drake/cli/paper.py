"""Commands about the paper: reproduce, noise."""

from pathlib import Path

import click

from ffsm_drake.cli.common import batch_progress, out_option


@click.command()
@click.argument("what", type=click.Choice(("table2", "fig3", "fig4", "fig5", "all")), default="all")
@out_option(default=Path("out/reproduction"), show_default=True)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=3,
    show_default=True,
    help="Seeds of the noise per cell.",
)
def reproduce(what: str, out: Path, seeds: int) -> None:
    """Recompute the paper's table and figures, and evaluate its claims.

    \b
    Examples:
      ffsm reproduce                 everything, in out/reproduction/reproduction.html
      ffsm reproduce table2 --seeds 5
    """
    from ffsm_drake.studies.paper import reproduce as reproduce_paper

    main_file = reproduce_paper(what, out, seeds=seeds, workers=2, progress=batch_progress)
    click.echo(f"Written to {out}; open {main_file}")


@click.command()
@out_option(default=Path("out/noise"), show_default=True)
@click.option(
    "--seeds",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Seeds of the noise per point.",
)
def noise(out: Path, seeds: int) -> None:
    """What the published gains cost with real sensors: error and effort against noise, all
    controllers, both estimates.

    Writes noise.md, noise.csv, noise.png and noise.svg.

    \b
    Example:
      ffsm noise --seeds 3
    """
    from ffsm_drake.studies.noise import study_noise, write_study

    written = write_study(study_noise(seeds=seeds, workers=2, progress=batch_progress), out)
    click.echo(written.read_text(encoding="utf-8"))
    click.echo(f"Written to {out}; open {written.with_suffix('.png')}")
