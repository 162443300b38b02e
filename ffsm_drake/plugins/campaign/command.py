"""The commands ``ffsm campaign …``. They import when they run, so that ``--help`` stays fast."""

import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import (
    EXIT_GOOD,
    EXIT_UNSTABLE,
    CommandGroup,
    FiniteFloat,
    controller_option,
    out_option,
    table_option,
)
from ffsm_drake.cli.progress import ProgressLine
from ffsm_drake.common.errors import CampaignError

if TYPE_CHECKING:
    from ffsm_drake.plugins.campaign.run import Progress
    from ffsm_drake.plugins.campaign.spec import Spec

_FOLDER = Path("out/campaigns")


@click.group(cls=CommandGroup)
def campaign() -> None:
    """Run a scenario thousands of times with dispersed values, for one report.

    A specification (SPEC.yaml, or a shipped name such as payload_uncertainty) defines the
    dispersed values; see docs/campaigns.md. Every controller runs the same cases. The results do
    not depend on the workers.

    \b
    Examples:
      ffsm campaign plan payload_uncertainty
      ffsm campaign run payload_uncertainty --cases 100
      ffsm campaign report out/campaigns/payload_uncertainty.db
    """


_file = click.Path(path_type=Path, dir_okay=False)
workers_option = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Processes on this machine (default: one per processor).",
)
_scheduler_option = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Use the workers of a running Dask cluster, such as tcp://127.0.0.1:8786.",
)
_slurm_option = click.option(
    "--slurm",
    is_flag=True,
    help="Use the tasks of srun as the cluster, with one of them as the driver.",
)
_source = click.argument("source", metavar="SPEC|DATABASE")
_database_option = click.option(
    "--database",
    type=_file,
    help="Default: out/campaigns/NAME.db.",
)
_cases_option = click.option(
    "--cases", type=click.IntRange(min=1), help="Number of cases, in place of the specification's."
)


def _engine_option(command: Callable[..., None]) -> Callable[..., None]:
    """Add ``--engine``, and its name until version 0.3."""

    def refuse(_context: click.Context, _option: click.Parameter, name: str | None) -> None:
        if name is not None:
            raise click.UsageError("--dynamics: is now --engine; write --engine compiled, or drake")

    old = click.option("--dynamics", hidden=True, expose_value=False, callback=refuse)
    return old(
        click.option(
            "--engine",
            metavar="NAME",
            help="In place of the specification's: drake, or compiled for machine code, with Drake "
            "for the runs that it does not cover.",
        )(command)
    )


_OPTIONS = ("cases", "engine")  # keys of a specification that options replace


@campaign.command()
@click.argument("spec")
@_cases_option
@_engine_option
@workers_option
def plan(spec: str, cases: int | None, engine: str | None, workers: int | None) -> None:
    """Check a specification, show its first cases, and estimate its run time.

    Runs cases with every controller, until one reaches its end, to estimate the time; writes
    nothing.

    \b
    Example:
      ffsm campaign plan payload_uncertainty
    """
    from ffsm_drake.plugins.campaign.plan import plan_text

    loaded = _load(spec, cases, engine)
    click.echo(plan_text(loaded, workers=workers or processors()))
    _note_engine(loaded, engine)


@campaign.command()
@click.argument("spec")
@_database_option
@_cases_option
@_engine_option
@workers_option
@_scheduler_option
@_slurm_option
@click.option("--shard", metavar="I/N", default="1/1", help="Only every N-th case, from the I-th.")
def run(
    spec: str,
    database: Path | None,
    cases: int | None,
    engine: str | None,
    workers: int | None,
    scheduler: str | None,
    slurm: bool,
    shard: str,
) -> None:
    """Run a campaign into a new database.

    Ctrl-C stops after the current runs (exit code 130); 'resume' continues, also after a crash.
    Each of the N shards of a job array has its own database; 'merge' joins them.

    \b
    Examples:
      ffsm campaign run payload_uncertainty
      ffsm campaign run payload_uncertainty --shard 1/4
      ffsm campaign run mine.yaml --database /scratch/mine.db --scheduler tcp://10.0.0.5:8786
      srun --ntasks=34 ffsm campaign run mine.yaml --slurm
    """
    from ffsm_drake.plugins.campaign.run import start_campaign
    from ffsm_drake.plugins.campaign.store import Shard

    part = Shard.parse(shard)
    path = database or _default_database(spec, "" if part == Shard() else f"-{shard}")
    loaded = _load(spec, cases, engine)
    start = partial(start_campaign, loaded, shard=part)
    _drive(start, path, workers, scheduler, slurm=slurm)
    _note_engine(loaded, engine)


