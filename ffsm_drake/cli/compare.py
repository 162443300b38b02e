"""The command ``ffsm compare``."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import (
    json_option,
    located_errors,
    override_options,
    scenario_argument,
    scenario_stem,
    table_option,
)
from ffsm_drake.cli.simulating import (
    report_option,
    require_option,
    run_folder_option,
    saved,
    simulated,
    warn_replaced,
)

if TYPE_CHECKING:
    from ffsm_drake.mission import Mission
    from ffsm_drake.runs.record import RunRecord


@click.command()
@scenario_argument
@override_options(multiple=True, help="Repeatable; default: the paper's four.")
@run_folder_option
@json_option
@table_option
@report_option
@require_option
def compare(
    scenario: str,
    controllers: tuple[str, ...],
    overrides: tuple[str, ...],
    out: Path | None,
    as_json: bool,
    table: Path | None,
    report: bool,
    require: str | None,
) -> None:
    """Run several controllers on one scenario with the same noise, and rank them.

    Writes one folder for each controller, and one report.html for all.

    \b
    Examples:
      ffsm compare
      ffsm compare flight_sensors -c tdc -c tde_aismc -c computed_torque -c pd_plus
      ffsm compare mine.yaml -c tde_aismc -c my_module:MyController --out out/both
      ffsm compare paper --table out/laws.tex
    """
    from ffsm_drake.cli.finishing import finish
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.mission import Mission
    from ffsm_drake.runs.record import check_saving, record_stamp
    from ffsm_drake.scenario import controller_key, load_scenario, override_scenario
    from ffsm_drake.spacecraft.plant import check_pictures
    from ffsm_drake.systems.controllers import PAPER_LAWS

    names = _checked_names(controllers or PAPER_LAWS, overrides)
    base = load_scenario(scenario, overrides)
    directory = out or Path("out") / f"compare_{scenario_stem()}"
    folders = [directory / controller_key(name) for name in names]
    check_saving(directory)
    if table is not None:
        check_writable(table.parent)
    if report:
        check_pictures(base.model)
    scenarios = [override_scenario(base, [f"controller={name}"]) for name in names]
    missions = [*map(Mission(base).of, scenarios)]
    _check_starts(missions, scenario, overrides)
    warn_replaced(zip(folders, scenarios, strict=True), directory)
    before = [record_stamp(folder) for folder in folders]
    records: list[RunRecord] = []
    for chosen, folder, old in zip(missions, folders, before, strict=True):
        with located_errors(scenario, overrides):
            record = simulated(chosen, folder, old)
        saved(record, folder, old)
        records.append(record)
        if record.outcome.status == "interrupted":
            break
    code = finish(
        records,
        directory,
        as_json=as_json,
        report=report,
        require=require,
        distances=_distances(records),
        table=table,
    )
    sys.exit(code)


def _checked_names(names: Sequence[str], overrides: Sequence[str]) -> Sequence[str]:
    """Return the names of the controllers, each given once and not by ``--set`` too."""
    from ffsm_drake.scenario import controller_key

    for key, _, value in (text.partition("=") for text in overrides):
        if key.strip() == "controller":
            raise click.UsageError(
                f"--set controller={value}: ffsm compare does not accept it; write --controller "
                f"{value}"
            )
    folders = [controller_key(name) for name in names]
    repeated = sorted({folder for folder in folders if folders.count(folder) > 1})
    if repeated:
        raise click.UsageError(f"--controller {repeated[0]}: is given more than once; give it once")
    return names


def _check_starts(missions: Sequence["Mission"], source: str, overrides: Sequence[str]) -> None:
    """Check all missions before any of them runs."""
    from ffsm_drake.runs.simulate import check_start

    for mission in missions:
        with located_errors(source, overrides, "--controller"):
            check_start(mission)


def _distances(records: Sequence["RunRecord"]) -> list[float] | None:
    """Distance of each run's controller to the LQG limit; NaN, with a printed reason, if it is
    unknown; None: nothing computes it.
    """
    from ffsm_drake.common.errors import FfsmError, one_line
    from ffsm_drake.runs.judge import JUDGES

    judge = JUDGES.first()
    if judge is None:
        return None
    distances, missing = [], dict[str, list[str]]()  # reason -> controllers
    for record in records:
        try:
            distances.append(judge.distance(record.mission))
        except FfsmError as error:
            missing.setdefault(one_line(error), []).append(record.scenario.controller)
            distances.append(math.nan)
    for why, names in missing.items():
        click.echo(f"warning: {', '.join(names)}: no distance to the LQG limit: {why}", err=True)
    return distances
