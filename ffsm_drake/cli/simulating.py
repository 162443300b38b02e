"""What the commands that simulate share: options, a run with its progress, and its folder."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ffsm_drake.cli.common import out_option
from ffsm_drake.cli.progress import ProgressLine
from ffsm_drake.common.interrupts import writing

if TYPE_CHECKING:
    from ffsm_drake.mission import Mission
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.scenario import Scenario

run_folder_option = out_option(
    help="Default: out/NAME of the scenario, with the controller's name added if it is not the "
    "scenario's own. An existing run is replaced, with a warning if its settings differ."
)
report_option = click.option(
    "--report/--no-report", default=True, show_default=True, help="Write report.html."
)

require_option = click.option(
    "--require",
    type=click.Choice(["settled"]),
    help="Exit with 3 unless every run settles as planned: errors within 'tolerance' in the last "
    "second, and no clearance or limit of the URDF violated.",
)


def warn_replaced(planned: Iterable[tuple[Path, "Scenario"]], directory: Path) -> None:
    """Warn if a planned run will replace one with other settings."""
    from ffsm_drake.common.errors import FfsmError
    from ffsm_drake.runs.simulate import check_start, repeatable_scenario
    from ffsm_drake.scenario import MANIFEST_FILE, differing_keys, scenario_from_dict

    for folder, scenario in planned:
        if not (folder / MANIFEST_FILE).exists():
            continue
        new = repeatable_scenario(scenario, {})
        try:
            manifest = json.loads((folder / MANIFEST_FILE).read_text())["scenario"]
            old = scenario_from_dict(manifest, source=str(folder / MANIFEST_FILE))
            keys = differing_keys(old, new)
        except (FfsmError, OSError, ValueError, LookupError, TypeError):
            what = "a run that cannot be read"
        else:
            if not keys:
                continue
            what = (
                "a run with other settings "
                f"({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})"
            )
        check_start(scenario)
        click.echo(
            f"warning: {directory}: {what} will be replaced; give another --out to keep it",
            err=True,
        )
        return


def simulated(
    mission: "Mission", directory: Path, before: Any, engine: str = "drake"
) -> "RunRecord":
    """Return a run's record; of a run in which a user-supplied block fails, save it up to then."""
    from ffsm_drake.common.errors import BlockError
    from ffsm_drake.runs.reading import REPORT_FILE
    from ffsm_drake.runs.simulate import simulate

    name = mission.scenario.controller
    with ProgressLine() as line:

        def progress(time: float, duration: float) -> None:
            line.show(f"{name}: {time:4.0f} of {duration:g} s")

        try:
            record = simulate(mission, progress=progress, engine=engine)
        except BlockError as error:
            if error.record is not None:
                directory = saved(error.record, directory, before)
                (directory / REPORT_FILE).unlink(missing_ok=True)  # report of an earlier run
                end = error.record.outcome.time
                click.echo(f"the record up to t = {end:.2f} s is in {directory}", err=True)
            raise
        pace = (
            f"simulated in {record.wall_time['advance_to']:.2f} s, "
            f"{record.realtime_factor:.0f} times real time"
        )
        line.show(f"{name}: {record.outcome.message}; {pace}", last=True)
    return record


def saved(record: "RunRecord", directory: Path, before: Any) -> Path:
    """Save a record and return its folder: another one if the folder was filled during the run."""
    with writing():
        place = record.save(directory, replacing=before)
    if place != directory:
        line = f"another run was written to {directory} meanwhile; this run is in {place}"
        click.echo(f"warning: {line}", err=True)
    return place
