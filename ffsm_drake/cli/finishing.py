"""What the commands that simulate print and write of finished runs.

The records are saved. A step that fails, whatever it raises, is named in the last line.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import click

from ffsm_drake.cli.common import (
    EXIT_BAD_INPUT,
    EXIT_GOOD,
    EXIT_UNSTABLE,
    interrupted,
    print_json,
)
from ffsm_drake.common.errors import spared
from ffsm_drake.runs import exceeded_limits
from ffsm_drake.runs.judge import JUDGES
from ffsm_drake.runs.metrics import itae_of
from ffsm_drake.runs.reading import REPORT_FILE
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.show import outputs, table_files, tables
from ffsm_drake.show.results import ranking, results_of

Trying = Callable[[str], AbstractContextManager[None]]  # a step, by what it makes


def finish(
    records: Sequence[RunRecord],
    directory: Path,
    *,
    as_json: bool,
    report: bool,
    require: str | None,
    distances: Sequence[float] | None = None,
    table: Path | None = None,
) -> int:
    """Write the report, print the table, best first, and return the exit code of finished runs."""
    failed = list[str]()
    trying: Trying = partial(spared, failed=failed)
    stopped = any(record.outcome.status == "interrupted" for record in records)
    if not stopped:  # an interrupted command has little time
        _print_remarks(records, trying)
        for record in records:
            _print_remedy(record, directory, trying)
    with trying("table"):
        _show_table(records, distances, shown=not as_json, file=table)
    written = list[Path]()
    with trying("report"):
        if report:
            written = outputs.write_outputs(
                records, directory, figures=False, recording=False, distances=distances
            )
    if not written:
        (directory / REPORT_FILE).unlink(missing_ok=True)  # report of earlier runs
    if as_json:
        with trying("figures"):
            runs = tables.results_data(records, distances)
            print_json({"directory": str(directory), "runs": runs})
    else:
        files = f"{directory}, {table}" if table else directory
        opened = f"; open {directory / REPORT_FILE}" if written else ""
        click.echo(f"\nWritten to {files}{opened}")
    bad = [_conclude(record, require, len(records) > 1, as_json, trying) for record in records]
    if failed:
        click.echo(f"error: {'; '.join(failed)}; the record is kept in {directory}", err=True)
    if stopped:
        return interrupted()
    return EXIT_BAD_INPUT if failed else EXIT_UNSTABLE if any(bad) else EXIT_GOOD


def _print_remarks(records: Sequence[RunRecord], trying: Trying) -> None:
    """Print each remark once, with the controllers of its runs."""
    said: dict[str, list[str]] = {}  # remark -> controllers
    for record in records:
        with trying("remarks"):
            advice = judge.advice(record) if (judge := JUDGES.first()) else ()
            for remark in (*exceeded_limits.run_remarks(record), *advice):
                said.setdefault(remark, []).append(record.scenario.controller)
    for remark, names in said.items():
        click.echo(f"warning: {', '.join(dict.fromkeys(names))}: {remark}", err=True)


def _print_remedy(record: RunRecord, directory: Path, trying: Trying) -> None:
    """Print where a changed scenario is, if one is proposed, and the closest approach."""
    controller = record.scenario.controller
    with trying("remedy"):
        judge = JUDGES.first()
        if judge is not None and (file := judge.remedy(record, directory)):
            click.echo(
                f"{controller}: a changed scenario is in {file}; run it with: ffsm run {file}",
                err=True,
            )
    with trying("closest approach"):
        for closest in exceeded_limits.run_clearance(record):
            click.echo(f"{controller}: closest approach: {closest}", err=True)


def _show_table(
    records: Sequence[RunRecord],
    distances: Sequence[float] | None,
    *,
    shown: bool,
    file: Path | None,
) -> None:
    """Print the table of runs, best first, and write it into a file."""
    ranked = ranking(results_of(records), lambda each: each.figure(itae_of))
    best_first = [each.record for each in ranked]
    if distances is not None:
        of = dict(zip(map(id, records), distances, strict=True))
        distances = [of[id(record)] for record in best_first]
    if shown:
        click.echo(tables.results_table(best_first, distances))
    if file is not None:
        table_files.write_table(tables.results_columns(best_first, distances), file)


def _conclude(
    record: RunRecord, require: str | None, is_named: bool, as_json: bool, trying: Trying
) -> bool:
    """Print how a run ended. Return whether it failed, or did not settle as ``require`` says."""
    with trying("conclusion"):
        beyond = exceeded_limits.broken_limits(record.mission, record.dataset)
        name = f"{record.scenario.controller}: " if is_named else ""
        end = f" Not as planned: {'; '.join(beyond)}." if beyond else ""
        click.echo(f"{name}{record.ending.sentence}{end}", err=as_json)
        unsettled = bool(beyond) or not record.ending.is_settled
        return record.ending.is_failure or (require is not None and unsettled)
    return False
