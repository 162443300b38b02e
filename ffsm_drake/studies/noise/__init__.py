"""What the published gains cost with real sensors: error and effort of every controller against
velocity noise.

Every controller runs the mission of ``postcapture`` twice at each noise level: with the published
one-sample estimate and gains, and with the Kalman estimate and gains of ordinary bandwidth.
Positions are measured exactly, which favours the published estimate: it does nothing against
position noise. One more point of each has all the sensors of ``flight_sensors``; at one noise level
estimates and gains are exchanged, to tell which of the two matters. Actuators are unlimited:
saturation would hide the effort that is asked for.
"""

from pathlib import Path

from ffsm_drake.common.files import csv_text, write_text, written_whole
from ffsm_drake.studies.noise.study import NoiseStudy, study_noise

__all__ = ["NoiseStudy", "study_noise", "write_study"]


def write_study(study: NoiseStudy, directory: str | Path) -> Path:
    """Write noise.csv (every run), noise.md (the tables), noise.png and noise.svg. Returns the path
    of noise.md.

    Raises:
      RecordError: a file cannot be written.
    """
    from ffsm_drake.studies.noise.picture import plot_study  # Matplotlib is slow to import
    from ffsm_drake.studies.noise.table import study_markdown, study_rows

    directory = Path(directory)
    write_text(directory / "noise.csv", csv_text(study_rows(study)))
    figure = plot_study(study)
    for name, settings in (
        ("noise.png", {"dpi": 130}),
        ("noise.svg", {"metadata": {"Date": None}}),
    ):
        with written_whole(directory / name) as temporary:
            figure.savefig(temporary, **settings)
    write_text(directory / "noise.md", study_markdown(study))
    return directory / "noise.md"
