"""Commands that simulate: run, compare."""

import itertools
import json
import math
import sys
from collections.abc import Iterable, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import click

from ffsm_drake.cli.common import (
    EXIT_BAD_INPUT,
    EXIT_GOOD,
    EXIT_UNSTABLE,
    interrupted,
    json_option,
    located_errors,
    out_option,
    override_options,
    print_json,
    repeated_run,
    scenario_argument,
    scenario_options,
    scenario_stem,
    table_option,
)
from ffsm_drake.cli.progress import ProgressLine
from ffsm_drake.common.interrupts import writing
from ffsm_drake.common.registrations import SERVICES, Registry

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

_out = out_option(
    help="Default: out/NAME of the scenario, with the controller's name added if it is not the "
    "scenario's own. An existing run is replaced, with a warning if its settings differ."
)
_report = click.option(
    "--report/--no-report", default=True, show_default=True, help="Write report.html."
)

_require = click.option(
    "--require",
    type=click.Choice(["settled"]),
    help="Exit with 3 unless every run settles as planned: errors within 'tolerance' in the last "
    "second, and no clearance or limit of the URDF violated.",
)


@click.command()
@scenario_options
@_out
@json_option
@_report
@_require
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
    from ffsm_drake.runs.engine import DRAKE
    from ffsm_drake.runs.record import RunRecord, check_saving, record_stamp
    from ffsm_drake.spacecraft.plant import check_pictures

    if (live := meshcat or foxglove or controls) and engine not in (None, DRAKE):
        raise click.UsageError(f"--engine {engine}: has no live view; leave the option out")
    repeated = repeated_run()
    first = RunRecord.load(repeated) if repeated else None
    if engine is None:
        engine = DRAKE if first is None or live else first.engine.partition(" ")[0]
    directory = out or Path("out") / (
        f"{scenario_stem()}_again" if repeated else _stem_of(scenario)
    )
    check_saving(directory)  # before the slow run
    before = record_stamp(directory)
    if report or meshcat or controls or foxglove:
        check_pictures(scenario.model)
    if controls:
        records = _run_with_controls(scenario, directory)
        if not records:
            sys.exit(EXIT_GOOD)
        sys.exit(_finish(records, directory, as_json=as_json, report=report, require=require))
    _warn_replaced([(directory, scenario)], directory)
    if meshcat:
        record = LIVE.load("meshcat", "--meshcat")(scenario, open_browser=True)
    elif foxglove:
        tell = partial(click.echo, err=True)
        record = LIVE.load("foxglove", "--foxglove")(scenario, tell=tell)
    else:
        record = _simulate(scenario, directory, before, engine)
    directory = _saved(record, directory, before)
    code = _finish([record], directory, as_json=as_json, report=report, require=require)
    if first is not None:
        named = record.dataset.assign_attrs(controller=first.dataset.attrs["controller"])
        same = first.dataset.identical(named)  # of a policy, the name holds its place
        remark = "same record, bit for bit" if same else "different record"
        click.echo(f"{remark}: {repeated}", err=as_json)
    sys.exit(code)


@click.command()
@scenario_argument
@override_options(multiple=True, help="Repeatable; default: the paper's four.")
@_out
@json_option
@table_option
@_report
@_require
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
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.runs.record import check_saving, record_stamp
    from ffsm_drake.runs.simulate import check_start
    from ffsm_drake.scenario import controller_key, load_scenario, override_scenario
    from ffsm_drake.spacecraft.plant import check_pictures
    from ffsm_drake.systems.controllers import PAPER_LAWS

    for key, _, value in (text.partition("=") for text in overrides):
        if key.strip() == "controller":
            raise click.UsageError(
                f"--set controller={value}: ffsm compare does not accept it; write --controller "
                f"{value}"
            )
    names = controllers or PAPER_LAWS
    folders = [controller_key(name) for name in names]
    repeated = sorted({folder for folder in folders if folders.count(folder) > 1})
    if repeated:
        raise click.UsageError(f"--controller {repeated[0]}: is given more than once; give it once")
    base = load_scenario(scenario, overrides)
    directory = out or Path("out") / f"compare_{scenario_stem()}"
    check_saving(directory)
    if table is not None:
        check_writable(table.parent)
    if report:
        check_pictures(base.model)
    # checked before any of them runs
    scenarios = [override_scenario(base, [f"controller={name}"]) for name in names]
    for chosen in scenarios:
        with located_errors(scenario, overrides, "--controller"):
            check_start(chosen)
    _warn_replaced(
        zip([directory / folder for folder in folders], scenarios, strict=True), directory
    )
    before = [record_stamp(directory / folder) for folder in folders]
    records: list[RunRecord] = []
    for chosen, folder, old in zip(scenarios, folders, before, strict=True):
        with located_errors(scenario, overrides):
            record = _simulate(chosen, directory / folder, old)
        _saved(record, directory / folder, old)
        records.append(record)
        if record.outcome.status == "interrupted":
            break
    sys.exit(
        _finish(
            records,
            directory,
            as_json=as_json,
            report=report,
            require=require,
            distances=_distances(records),
            table=table,
        )
    )


def _distances(records: Sequence["RunRecord"]) -> list[float] | None:
    """Distance of each run's controller to the LQG limit; NaN, with a printed reason, if it is
    unknown; None without the service ``lqg_limit``.
    """
    from ffsm_drake.common.errors import FfsmError, one_line

    find_limit = SERVICES.find("lqg_limit")
    if find_limit is None:
        return None
    distances, missing = [], dict[str, list[str]]()  # reason -> controllers
    for record in records:
        try:
            distances.append(find_limit(record.scenario).distance)
        except FfsmError as error:
            missing.setdefault(one_line(error), []).append(record.scenario.controller)
            distances.append(math.nan)
    for why, names in missing.items():
        click.echo(f"warning: {', '.join(names)}: no distance to the LQG limit: {why}", err=True)
    return distances


