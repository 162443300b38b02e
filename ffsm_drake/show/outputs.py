"""Outputs of a finished run: report page, figures and recording."""

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from pydrake.geometry import Meshcat

from ffsm_drake.common.files import write_text
from ffsm_drake.common.registrations import Registry
from ffsm_drake.runs.reading import REPORT_FILE
from ffsm_drake.runs.record import RunRecord

RECORDING_FILE = "recording.html"


class Report(Protocol):
    """Writes a page about some runs into a file; returns the file.

    Args: the runs, the file, the text of a recording or None, and the distance of each run's
    controller to the LQG limit or None. Raises RecordError: the file cannot be written.
    """

    def __call__(
        self,
        records: Sequence[RunRecord],
        path: Path,
        *,
        recording: str | None,
        distances: Sequence[float] | None,
    ) -> Path: ...


class Recording(Protocol):
    """Returns a page that plays back a run, as text. Raises ModelError: its model has changed."""

    def __call__(self, record: RunRecord, *, forces: bool = False) -> str: ...


REPORTS = Registry[Report]("reports")
RECORDINGS = Registry[Recording]("recordings")
# Start a server of Meshcat for this machine only.
MESHCAT_SERVERS = Registry[Callable[[], Meshcat]]("meshcat_servers")


def write_outputs(
    records: Sequence[RunRecord],
    directory: str | Path,
    *,
    figures: bool = True,
    recording: bool = True,
    distances: Sequence[float] | None = None,
) -> list[Path]:
    """Write the report, figures and recording of one run, or of several runs overlaid.

    The files are report.html, which needs the plug-in ``report``, figures in PNG, and
    recording.html, which shows the first run and needs the plug-in ``meshcat``.

    Args:
      records: the runs.
      directory: folder for the files.
      figures: True: write the figures.
      recording: True: write recording.html.
      distances: distance of the controller of each run to the LQG limit.

    Returns: the files that were written.

    Raises:
      RecordError: a file cannot be written.

    Example:
      >>> from ffsm_drake import load_scenario, simulate, write_outputs
      >>> record = simulate(load_scenario("postcapture", ["duration=0.1"]))
      >>> files = write_outputs([record], "out/short", figures=False, recording=False)
      >>> [file.name for file in files]
      ['report.html']
    """
    # Here, because they are slow to import and not always needed.
    from ffsm_drake.show.figures.run import save_figures

    directory = Path(directory)
    write_report, make_recording = REPORTS.first(), RECORDINGS.first()
    written, shown = list[Path](), None
    if make_recording is None:
        warnings.warn("no recording is made: no installed plug-in offers it", stacklevel=2)
    else:
        shown = make_recording(records[0], forces=True)
    if write_report is None:
        warnings.warn("no report is written: no installed plug-in offers it", stacklevel=2)
    else:
        file = directory / REPORT_FILE
        written.append(write_report(records, file, recording=shown, distances=distances))
    if recording and shown is not None:
        write_text(directory / RECORDING_FILE, shown)
        written.append(directory / RECORDING_FILE)
    return written + (save_figures(records, directory) if figures else [])
