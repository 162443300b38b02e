"""The command line ``ffsm``: parses, calls, prints."""

import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from ffsm_drake.errors import FfsmError, warnings_as_lines
from ffsm_drake.files import write_text, written_whole
from ffsm_drake.record import RunRecord, to_json
from ffsm_drake.scenario import CONTROLLER_NAMES, Scenario, load_scenario

EXIT_BAD_INPUT, EXIT_UNSTABLE, EXIT_INTERRUPTED = 2, 3, 130


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(package_name="ffsm-drake")
def main() -> None:
    """Simulate and judge controllers of a free-flying space manipulator after debris capture.

    Exit codes: 0 good, 2 bad input, 3 diverged or unstable, 130 interrupted.
    """


def _reports_errors(command: Callable[..., Any]) -> Callable[..., Any]:
    """Turn the package's errors into one line and exit code 2, and its warnings into one line each."""

    @functools.wraps(command)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        with warnings_as_lines():
            try:
                return command(*args, **kwargs)
            except FfsmError as error:
                click.echo(f"error: {error}", err=True)
                sys.exit(EXIT_BAD_INPUT)

    return wrapped


def _scenario_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """SCENARIO, --controller and --set, handed on as one loaded ``scenario``."""

    @click.argument("scenario", default="postcapture", metavar="[SCENARIO]")
    @click.option("--controller", type=click.Choice(CONTROLLER_NAMES), help="Default: the one that the scenario names.")
    @click.option(
        "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Override a scenario value; repeatable."
    )
    @functools.wraps(command)
    def wrapped(scenario: str, controller: str | None, overrides: tuple[str, ...], **rest: Any) -> Any:
        chosen = [f"controller={controller}"] if controller else []
        return command(scenario=load_scenario(scenario, [*overrides, *chosen]), **rest)

    return wrapped


@main.command()
@_reports_errors
@_scenario_options
@click.option("--out", type=click.Path(path_type=Path), help="Write stability.png here.")
def stability(scenario: Scenario, out: Path | None) -> None:
    """Margins of the sampled loop along the planned motion, without a simulation.

    SCENARIO is a shipped name or a YAML file (default: postcapture). Exits with 3 when the scenario is unstable.

    \b
    Examples:
      ffsm stability
      ffsm stability paper --set simulator_config.integration_scheme=runge_kutta3
      ffsm stability --set payload.belief.mass=125 --out out/stability
    """
    from ffsm_drake.stability import assess
    from ffsm_drake.stability.report import margins_table, plot_margins

    margins = assess(scenario)
    click.echo(margins_table(margins))
    if out is not None:
        path = out / "stability.png"
        with written_whole(path) as temporary:
            plot_margins(margins).savefig(temporary, dpi=130)
        click.echo(f"Written to {path}")
    sys.exit(0 if margins.is_stable else EXIT_UNSTABLE)


@main.command()
@_reports_errors
@click.argument("run", type=click.Path(path_type=Path), metavar="RUN_DIR")
@click.option(
    "--out", type=click.Path(path_type=Path), help="Where analysis.png and analysis.json go (default: RUN_DIR)."
)
def analyze(run: Path, out: Path | None) -> None:
    """What the paper proves and claims, checked on a recorded run.

    RUN_DIR is a folder that holds record.nc and manifest.json. Prints each finding, and draws them.

    \b
    Example:
      python examples/postcapture.py --out out/mine
      ffsm analyze out/mine
    """
    from ffsm_drake.analysis import analyze as analyze_record
    from ffsm_drake.analysis import plot_analysis

    analysis = analyze_record(RunRecord.load(run))
    click.echo(str(analysis))
    directory = out or run
    findings = {finding.key: dataclasses.asdict(finding) for finding in analysis.findings}
    write_text(directory / "analysis.json", to_json(findings))
    with written_whole(directory / "analysis.png") as temporary:
        plot_analysis(analysis).savefig(temporary, dpi=130)
    click.echo(f"Written to {directory}: analysis.json, analysis.png")


@main.command()
@_reports_errors
@click.argument("what", type=click.Choice(("table2", "fig3", "fig4", "fig5", "all")), default="all")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/reproduction"), show_default=True)
@click.option("--seeds", type=click.IntRange(min=1), default=3, show_default=True, help="Seeds of the noise per cell.")
def reproduce(what: str, out: Path, seeds: int) -> None:
    """Compute the paper's table and figures anew, and judge its claims.

    \b
    Examples:
      ffsm reproduce                 everything, gathered in out/reproduction/reproduction.html
      ffsm reproduce table2 --seeds 5
    """
    from ffsm_drake.reproduction import reproduce as reproduce_paper

    terminal = sys.stdout.isatty()

    def progress(done: int, total: int, following: str) -> None:
        line = f"{done:3d} of {total} runs; next: {following}"
        if terminal:
            click.echo(f"\r{line:<100}", nl=False)
        elif done % 20 == 0 or done == total:
            click.echo(line)

    main_file = reproduce_paper(what, out, seeds=seeds, workers=2, progress=progress)
    if terminal:
        click.echo()
    if main_file is None:
        click.echo("interrupted; nothing was written", err=True)
        sys.exit(EXIT_INTERRUPTED)
    click.echo(f"Written to {out}; open {main_file}")
