"""A recorded run as tables: CSV, Parquet, MATLAB."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.runs.record import RunRecord


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


def write_csv(record: RunRecord, path: Path) -> None:
    wide_table(record).to_csv(path, index=False)


def write_parquet(record: RunRecord, path: Path) -> None:
    try:
        wide_table(record).to_parquet(path, index=False)
    except ImportError as error:
        problem = "Parquet needs pyarrow: pip install 'ffsm-drake[parquet]'"
        raise FfsmError(problem) from error


def write_mat(record: RunRecord, path: Path) -> None:
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
