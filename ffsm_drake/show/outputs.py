"""What a finished run leaves for people: the results as a table, the report page, figures and recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ffsm_drake.common.files import write_text
from ffsm_drake.runs.record import RunRecord

REPORT_FILE = "report.html"
RECORDING_FILE = "recording.html"


def results_table(records: Sequence[RunRecord]) -> str:
    """The figures of merit as plain text, a line per run."""
    lines = [
        f"{'controller':<16}{'ITAE':>11}{'ISV':>11}{'peak error':>24}{'final error':>24}{'peak force':>12}"
        f"{'peak torque':>21}",
        f"{'':<38}{'rad':>12}{'m':>12}{'rad':>12}{'m':>12}{'base, N':>12}{'base, N m':>11}{'joints':>10}",
    ]
    for record in records:
        m = record.metrics
        peak, final, effort = m["peak_error"], m["final_error"], m["peak_effort"]
        mark = "" if record.outcome.completed else f"  ({record.outcome.status} at {record.outcome.time:.2f} s)"
        lines.append(
            f"{record.scenario.controller:<16}{m['itae']:>11.4g}{m['isv']:>11.5g}"
            f"{max(peak['base_rotation'], peak['joints']):>12.3g}{peak['base_position']:>12.3g}"
            f"{max(final['base_rotation'], final['joints']):>12.3g}{final['base_position']:>12.3g}"
            f"{effort['base_position']:>12.3g}{effort['base_rotation']:>11.3g}{effort['joints']:>10.3g}{mark}"
        )
    return "\n".join(lines)


def results_data(records: Sequence[RunRecord]) -> list[dict[str, Any]]:
    """The same as plain data."""
    return [
        {
            "controller": record.scenario.controller,
            "status": record.outcome.status,
            "time": record.outcome.time,
            "message": record.outcome.message,
            "metrics": record.metrics,
        }
        for record in records
    ]


def write_outputs(
    records: Sequence[RunRecord], directory: str | Path, *, figures: bool = True, recording: bool = True
) -> list[Path]:
    """Write report.html of one run or several overlaid; with it figures (PNG, SVG) and recording.html.

    The recording shows the first run. Returns the files.

    Raises:
      RecordError: a file cannot be written.
    """
    # Here, because they are slow to import and not every run wants them.
    from ffsm_drake.show.figures.run import save_figures
    from ffsm_drake.show.meshcat import recording_html
    from ffsm_drake.show.report import write_report

    directory = Path(directory)
    shown = recording_html(records[0], forces=True)
    written = [write_report(records, directory / REPORT_FILE, recording=shown)]
    if recording:
        write_text(directory / RECORDING_FILE, shown)
        written.append(directory / RECORDING_FILE)
    return written + (save_figures(records, directory) if figures else [])
