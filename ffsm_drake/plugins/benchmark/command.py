"""The command ``ffsm benchmark``."""

import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ffsm_drake.cli.common import (
    EXIT_GOOD,
    EXIT_UNSTABLE,
    controller_option,
    json_option,
    out_option,
    print_result,
    table_option,
)
from ffsm_drake.plugins.campaign.command import campaign_progress, processors, workers_option

if TYPE_CHECKING:
    from ffsm_drake.common.errors import InterruptedCampaign
    from ffsm_drake.plugins.benchmark.boards import Board, Comparison, Place, Reproduced


@click.command()
@click.argument("missions", nargs=-1, metavar="[MISSION]...")
@controller_option(multiple=True, help="A law, or module:Class; repeatable. Default: every law.")
@click.option("--seeds", type=click.IntRange(min=1, max=1000), default=20, show_default=True,
              help="Runs of each law on each mission.")  # fmt: skip
@click.option("--margins", is_flag=True, help="Also compute margins, the distance to LQG, and the "
              "processor time of each law.")  # fmt: skip
@click.option("--check", is_flag=True, help="Check only published values; exit with 3 if one is "
              "not reproduced.")  # fmt: skip
@click.option("--stored", is_flag=True, help="Run nothing; write the files from stored runs.")
@workers_option
@out_option(help="Folder (default: out/benchmark).")
@table_option
@json_option
def benchmark(
    missions: tuple[str, ...],
    controller: tuple[str, ...],
    seeds: int,
    margins: bool,
    check: bool,
    stored: bool,
    workers: int | None,
    out: Path | None,
    table: Path | None,
    as_json: bool,
) -> None:
    """Compare control laws on missions, with the same seeds for every law.

    MISSION is a name or a scenario file (default: the six missions of the comparison). Writes
    benchmark.html, comparison.md, comparison.png and benchmark.json. Ctrl-C stops after the current
    runs, and the table shows the missing ones; the same command continues. Laws that ran before
    stay in the table.

    \b
    Examples:
      ffsm benchmark
      ffsm benchmark paper -c tde_aismc -c my_module:MyLaw
      ffsm benchmark postcapture --margins
      ffsm benchmark --check
      ffsm benchmark --stored --out out/benchmark
      ffsm benchmark paper --table out/paper.tex
    """
    from ffsm_drake.common.files import check_writable
    from ffsm_drake.plugins.benchmark import missions as known
    from ffsm_drake.plugins.benchmark.boards import Place, check_mission, comparison
    from ffsm_drake.plugins.benchmark.comparison import comparison_text
    from ffsm_drake.plugins.benchmark.page import benchmark_data, board_text, checks_table
    from ffsm_drake.show.tables import aligned

    folder = out or Path("out/benchmark")
    check_writable(folder)
    if table is not None:
        check_writable(table.parent)
    default = known.mission_names() if check else known.compared_missions()
    loaded = [known.load_mission(name) for name in missions or default]
    if check:
        loaded = [mission for mission in loaded if mission.checks]
    places = [Place(mission=each, folder=folder / "runs", seeds=seeds) for each in loaded]

    def told(board: "Board") -> None:
        if not as_json:
            click.echo(f"{board_text(board)}\n")

    laws = [(place, place.mission.checked_laws if check else controller) for place in places]
    if stored:
        boards, interrupted = _stored(laws, folder), None
        for board in boards:
            told(board)
    else:
        boards, interrupted = _run(laws, workers or processors(), told, margins=margins)
    checks = [each for board in boards for each in check_mission(board)] if not controller else []
    found = comparison(boards)
    data = benchmark_data(boards, checks, found)
    _write(folder, boards, checks, found, table)
    texts = [comparison_text(boards, found)] if found else []
    texts += ["\n".join(aligned(checks_table(checks)))] if checks else []
    print_result(as_json, data, "\n\n".join(texts))
    names = "benchmark.html, comparison.md, comparison.png, benchmark.json"
    click.echo(f"Written to {folder}: {names}", err=as_json)
    if interrupted is not None:
        raise interrupted
    sys.exit(EXIT_GOOD if all(each.holds for each in checks) else EXIT_UNSTABLE)


def _write(
    folder: Path,
    boards: Sequence["Board"],
    checks: Sequence["Reproduced"],
    found: "Comparison",
    table: Path | None,
) -> None:
    from ffsm_drake.common.files import write_text
    from ffsm_drake.plugins.benchmark.comparison import comparison_figure, comparison_markdown
    from ffsm_drake.plugins.benchmark.page import benchmark_data, benchmark_page, board_columns
    from ffsm_drake.runs.record import to_json
    from ffsm_drake.show.figures.axes import save_figure
    from ffsm_drake.show.table_files import write_table

    write_text(folder / "benchmark.json", to_json(benchmark_data(boards, checks, found)))
    write_text(folder / "benchmark.html", benchmark_page(boards, checks, found))
    write_text(folder / "comparison.md", comparison_markdown(boards, found))
    if found:
        save_figure(comparison_figure(boards, found), folder / "comparison.png")
    if table is not None:
        write_table(board_columns(boards, found), table)


def _stored(laws: Sequence[tuple["Place", Sequence[str]]], folder: Path) -> list["Board"]:
    """Return the boards of the runs that a folder has."""
    from ffsm_drake.common.errors import CampaignError
    from ffsm_drake.plugins.benchmark.boards import board_so_far

    if not any(place.laws() for place, _ in laws):
        raise CampaignError(
            f"{folder}: --stored: no run of these missions, seeds and version; "
            "run ffsm benchmark without --stored first"
        )
    return [board_so_far(place, own) for place, own in laws]


def _run(
    laws: Iterable[tuple["Place", Sequence[str]]],
    workers: int,
    told: Callable[["Board"], None],
    *,
    margins: bool,
) -> tuple[list["Board"], "InterruptedCampaign | None"]:
    """Run missions with their laws. Return the boards, each of which is told, and what interrupted
    them.
    """
    from ffsm_drake.common.errors import InterruptedCampaign
    from ffsm_drake.common.steps import step
    from ffsm_drake.plugins.benchmark.boards import board_so_far, run_mission
    from ffsm_drake.plugins.workers.pool import local_workers, stop_on_signals

    boards = list["Board"]()
    interrupted: InterruptedCampaign | None = None
    with stop_on_signals() as stop, local_workers(workers) as crew:
        for place, own in laws:
            name = place.mission.name
            try:
                if interrupted is None:
                    with step(name), campaign_progress(name) as progress:
                        board = run_mission(
                            place, own, workers=crew, stop=stop, progress=progress, margins=margins
                        )
            except InterruptedCampaign as error:
                interrupted = error
            boards.append(board_so_far(place, own) if interrupted else board)
            told(boards[-1])
    return boards, interrupted
