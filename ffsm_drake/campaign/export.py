"""The view ``runs`` of a campaign's database as CSV or Parquet."""

import csv
import importlib
import itertools
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from ffsm_drake.campaign.errors import CampaignError

CHUNK = 10_000  # rows held at a time
WHOLE = ("case_index", "random_seed")


def write_csv(path: Path, columns: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def write_parquet(
    path: Path, columns: Sequence[str], rows: Iterator[tuple[Any, ...]], *, texts: Collection[str]
) -> None:
    """Write rows; the columns named in ``texts`` are strings. Raises CampaignError without ``pyarrow``."""
    try:
        pa: Any = importlib.import_module("pyarrow")  # optional, and without types
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise CampaignError("Parquet needs the extra 'parquet': pip install 'ffsm-drake[parquet]'") from None
    types = {name: pa.string() if name in texts else pa.int64() if name in WHOLE else pa.float64() for name in columns}
    schema = pa.schema(list(types.items()))
    with pq.ParquetWriter(path, schema) as writer:
        while chunk := list(itertools.islice(rows, CHUNK)):
            cells = [
                [None if value is None else str(value) for value in column] if name in texts else column
                for name, column in zip(columns, zip(*chunk, strict=True), strict=True)
            ]
            writer.write_table(pa.table(cells, schema=schema))
