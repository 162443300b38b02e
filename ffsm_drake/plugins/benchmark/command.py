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
    from ffsm_drake.plugins.benchmark.missions import BenchmarkMission, Board


@click.command()
@click.argument("missions", nargs=-1, metavar="[MISSION]...")
@controller_option(multiple=True, help="A law, or module:Class; repeatable. Default: every law.")
@click.option("--check", is_flag=True, help="Check only published values; exit with 3 if one is "
              "not reproduced.")  # fmt: skip
@workers_option
@out_option(help="Folder (default: out/benchmark).")
@table_option
@json_option
def benchmark(
    missions: tuple[str, ...],
    controller: tuple[str, ...],
    check: bool,
    workers: int | None,
    out: Path | None,
    table: Path | None,
    as_json: bool,
) -> None:
    """Rank control laws on published missions, with three seeds each, next to lower bounds.

    MISSION is a name or a scenario file (default: every mission). Writes benchmark.html and
    benchmark.json. Ctrl-C stops after the current runs, and the table shows the missing ones;
    the same command continues. Laws that ran before stay in the table.

    \b
    Examples:
      ffsm benchmark
      ffsm benchmark paper -c tde_aismc -c my_module:MyLaw
      ffsm benchmark --check
      ffsm benchmark paper --table out/paper.tex
    """
    from ffsm_drake.common.files import check_writable, write_text
    from ffsm_drake.plugins.benchmark.missions import check_mission, load_mission, mission_names
    from ffsm_drake.plugins.benchmark.page import (
        benchmark_data,
        benchmark_page,
        board_columns,
        board_text,
        checks_table,
    )
    from ffsm_drake.runs.record import to_json
    from ffsm_drake.show.table_files import write_table
    from ffsm_drake.show.tables import aligned

    folder = out or Path("out/benchmark")
    check_writable(folder)
    if table is not None:
        check_writable(table.parent)
    loaded = [load_mission(name) for name in missions or mission_names()]
    if check:
        loaded = [mission for mission in loaded if mission.checks]

    def told(board: "Board") -> None:
        if not as_json:
            click.echo(f"{board_text(board)}\n")

    laws = [(mission, mission.checked_laws if check else controller) for mission in loaded]
    boards, interrupted = _run(laws, folder / "runs", workers or processors(), told)
    checks = [each for board in boards for each in check_mission(board)] if not controller else []
    data, published = benchmark_data(boards, checks), checks_table(checks)
    write_text(folder / "benchmark.json", to_json(data))
    write_text(folder / "benchmark.html", benchmark_page(boards, checks))
    if table is not None:
        write_table(board_columns(boards), table)
    print_result(as_json, data, "\n".join(aligned(published)) if checks else "")
    click.echo(f"Written to {folder}: benchmark.html, benchmark.json", err=as_json)
    if interrupted is not None:
        raise interrupted
    sys.exit(EXIT_GOOD if all(each.holds for each in checks) else EXIT_UNSTABLE)


def _run(
    laws: Iterable[tuple["BenchmarkMission", Sequence[str]]],
    runs: Path,
    workers: int,
    told: Callable[["Board"], None],
) -> tuple[list["Board"], "InterruptedCampaign | None"]:
    """Run missions with their laws. Return the boards, each of which is told, and what interrupted
    them.
    """
    from ffsm_drake.common.errors import InterruptedCampaign
    from ffsm_drake.common.steps import step
    from ffsm_drake.plugins.benchmark.missions import board_so_far, run_mission
    from ffsm_drake.plugins.workers.pool import local_workers, stop_on_signals

    boards = list["Board"]()
    interrupted: InterruptedCampaign | None = None
    with stop_on_signals() as stop, local_workers(workers) as crew:
        for mission, own in laws:
            try:
                if interrupted is None:
                    with step(mission.name), campaign_progress(mission.name) as progress:
                        board = run_mission(
                            mission, own, runs, workers=crew, stop=stop, progress=progress
                        )
            except InterruptedCampaign as error:
                interrupted = error
            boards.append(board_so_far(mission, own, runs) if interrupted else board)
            told(boards[-1])
    return boards, interrupted
