"""The command ``ffsm run``."""

import itertools
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import click

from ffsm_drake.cli.common import (
    EXIT_GOOD,
    json_option,
    repeated_run,
    scenario_options,
    scenario_stem,
)
from ffsm_drake.cli.simulating import (
    report_option,
    require_option,
    run_folder_option,
    saved,
    simulated,
    warn_replaced,
)
from ffsm_drake.common.registrations import Registry

if TYPE_CHECKING:
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.scenario import Scenario


class LiveView(Protocol):
    """Runs a scenario that a user watches.

    Returns: the record; for "controls", what ``keep`` returned for the record of each run.
    """

    def __call__(self, scenario: "Scenario", **options: Any) -> Any: ...


# "meshcat", "foxglove", "controls": by the option of ``run``.
LIVE = Registry[LiveView]("live")


@click.command()
@scenario_options
@run_folder_option
@json_option
@report_option
@require_option
@click.option(
    "--engine",
    metavar="NAME",
    help="drake, or compiled for machine code, if it covers the scenario. Default: drake, or the "
    "engine of the repeated run.",
)
@click.option("--meshcat", is_flag=True, help="Run live in the browser, at real time.")
@click.option("--foxglove", is_flag=True, help="Run live in Foxglove, at real time.")
@click.option(
    "--controls",
    is_flag=True,
    help="Run live with an operator's panel, which a printed code unlocks.",
)
def run(
    scenario: "Scenario",
    out: Path | None,
    as_json: bool,
    report: bool,
    require: str | None,
    engine: str | None,
    meshcat: bool,
    foxglove: bool,
    controls: bool,
) -> None:
    """Run a scenario and write its record and report.

    SCENARIO is a shipped name (see 'ffsm scenarios'), a YAML file, or the folder of a run, to
    repeat it in out/NAME_again and compare it with the first record. The output folder then has
    record.nc, metrics.json, manifest.json and report.html, one page with results, plots, recording,
    findings and margins. With --controls each run has its own folder. Exits with 3 if the run
    diverges, its errors grow at the end, or the target is not captured.

    \b
    Examples:
      ffsm run
      ffsm run flight_sensors --controller aismc --seed 3
      ffsm run mine.yaml --controller my_module:MyController --out out/mine
      ffsm run --set disturbance.amplitude_scale=3 --set controllers.tde_aismc.k_s_max=90
    """
    from ffsm_drake.cli.finishing import finish
    from ffsm_drake.mission import Mission
    from ffsm_drake.runs.engine import DRAKE
    from ffsm_drake.runs.record import RunRecord, check_saving, record_stamp
    from ffsm_drake.spacecraft.plant import check_pictures

    if (live := meshcat or foxglove or controls) and engine not in (None, DRAKE):
        raise click.UsageError(f"--engine {engine}: has no live view; leave the option out")
    repeated = repeated_run()
    first = RunRecord.load(repeated) if repeated else None
    if engine is None:
        engine = DRAKE if first is None or live else first.engine.partition(" ")[0]
    stem = f"{scenario_stem()}_again" if repeated else _stem_of(scenario)
    directory = out or Path("out") / stem
    check_saving(directory)  # before the slow run
    before = record_stamp(directory)
    if report or live:
        check_pictures(scenario.model)
    if controls:
        records = _run_with_controls(scenario, directory)
        if not records:
            sys.exit(EXIT_GOOD)
        sys.exit(finish(records, directory, as_json=as_json, report=report, require=require))
    warn_replaced([(directory, scenario)], directory)
    if meshcat:
        record = LIVE.load("meshcat", "--meshcat")(scenario, open_browser=True)
    elif foxglove:
        tell = partial(click.echo, err=True)
        record = LIVE.load("foxglove", "--foxglove")(scenario, tell=tell)
    else:
        record = simulated(Mission(scenario), directory, before, engine)
    directory = saved(record, directory, before)
    code = finish([record], directory, as_json=as_json, report=report, require=require)
    if first is not None:
        named = record.dataset.assign_attrs(controller=first.dataset.attrs["controller"])
        same = first.dataset.identical(named)  # of a policy, the name holds its place
        remark = "same record, bit for bit" if same else "different record"
        click.echo(f"{remark}: {repeated}", err=as_json)
    sys.exit(code)


def _stem_of(scenario: "Scenario") -> str:
    """Return the folder name of a run; it ends in the controller's name unless that is the
    scenario's own.
    """
    from ffsm_drake.scenario import controller_key, load_scenario

    own = load_scenario(click.get_current_context().params["scenario"]).controller
    return scenario_stem() + (
        "" if scenario.controller == own else f"_{controller_key(scenario.controller)}"
    )


def _run_with_controls(scenario: "Scenario", directory: Path) -> list["RunRecord"]:
    """Run live under an operator's panel; each run is saved into a folder of its own."""
    from ffsm_drake.runs.record import RunRecord

    run_interactive = LIVE.load("controls", "--controls")
    click.echo("The panel is under Open Controls, at the top right of the page.", err=True)
    folders = (
        folder for k in itertools.count(1) if not (folder := directory / f"run_{k}").exists()
    )
    saved = run_interactive(
        scenario, open_browser=True, keep=lambda record: record.save(next(folders))
    )
    return [RunRecord.load(folder) for folder in saved]
