"""Commands before or after a run: stability, design."""

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ffsm_drake.cli.common import (
    EXIT_UNSTABLE,
    FiniteFloat,
    interrupted,
    json_option,
    out_option,
    print_result,
    rehearsal_option,
    scenario_options,
)
from ffsm_drake.cli.progress import ProgressLine

if TYPE_CHECKING:
    from ffsm_drake.plugins.design.stability import Margins
    from ffsm_drake.plugins.design.verdict import Verdict
    from ffsm_drake.scenario import Scenario


@click.command()
@scenario_options
@rehearsal_option
@click.option(
    "--limits",
    is_flag=True,
    help="Also find the stability limits of gains, nominal payload, period, delay and flexible "
    "masses, one at a time (takes the time of five to thirty runs).",
)
@click.option(
    "--disk",
    is_flag=True,
    help="Also find disk margins (simultaneous gain and phase), for each force alone and for all "
    "together.",
)
@out_option(help="Write stability.png here, and remedy.yaml where a change helps.")
@json_option
def stability(
    scenario: "Scenario",
    rehearsal: bool,
    limits: bool,
    disk: bool,
    out: Path | None,
    as_json: bool,
) -> None:
    """Compute stability margins of the sampled loop, and the verdict on the whole mission.

    SCENARIO is a shipped name or a YAML file (default: postcapture). Margins hold after the
    grasp, without actuator limits. The verdict covers every leg: the linear loop along the plan,
    and a rehearsal, a run with limits and noise. Exits with 3 if the mission is not expected to go
    as planned, or the linear loop of a leg is unstable.

    \b
    Examples:
      ffsm stability --limits
      ffsm stability paper --set simulator_config.integration_scheme=runge_kutta3
      ffsm stability --set payload.nominal.mass=125 --out out/stability
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.plugins.design.remedy_file import write_remedied
    from ffsm_drake.plugins.design.tables import margins_data, margins_table
    from ffsm_drake.plugins.design.verdict import verdict

    if out is not None:
        check_writable(out)
    found = verdict(scenario, rehearsal=rehearsal, margins=True)
    margins, tables, data = found.margins, list[str](), dict[str, Any]()
    if margins is not None:
        tables, data = [margins_table(margins)], margins_data(margins)
        for table, more in _further_margins(scenario, margins, limits=limits, disk=disk):
            tables.append(table)
            data |= more
    tables.append("\n".join([*found.lines, found.conclusion]))
    print_result(as_json, data | {"mission": found.as_data()}, "\n\n".join(tables))
    if out is not None and margins is not None:
        from ffsm_drake.plugins.design.stability_figure import plot_margins
        from ffsm_drake.show.figures.axes import save_figure

        path = out / "stability.png"
        save_figure(plot_margins(margins), path)
        click.echo(f"Written to {path}", err=as_json)
    if out is not None and (found.advice or found.remedies):
        file = write_remedied(scenario, found.advice, found.remedies, out)
        click.echo(f"a changed scenario is in {file}; run it with: ffsm run {file}", err=as_json)
    sys.exit(EXIT_UNSTABLE if found.is_alarm or found.is_linearly_unstable else 0)


def _further_margins(
    scenario: "Scenario", margins: "Margins", *, limits: bool, disk: bool
) -> Iterator[tuple[str, dict[str, Any]]]:
    """The optional margins, as tables and plain data."""
    from ffsm_drake.plugins.design.stability.boundaries import find_boundaries
    from ffsm_drake.plugins.design.stability.disk import disk_margins
    from ffsm_drake.plugins.design.tables import boundaries_table, disk_table

    if limits:
        boundaries = find_boundaries(scenario, time=margins.edge_times)
        table = boundaries_table(boundaries, scenario)
        yield table, {"boundaries": dataclasses.asdict(boundaries)}
    else:
        yield "stability limits, one parameter at a time: --limits", {}
    if disk:
        found = disk_margins(scenario)
        yield disk_table(found), {"disk": found.as_data()}


@click.command()
@scenario_options
@click.option(
    "--budget",
    type=FiniteFloat(min=0.0),
    help="Largest ISV (default: 1.02 times that of the current gains; with unstable gains or "
    "--trade effort, at least 1.1 times that of perfect tracking).",
)
@click.option(
    "--payload-range",
    type=FiniteFloat(min=0.0),
    nargs=2,
    metavar="LOW HIGH",
    help="Range of true payload masses with a stable loop, kg.",
)
@click.option(
    "--trade",
    type=click.Choice(["accuracy", "effort", "margins"]),
    multiple=True,
    help="Criterion that may get worse than with the current gains; repeatable (default: none).",
)
@click.option(
    "--time",
    "time_limit",
    type=FiniteFloat(min=0.0),
    default=60.0,
    show_default=True,
    help="Time limit of the whole command, s; then the best gains so far are used, as after "
    "Ctrl-C.",
)
@out_option(default=Path("out/design"), show_default=True)
@json_option
def design(
    scenario: "Scenario",
    budget: float | None,
    payload_range: tuple[float, float] | None,
    trade: tuple[str, ...],
    time_limit: float,
    out: Path,
    as_json: bool,
) -> None:
    """Choose gains and estimator for a scenario's sensors, delays, limits and payload range.

    The result is at most 2 % worse than the current gains in each rms error and each margin, except
    those named by --trade, and its effort is within --budget. Writes design.yaml, a scenario to
    run, and design.png, accuracy against effort. Exits with 3 when the chosen gains are unstable
    for some payload in the range.

    \b
    Examples:
      ffsm design flight_sensors
      ffsm design flight_sensors --controller tde_aismc --budget 410 --out out/mine
      ffsm run out/mine/design.yaml
    """
    from ffsm_drake.common.files import check_writable, published, write_text
    from ffsm_drake.plugins.design.figure import plot_design
    from ffsm_drake.plugins.design.gains import INTERRUPT
    from ffsm_drake.plugins.design.gains import design as design_gains
    from ffsm_drake.plugins.design.tables import design_data, design_table
    from ffsm_drake.plugins.design.verdict import verdict
    from ffsm_drake.scenario import scenario_to_yaml
    from ffsm_drake.show.figures.axes import save_figure

    check_writable(out)
    missions = list[tuple["Scenario", "Verdict"]]()

    def predict_mission(candidate: "Scenario") -> str:
        mission = verdict(candidate, advises=False)
        missions.append((candidate, mission))
        return mission.warnings[0] if mission.is_alarm else ""

    with ProgressLine() as line:
        found = design_gains(
            scenario,
            budget=budget,
            payload_range=payload_range,
            trade=trade,
            time_limit=time_limit,
            predict_mission=predict_mission,
            progress=lambda _, what: line.show(f"{line.seconds:4.0f} s: {what}"),
        )
    chosen = found.chosen.scenario
    mission = next((each for looked_at, each in missions if looked_at is chosen), None)
    print_result(
        as_json,
        design_data(found) | {"mission": mission and mission.as_data()},
        f"{design_table(found)}\n\n{_told(mission)}",
    )
    with published(out) as folder:
        write_text(folder / "design.yaml", scenario_to_yaml(chosen))
        save_figure(plot_design(found), folder / "design.png")
    click.echo(f"\nWritten to {out}: design.yaml, design.png", err=as_json)
    stable = max(found.chosen.radius_by_mass.values()) < 1.0
    sys.exit(interrupted() if found.ended_by == INTERRUPT else 0 if stable else EXIT_UNSTABLE)


def _told(mission: "Verdict | None") -> str:
    """Expectations for a mission; None: not evaluated."""
    if mission is None:
        return "the time limit left no time to check the mission; run ffsm stability"
    return "\n".join([*mission.lines, mission.conclusion])
