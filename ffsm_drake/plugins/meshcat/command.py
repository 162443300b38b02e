"""The command ``ffsm replay``."""

import webbrowser
from pathlib import Path

import click

from ffsm_drake.cli.common import out_option, run_argument


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
    from ffsm_drake.plugins.meshcat.recording import write_recording
    from ffsm_drake.runs.record import RunRecord

    file = out or run / "recording.html"
    record = RunRecord.load(run)
    check_writable(file.parent)
    write_recording(record, file, speed=speed, ghost=ghost, path=path, forces=forces)
    click.echo(f"Written to {file}")
    if opened and not webbrowser.open(file.resolve().as_uri()):
        click.echo("no browser was found; open the page yourself", err=True)