@campaign.command()
@click.argument("databases", metavar="DATABASE...", nargs=-1, required=True, type=_file)
@click.option("--out", type=_file, required=True, metavar="DATABASE", help="The new database.")
def merge(databases: tuple[Path, ...], out: Path) -> None:
    """Join the databases of a campaign's shards: the tables are those of one run, bit for bit.

    Refuses databases of different campaigns, and duplicate runs.

    \b
    Example:
      ffsm campaign merge shard-*.db --out whole.db
    """
    from ffsm_drake.plugins.campaign.run import merge_campaigns

    merge_campaigns(databases, out)
    _print_status(out)


@campaign.command()
@_source
@_database_option
@workers_option
@_scheduler_option
@_slurm_option
def resume(
    source: str, database: Path | None, workers: int | None, scheduler: str | None, slurm: bool
) -> None:
    """Run the remaining cases of an interrupted campaign.

    \b
    Example:
      ffsm campaign resume out/campaigns/payload_uncertainty.db
    """
    from ffsm_drake.plugins.campaign.run import resume_campaign

    _drive(resume_campaign, _locate(source, database), workers, scheduler, slurm=slurm)


@campaign.command()
@_source
@_database_option
def status(source: str, database: Path | None) -> None:
    """Show progress, outcomes so far and the workers' memory, also while the campaign runs.

    \b
    Example:
      ffsm campaign status payload_uncertainty
    """
    _print_status(_locate(source, database))


@campaign.command()
@_source
@_database_option
@click.option(
    "--case",
    "case_index",
    type=click.IntRange(min=0),
    required=True,
    help="Number of the case, from 0.",
)
@controller_option(help="Default: every controller of the campaign.")
@out_option(help="Folder (default: the folder of the database).")
@click.option("--no-recording", is_flag=True, help="Write no recording.html.")
def rerun(
    source: str,
    database: Path | None,
    case_index: int,
    controller: str | None,
    out: Path | None,
    no_recording: bool,
) -> None:
    """Repeat one case with its full record and recording, and compare with the stored row.

    Exits with 3 if a value differs from the stored one, for instance with other software or another
    processor.

    \b
    Example:
      ffsm campaign rerun payload_uncertainty --case 17 --controller aismc
    """
    from ffsm_drake.common.files import write_text
    from ffsm_drake.plugins.campaign.run import repeat_run
    from ffsm_drake.plugins.campaign.store import open_store
    from ffsm_drake.scenario import controller_key
    from ffsm_drake.show.outputs import RECORDINGS

    with open_store(_locate(source, database)) as store:
        if controller is not None and controller not in store.spec.controllers:
            raise CampaignError(
                f"--controller: '{controller}' is not in this campaign; choose "
                f"{', '.join(store.spec.controllers)}"
            )
        folder = out or store.path.parent / f"{store.path.stem}-case-{case_index}"
        same = True
        for name in store.spec.controllers if controller is None else (controller,):
            found = repeat_run(store, store.case(case_index), name)
            same = same and not found.differences
            message = found.repeated["message"]
            what = f"case {case_index}, {name}: {found.repeated['outcome']}" + (
                f" ({message})" if message else ""
            )
            if found.differences:
                click.echo(f"{what}; NOT as stored: {', '.join(found.differences)}")
                click.echo(f"  stored by {found.stored['software']}")
            else:
                click.echo(f"{what}; all values equal the stored ones, bit for bit")
            if found.record is not None:
                place = folder / controller_key(name)
                found.record.save(place)
                if not no_recording:
                    recording_html = RECORDINGS.only("--no-recording")
                    write_text(place / "recording.html", recording_html(found.record))
                click.echo(f"  written to {place}")
    sys.exit(EXIT_GOOD if same else EXIT_UNSTABLE)


