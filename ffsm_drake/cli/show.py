"""Commands that draw: plot, diagram, replay."""

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import FiniteFloat, out_option, run_argument, scenario_options

if TYPE_CHECKING:
    from ffsm_drake.scenario import Scenario


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
    from ffsm_drake.show.block_diagram import closed_loop_dot, write_diagram

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


@click.command()
@run_argument
@click.option("--speed", type=float, default=1.0, show_default=True, help="Multiple of real time.")
@click.option(
    "--ghost/--no-ghost", default=True, show_default=True, help="The target posture, translucent."
)
@click.option("--path/--no-path", default=True, show_default=True, help="The end effector's path.")
@click.option(
    "--forces/--no-forces",
    default=True,
    show_default=True,
    help="Control and disturbance as arrows.",
)
@click.option("--open", "--live", "opened", is_flag=True, help="Also open the page in the browser.")
@out_option("FILE", help="Default: recording.html in RUN_DIR.")
def replay(
    run: Path, speed: float, ghost: bool, path: bool, forces: bool, opened: bool, out: Path | None
) -> None:
    """Write a page that plays back a recorded run, to open offline and to send.

    \b
    Examples:
      ffsm replay out/postcapture
      ffsm replay out/postcapture --speed 2 --no-ghost --out slides/motion.html
      ffsm replay out/postcapture --open
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.show.meshcat import write_recording

    file = out or run / "recording.html"
    record = RunRecord.load(run)
    check_writable(file.parent)
    write_recording(record, file, speed=speed, ghost=ghost, path=path, forces=forces)
    click.echo(f"Written to {file}")
    if opened and not webbrowser.open(file.resolve().as_uri()):
        click.echo("no browser was found; open the page yourself", err=True)
