"""Atomic writes: a reader never sees half a file, and a failed write keeps the old one."""

import csv
import io
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ffsm_drake.common.errors import RecordError, one_line


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to, and rename it into place when the block succeeds.

    Creates missing folders. Raises RecordError when the place cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise RecordError(f"{path}: cannot be written: {one_line(error)}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_together(files: Mapping[Path, Callable[[Path], object]]) -> None:
    """Write several files: each value writes to the path it is given; no file is replaced before all are written.

    A failed write keeps all the old files. Raises RecordError naming the file that cannot be written.
    """
    with ExitStack() as stack:
        # Left in reverse order: the last file is replaced last.
        temporaries = {path: stack.enter_context(written_whole(path)) for path in reversed(list(files))}
        for path, write in files.items():
            try:
                write(temporaries[path])
            except OSError as error:
                raise RecordError(f"{path}: cannot be written: {one_line(error)}") from error


def check_writable(directory: Path) -> None:
    """Raise RecordError unless files could be written into a folder, which need not exist; creates nothing."""
    place = directory.absolute()
    try:
        while not _exists(place):
            place = place.parent
        if not place.is_dir():
            raise RecordError(f"{directory}: cannot be written: {place} is not a folder; give another one")
        if not os.access(place, os.W_OK | os.X_OK):
            raise RecordError(f"{directory}: cannot be written: no permission to write into {place}; give another one")
    except (OSError, ValueError) as error:  # too long, holds a null character, ...
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error


def _exists(path: Path) -> bool:
    """Like os.path.lexists, but raises OSError for an impossible name or a folder without permission."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file whole."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of the same columns as comma-separated values; numbers with eight digits, empty where not finite."""

    def cell(value: Any) -> Any:
        return value if not isinstance(value, float) else f"{value:.8g}" if math.isfinite(value) else ""

    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: cell(value) for name, value in row.items()} for row in rows)
    return text.getvalue()
