"""The command analyze."""

import dataclasses
from pathlib import Path

import click

from ffsm_drake.cli.common import (
    json_option,
    out_option,
    print_result,
    run_argument,
)


@click.command()
@run_argument
@out_option(help="Folder for analysis.png and analysis.json (default: RUN_DIR).")
@json_option
def analyze(run: Path, out: Path | None, as_json: bool) -> None:
    """Check the paper's proofs and claims on a recorded run.

    RUN_DIR is a folder with record.nc and manifest.json. Prints the findings and draws them.

    \b
    Example:
      ffsm run --out out/mine
      ffsm analyze out/mine
    """
    from ffsm_drake.common.files import check_writable, published, write_text
    from ffsm_drake.plugins.analysis import analyze as analyze_record
    from ffsm_drake.plugins.analysis.figure import plot_analysis
    from ffsm_drake.runs.record import RunRecord, to_json
    from ffsm_drake.show.figures.axes import save_figure

    directory = out or run
    check_writable(directory)
    analysis = analyze_record(RunRecord.load(run))
    findings = {finding.key: dataclasses.asdict(finding) for finding in analysis.findings}
    print_result(as_json, findings, str(analysis))
    with published(directory) as folder:
        write_text(folder / "analysis.json", to_json(findings))
        save_figure(plot_analysis(analysis), folder / "analysis.png")
    click.echo(f"Written to {directory}: analysis.json, analysis.png", err=as_json)
