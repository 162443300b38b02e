"""The command ``ffsm benchmark``."""

import sys
from pathlib import Path

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
    from ffsm_drake.common.errors import InterruptedCampaign
    from ffsm_drake.common.files import check_writable, write_text
    from ffsm_drake.common.steps import step
    from ffsm_drake.plugins.benchmark.missions import (
        board_so_far,
        check_mission,
        load_mission,
        mission_names,
        run_mission,
    )
    from ffsm_drake.plugins.benchmark.page import (
        benchmark_data,
        benchmark_page,
        board_columns,
        board_text,
        checks_table,
    )
    from ffsm_drake.plugins.workers.pool import local_workers, stop_on_signals
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
    boards, texts = [], []
    interrupted: InterruptedCampaign | None = None
    with stop_on_signals() as stop, local_workers(workers or processors()) as crew:
        for mission in loaded:
            laws = mission.checked_laws if check else controller
            runs = folder / "runs"
            try:
                if interrupted is None:
                    name = mission.name
                    with step(name), campaign_progress(name) as progress:
                        board = run_mission(
                            mission, laws, runs, workers=crew, stop=stop, progress=progress
                        )
            except InterruptedCampaign as error:
                interrupted = error
            boards.append(board_so_far(mission, laws, runs) if interrupted else board)
            texts.append(board_text(boards[-1]))
            if not as_json:
                click.echo(f"{texts[-1]}\n")
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