@campaign.command()
@_source
@_database_option
@out_option(help="Folder (default: the folder of the database).")
@click.option(
    "--map",
    "axes",
    nargs=2,
    metavar="X Y",
    help="Axes of the map (default: the two most influential).",
)
@click.option(
    "--boundary",
    type=FiniteFloat(min=0.0),
    default=0.0,
    metavar="SECONDS",
    help="Also predict where on the map the loop is unstable, for at most this time. Repeat the "
    "command to continue. Reports without this option show what is stored.",
)
@table_option
def report(
    source: str,
    database: Path | None,
    out: Path | None,
    axes: tuple[str, str] | None,
    boundary: float,
    table: Path | None,
) -> None:
    """Evaluate a campaign, also while it runs: report.html (one file, opens offline), CSV and
    Parquet.

    \b
    Examples:
      ffsm campaign report payload_uncertainty
      ffsm campaign report mine.db --boundary 60 --map payload.truth.mass nominal_error
      ffsm campaign report mine.db --table out/mine.tex
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.common.numbers import counted
    from ffsm_drake.plugins.campaign.page import write_report
    from ffsm_drake.plugins.campaign.store import open_store
    from ffsm_drake.show.table_files import write_table

    with open_store(_locate(source, database)) as store:
        folder = out or store.path.with_suffix("").with_name(f"{store.path.stem}-report")
        check_writable(folder)  # before the slow evaluation
        if table is not None:
            check_writable(table.parent)
        with ProgressLine() as line:
            written = write_report(
                store,
                folder,
                axes=axes,
                boundary=boundary,
                progress=lambda done, total: line.show(
                    f"{done} of {counted(total, 'controller')} predicted"
                ),
            )
        if table is not None:
            write_table(written.table, table)
        click.echo(written.summary)
        click.echo(f"\nWritten to {folder}: {', '.join(path.name for path in written.files)}")


def _load(spec: str, cases: int | None, engine: str | None) -> "Spec":
    from ffsm_drake.plugins.campaign.spec import load_spec, spec_from_data

    loaded = load_spec(spec)
    given = {"cases": cases, "engine": engine}
    changed = {name: value for name, value in given.items() if value is not None}
    return spec_from_data({**loaded.data, **changed}) if changed else loaded


def _note_engine(spec: "Spec", engine: str | None) -> None:
    """Print what compiled runs would bring, if they are the default but cannot be used."""
    from ffsm_drake.plugins.campaign.spec import why_not_compiled
    from ffsm_drake.runs.engine import DRAKE

    if engine is None and spec.engine == DRAKE and (why := why_not_compiled()):
        click.echo(f"{why}; this campaign runs on Drake, several times as slowly", err=True)


def _default_database(spec: str, suffix: str = "") -> Path:
    return _FOLDER / f"{Path(spec).stem}{suffix.replace('/', '-of-')}.db"


def _locate(source: str, database: Path | None) -> Path:
    """Find the database of a specification or path; it must contain that specification."""
    from ffsm_drake.plugins.campaign.spec import load_spec, shipped_campaigns, spec_from_data
    from ffsm_drake.plugins.campaign.store import open_store

    is_spec = source in shipped_campaigns() or Path(source).suffix in (".yaml", ".yml")
    if not is_spec:
        if database is not None:
            raise CampaignError("--database: is given twice; give it once")
        stored = _default_database(source)
        is_name = Path(source).stem == source and not Path(source).is_file()
        return stored if is_name and stored.is_file() else Path(source)
    path, spec = database or _default_database(source), load_spec(source)
    with open_store(path) as store:
        # The number of cases may differ, by --cases, and the engine by --engine.
        options = {name: store.spec.data[name] for name in _OPTIONS if name in store.spec.data}
        shared = {name: value for name, value in spec.data.items() if name not in _OPTIONS}
        if store.spec.fingerprint != spec_from_data({**shared, **options}).fingerprint:
            raise CampaignError(
                f"{path}: holds another campaign than {source} describes; to continue that one, "
                "give its database"
            )
    return path


def _drive(
    drive: Callable[..., None],
    path: Path,
    workers: int | None,
    scheduler: str | None,
    *,
    slurm: bool,
) -> None:
    """Start or resume a campaign with the chosen workers, then print its status."""
    from ffsm_drake.plugins.workers.cluster import cluster_workers, slurm_workers
    from ffsm_drake.plugins.workers.pool import local_workers, stop_on_signals

    if sum((workers is not None, scheduler is not None, slurm)) > 1:
        raise CampaignError(
            "--workers, --scheduler and --slurm exclude each other; give one of them"
        )
    with ExitStack() as stack:
        if slurm:  # most tasks of the step end here
            opened = stack.enter_context(slurm_workers())
        stop = stack.enter_context(stop_on_signals())
        if scheduler is not None:
            opened = stack.enter_context(cluster_workers(scheduler))
        elif not slurm:
            opened = stack.enter_context(local_workers(workers or processors()))
        progress = stack.enter_context(campaign_progress())
        drive(path, workers=opened, stop=stop, progress=progress)
    if problem := _print_status(path):
        raise CampaignError(f"{path}: {problem}")
    click.echo(f"Next: ffsm campaign report {shlex.quote(str(path))}")


def _print_status(path: Path) -> str:
    """Print the progress; return what is wrong if every run ended in an error, else nothing."""
    from ffsm_drake.plugins.campaign.plan import errors, status_text
    from ffsm_drake.plugins.campaign.store import open_store

    with open_store(path) as store:
        click.echo(status_text(store))
        done = store.num_results()
        if not done or done > sum(each["error"] for each in store.counts().values()):
            return ""
        return (
            f"every run ended in an error, such as: {errors(store)[0][1]}; correct the cause and "
            "run it into a new database"
        )


def processors() -> int:
    """Number of processors available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def campaign_progress(name: str = "") -> Iterator[Callable[["Progress"], None]]:
    """Show a campaign's progress while it runs; ``name`` stands before each line."""
    with ProgressLine(period=30.0) as line:

        def show(progress: "Progress") -> None:
            share = progress.done / max(progress.total, 1)
            text = f"{name}: {progress}" if name else str(progress)
            line.show(text, share=share, last=progress.done == progress.total)

        yield show
