"""The command that draws: plot."""

from pathlib import Path

import click

from ffsm_drake.cli.common import FiniteFloat, out_option


@click.command()
@click.argument(
    "runs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RUN_DIR..."
)
@click.option(
    "--format",
    "formats",
    default="png",
    show_default=True,
    metavar="KIND,...",
    help="One or several of png, pdf and svg, separated by commas.",
)
@click.option(
    "--width",
    type=FiniteFloat(min=5.0, max=50.0),
    metavar="INCHES",
    help="Fit the figures, with three panels side by side, to a page's width from 5 inches on, "
    "such as 7.16 of two columns: small labels, no headings.",
)
@out_option(help="Default: RUN_DIR; of several runs the folder that holds them all.")
def plot(runs: tuple[Path, ...], formats: str, width: float | None, out: Path | None) -> None:
    """Draw the figures of a recorded run, or of several overlaid: those given, or in a folder.

    \b
    Examples:
      ffsm plot out/postcapture
      ffsm plot out/compare_paper
      ffsm plot out/compare_paper/tdc out/compare_paper/tde_aismc --out out/figures
      ffsm plot out/postcapture --format pdf --width 7.16
    """
    from ffsm_drake.common.errors import RecordError
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.scenario import MANIFEST_FILE
    from ffsm_drake.show.figures.run import FORMATS, save_figures

    kinds = tuple(dict.fromkeys(kind.strip().lower() for kind in formats.split(",")))
    if unknown := [kind for kind in kinds if kind not in FORMATS]:
        raise click.UsageError(
            f"--format: '{unknown[0]}' is unknown; give one or several of {', '.join(FORMATS)}"
        )
    found = list[Path]()
    for run in runs:
        files = [*run.glob(MANIFEST_FILE)] or sorted(run.glob(f"*/{MANIFEST_FILE}"))
        found += [file.parent for file in files]
        if not files and len(runs) > 1:
            click.echo(f"{run}: contains no run; skipped", err=True)
    found = found or [runs[0]]
    if out is None and len({run.parent for run in found}) > 1:
        raise click.UsageError(
            "--out: is missing, and the runs are in different folders; give "
            "the folder for the "
            "figures"
        )
    directory = out or (found[0] if len(found) == 1 else found[0].parent)
    check_writable(directory)
    records = [RunRecord.load(run) for run in found]
    for run, record in zip(found, records, strict=True):
        if (
            record.dataset.coordinate.values.tolist()
            != records[0].dataset.coordinate.values.tolist()
        ):
            raise RecordError(f"{run}: has other joints than {found[0]}; plot them separately")
    written = save_figures(records, directory, kinds, width=width)
    click.echo(f"Written to {directory}: {', '.join(path.name for path in written)}")
