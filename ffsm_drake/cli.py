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
from ffsm_drake.scenario import CONTROLLER_NAMES, Scenario, load_scenario, scenario_to_yaml

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
            except KeyboardInterrupt:
                click.echo("interrupted", err=True)
                sys.exit(EXIT_INTERRUPTED)

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

    main_file = reproduce_paper(what, out, seeds=seeds, workers=2, progress=_run_progress)
    _end_progress()
    if main_file is None:
        click.echo("interrupted; nothing was written", err=True)
        sys.exit(EXIT_INTERRUPTED)
    click.echo(f"Written to {out}; open {main_file}")


@main.command()
@_reports_errors
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/noise"), show_default=True)
@click.option("--seeds", type=click.IntRange(min=1), default=1, show_default=True, help="Seeds of the noise per point.")
def noise(out: Path, seeds: int) -> None:
    """What the published gains cost with real sensors: error and effort against noise, all controllers, both estimates.

    Writes noise.md, noise.csv, noise.png and noise.svg.

    \b
    Example:
      ffsm noise --seeds 3
    """
    from ffsm_drake.noise_study import study_markdown, study_noise, write_study

    study = study_noise(seeds=seeds, workers=2, progress=_run_progress)
    _end_progress()
    click.echo(study_markdown(study))
    click.echo(f"Written to {out}; open {write_study(study, out).with_suffix('.png')}")


@main.command()
@_reports_errors
@_scenario_options
@click.option("--budget", type=float, help="Largest ISV (default: 1.1 times that of perfect tracking).")
@click.option("--payload-range", type=float, nargs=2, metavar="LOW HIGH", help="True masses to be stable for, kg.")
@click.option("--out", type=click.Path(path_type=Path), default=Path("out/design"), show_default=True)
def design(scenario: Scenario, budget: float | None, payload_range: tuple[float, float] | None, out: Path) -> None:
    """Choose gains and estimator for a scenario's sensors, period and payload range, without simulating it.

    Writes design.yaml, a scenario to run, and design.png, accuracy against effort. Exits with 3 when the chosen gains
    are unstable for some payload of the range.

    \b
    Examples:
      ffsm design flight_sensors
      ffsm design flight_sensors --controller tde_aismc --budget 410 --out out/mine
      python examples/postcapture.py --scenario out/mine/design.yaml
    """
    from ffsm_drake.design import design as design_gains
    from ffsm_drake.design import design_table, plot_design

    found = design_gains(scenario, budget=budget, payload_range=payload_range, progress=_progress_line("prices"))
    click.echo(design_table(found))
    write_text(out / "design.yaml", scenario_to_yaml(found.chosen.scenario))
    with written_whole(out / "design.png") as temporary:
        plot_design(found).savefig(temporary, dpi=130)
    click.echo(f"\nWritten to {out}: design.yaml, design.png")
    stable = all(prediction.spectral_radius < 1.0 for prediction in found.robustness.values())
    sys.exit(0 if stable else EXIT_UNSTABLE)


def _progress_line(what: str) -> Callable[[int, int], None]:
    """Progress on one line of a terminal; nothing elsewhere, for work of a few seconds."""

    def show(done: int, total: int) -> None:
        if sys.stderr.isatty():
            click.echo(f"\r{done} of {total} {what}" + ("\n" if done == total else ""), nl=False, err=True)

    return show


def _run_progress(done: int, total: int, following: str) -> None:
    """One line that fills up on a terminal; a plain line every twenty runs elsewhere."""
    line = f"{done:3d} of {total} runs: {following}"
    if sys.stdout.isatty():
        click.echo(f"\r{line:<100}", nl=False)
    elif done % 20 == 0 or done == total:
        click.echo(line)


def _end_progress() -> None:
    if sys.stdout.isatty():
        click.echo()