def _stem_of(scenario: "Scenario") -> str:
    """Return the folder name of a run; it ends in the controller's name unless that is the
    scenario's own.
    """
    from ffsm_drake.scenario import controller_key, load_scenario

    own = load_scenario(click.get_current_context().params["scenario"]).controller
    return scenario_stem() + (
        "" if scenario.controller == own else f"_{controller_key(scenario.controller)}"
    )


def _warn_replaced(planned: Iterable[tuple[Path, "Scenario"]], directory: Path) -> None:
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


def _saved(record: "RunRecord", directory: Path, before: Any) -> Path:
    """Save a record and return its folder: another one if the folder was filled during the run."""
    with writing():
        place = record.save(directory, replacing=before)
    if place != directory:
        line = f"another run was written to {directory} meanwhile; this run is in {place}"
        click.echo(f"warning: {line}", err=True)
    return place


def _simulate(
    scenario: "Scenario", directory: Path, before: Any, engine: str = "drake"
) -> "RunRecord":
    """Return a run's record; of a run in which a user-supplied block fails, save it up to then."""
    from ffsm_drake.common.errors import BlockError
    from ffsm_drake.runs.reading import REPORT_FILE
    from ffsm_drake.runs.simulate import simulate

    name = scenario.controller
    with ProgressLine() as line:

        def progress(time: float, duration: float) -> None:
            line.show(f"{name}: {time:4.0f} of {duration:g} s")

        try:
            record = simulate(scenario, progress=progress, engine=engine)
        except BlockError as error:
            if error.record is not None:
                directory = _saved(error.record, directory, before)
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


def _finish(
    records: Sequence["RunRecord"],
    directory: Path,
    *,
    as_json: bool,
    report: bool,
    require: str | None,
    distances: Sequence[float] | None = None,
    table: Path | None = None,
) -> int:
    """Write the report, print the table, best first, and set the exit code of finished runs.

    The records are saved: a step that fails, whatever it raises, is named in the last line.
    """
    from ffsm_drake.common.errors import spared
    from ffsm_drake.runs.limits import broken_limits, run_clearance, run_remarks
    from ffsm_drake.runs.reading import REPORT_FILE
    from ffsm_drake.show.outputs import write_outputs
    from ffsm_drake.show.results import ranking, results_of
    from ffsm_drake.show.table_files import write_table
    from ffsm_drake.show.tables import results_columns, results_data, results_table

    failed = list[str]()
    trying = partial(spared, failed=failed)
    said: dict[str, list[str]] = {}  # remark -> controllers
    stopped = any(record.outcome.status == "interrupted" for record in records)
    looked_at = () if stopped else records  # an interrupted command has little time
    for record in looked_at:
        with trying("remarks"):
            advice_on = SERVICES.find("advice") or (lambda record: ())
            for remark in (*run_remarks(record), *advice_on(record)):
                said.setdefault(remark, []).append(record.scenario.controller)
    for remark, names in said.items():
        click.echo(f"warning: {', '.join(dict.fromkeys(names))}: {remark}", err=True)
    for record in looked_at:
        with trying("remedy"):
            remedy_of = SERVICES.find("remedy") or (lambda record, directory: None)
            if file := remedy_of(record, directory):
                click.echo(
                    f"{record.scenario.controller}: a changed scenario is in {file}; run it with: "
                    f"ffsm run {file}",
                    err=True,
                )
        with trying("closest approach"):
            for closest in run_clearance(record):
                click.echo(f"{record.scenario.controller}: closest approach: {closest}", err=True)
    with trying("table"):
        best_first = [each.record for each in ranking(results_of(records), attrgetter("itae"))]
        shown = None
        if distances is not None:
            of = dict(zip(map(id, records), distances, strict=True))
            shown = [of[id(record)] for record in best_first]
        if not as_json:
            click.echo(results_table(best_first, shown))
        if table is not None:
            write_table(results_columns(best_first, shown), table)
    written = list[Path]()
    with trying("report"):
        if report:
            written = write_outputs(
                records, directory, figures=False, recording=False, distances=distances
            )
    if not written:
        (directory / REPORT_FILE).unlink(missing_ok=True)  # report of earlier runs
    if as_json:
        with trying("figures"):
            print_json({"directory": str(directory), "runs": results_data(records, distances)})
    else:
        files = f"{directory}, {table}" if table else directory
        click.echo(
            f"\nWritten to {files}" + (f"; open {directory / REPORT_FILE}" if written else "")
        )
    bad = False
    for record in records:
        with trying("conclusion"):
            beyond = broken_limits(record.scenario, record.dataset)
            name = f"{record.scenario.controller}: " if len(records) > 1 else ""
            end = f" Not as planned: {'; '.join(beyond)}." if beyond else ""
            click.echo(f"{name}{record.ending.sentence}{end}", err=as_json)
            unsettled = bool(beyond) or not record.ending.is_settled
            bad |= record.ending.is_failure or (require is not None and unsettled)
    if failed:
        click.echo(f"error: {'; '.join(failed)}; the record is kept in {directory}", err=True)
    if stopped:
        return interrupted()
    return EXIT_BAD_INPUT if failed else EXIT_UNSTABLE if bad else EXIT_GOOD
