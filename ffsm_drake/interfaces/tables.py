"""A recorded run for other programs: CSV, Parquet, MATLAB, MCAP, CCSDS, by a file's ending."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.files import check_writable, written_whole
from ffsm_drake.interfaces.ccsds import write_aem, write_oem
from ffsm_drake.runs.record import RunRecord


def export(record: RunRecord, path: Path, *, ros2: bool = False) -> None:
    """Write a run's series to a file, whose ending is one of ``FORMATS``; an .mcap with messages of
    ROS 2, if asked for.

    Raises: FfsmError, if the ending is another, its library is missing, or the run does not have
    what it holds.
    """
    if path.suffix not in FORMATS:
        raise FfsmError(f"--to: '{path}' must end in {', '.join(FORMATS)}, .fmu")
    check_writable(path.parent)
    with written_whole(path) as temporary:
        _ros2(record, temporary) if ros2 else FORMATS[path.suffix](record, temporary)


def wide_table(record: RunRecord) -> pd.DataFrame:
    """A row for each control sample; columns ``variable`` or ``variable.component``."""
    data = record.dataset
    columns = {"time": data.time.values}
    for name, series in data.data_vars.items():
        if series.dims == ("time",):
            columns[str(name)] = series.values
        elif len(series.dims) == 2 and series.dims[0] == "time":
            for part, values in zip(data[series.dims[1]].values, series.values.T, strict=True):
                columns[f"{name}.{part}"] = values
    return pd.DataFrame(columns)


def _csv(record: RunRecord, path: Path) -> None:
    wide_table(record).to_csv(path, index=False)


def _parquet(record: RunRecord, path: Path) -> None:
    try:
        wide_table(record).to_parquet(path, index=False)
    except ImportError as error:
        problem = "Parquet needs pyarrow: pip install 'ffsm-drake[parquet]'"
        raise FfsmError(problem) from error


def _mat(record: RunRecord, path: Path) -> None:
    from scipy.io import savemat  # SciPy is slow

    data = record.dataset
    fields: dict[str, Any] = {}
    for name, series in data.variables.items():
        values = series.values
        fields[str(name)] = {
            "values": values if values.dtype.kind in "biuf" else np.array(values, dtype=object),
            "units": str(series.attrs.get("units", "")),
            "along": np.array(series.dims, dtype=object),
        }
    savemat(str(path), {"run": fields}, appendmat=False, long_field_names=True, oned_as="column")


def _mcap(record: RunRecord, path: Path) -> None:
    from ffsm_drake.interfaces.foxglove import write  # Drake's geometry

    write(record, path)


def _ros2(record: RunRecord, path: Path) -> None:
    from ffsm_drake.interfaces.ros2 import write  # Drake's geometry

    write(record, path)


FORMATS = {
    ".mat": _mat,
    ".csv": _csv,
    ".parquet": _parquet,
    ".mcap": _mcap,
    ".aem": write_aem,
    ".oem": write_oem,
}
