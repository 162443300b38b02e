"""Files: written whole or not at all, and checked before they are opened.

A reader never sees half a file or half a set of files; a failed write keeps the old ones.
"""

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ffsm_drake.common.errors import RecordError, one_line
from ffsm_drake.common.interrupts import undisturbed, unfinished, unused


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder with its parents; remove those it made if they are empty after the block."""
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    with unused(missing):
        folder.mkdir(parents=True, exist_ok=True)
        yield


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``; rename it into place when the block succeeds.

    Creates missing folders, and removes them where it fails. Raises RecordError when the place
    cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        with made_folder(path.absolute().parent), unfinished(temporary):
            yield temporary
            temporary.replace(path)
    except OSError as error:
        raise _unwritten(path, error, temporary) from error


@contextmanager
def published(directory: Path, *, outdated: Iterable[str] = ()) -> Iterator[Path]:
    """Yield a new folder for files, which replace those of ``directory`` when the block succeeds.

    If ``directory`` does not exist, the new folder is renamed to it. An existing one stays (it may
    be somebody's current folder, and hold other files): its files of the same names and the
    ``outdated`` ones are replaced, or all restored.

    Raises:
      RecordError: the place cannot be written.
    """
    place = directory.absolute()
    exists = os.path.isdir(place)
    partial = f"{os.getpid()}.partial"
    new = place / f".{partial}" if exists else place.with_name(f".{place.name}.{partial}")
    try:
        with made_folder(new.parent), unfinished(new):
            new.mkdir(exist_ok=True)
            yield new
            with undisturbed():
                if exists:
                    _exchange(new, place, outdated)
                else:
                    new.rename(place)
    except OSError as error:
        raise _unwritten(directory, error, new) from error
    except RecordError as error:  # of a file in the new folder, which has gone
        raise RecordError(str(error).replace(str(new), str(directory))) from error


def _unwritten(place: Path, error: OSError, temporary: Path) -> RecordError:
    """The error of a file or folder; its text does not name the temporary one, which has gone."""
    text = one_line(error).replace(str(temporary), str(place))
    return RecordError(f"{place}: cannot be written: {text}")


def _exchange(new: Path, directory: Path, outdated: Iterable[str]) -> None:
    """Move a subfolder's files up into ``directory``; replaced and ``outdated`` files go."""
    names = [path.name for path in new.iterdir()]
    for name in names:
        if (directory / name).is_dir():
            raise IsADirectoryError(f"{directory / name} is a folder; move it away")
    old = new / "old"
    old.mkdir()
    moves = [
        (directory / name, old / name)
        for name in (*names, *outdated)
        if os.path.lexists(directory / name)
    ]
    moves += [(new / name, directory / name) for name in names]
    done: list[tuple[Path, Path]] = []
    try:
        for before, after in moves:
            before.rename(after)
            done.append((before, after))
    except BaseException:
        for before, after in reversed(done):
            after.rename(before)
        raise


@contextmanager
def same_folder() -> Iterator[None]:
    """Return to the current folder after the block: a user-supplied controller may change it."""
    try:
        before = os.open(".", os.O_RDONLY)
    except OSError:  # deleted or unreadable
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            os.fchdir(before)
        os.close(before)


def check_regular(path: Path, *, limit: int) -> None:
    """Raise OSError for a device, a FIFO (reading it may never end), or a file that is too large.

    Args:
      limit: largest size, bytes.
    """
    info = path.stat()
    if stat.S_ISDIR(info.st_mode):
        raise OSError("is a folder")
    if not stat.S_ISREG(info.st_mode):
        raise OSError("is not a regular file")
    if info.st_size > limit:
        raise OSError(f"has {info.st_size:.3g} bytes; at most {limit:.3g} are read")


def check_writable(directory: Path) -> None:
    """Raise RecordError unless a folder, existing or not, could be written to; creates nothing."""
    place = directory.absolute()
    try:
        while not _exists(place):
            place = place.parent
        if not place.is_dir():
            raise RecordError(
                f"{directory}: cannot be written: {place} is not a folder; give another one"
            )
        if not os.access(place, os.W_OK | os.X_OK):
            raise RecordError(
                f"{directory}: cannot be written: no permission to write into {place}; give "
                "another one"
            )
    except (OSError, ValueError) as error:  # too long, holds a null character, ...
        raise RecordError(f"{directory}: cannot be written: {one_line(error)}") from error


def _exists(path: Path) -> bool:
    """Like os.path.lexists, but raises OSError for an impossible name or a folder without
    permission.
    """
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file whole."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
