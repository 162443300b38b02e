"""Files: written whole or not at all, and checked before they are opened.

A reader never sees half a file or half a set of files; a failed write keeps the old ones.
"""

import errno
import fcntl
import itertools
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from ffsm_drake.common.errors import FfsmError, RecordError, one_line
from ffsm_drake.common.interrupts import undisturbed, unfinished, unused

_SERIAL = itertools.count()
_OWN_FOLDER = ".inputs"  # end of the name of a folder that is replaced as a whole
_PATIENCE = 2.0  # s to wait for another program that exchanges a folder's files
Result = TypeVar("Result")


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder with its parents; remove those it made if they are empty after the block."""
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    with unused(missing):
        folder.mkdir(parents=True, exist_ok=True)
        yield


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``, and rename it when the block succeeds.

    Missing folders are created, and removed if the block fails. Raises RecordError if the place
    cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{_partial()}{path.suffix}")
    try:
        with made_folder(path.absolute().parent), unfinished(temporary):
            yield temporary
            temporary.replace(path)
    except OSError as error:
        raise _unwritten(path, error, temporary) from error


def stamp(path: Path) -> tuple[int, ...] | None:
    """Return the file status that changes with every rewrite; None: the file does not exist."""
    status = _status(path)
    return None if status is None else status[:3]


def _status(path: Path) -> tuple[int, ...] | None:
    """``stamp``, and what changes even if a copy with the times of the old file gets its number."""
    try:
        info = path.stat()
    except (OSError, ValueError):
        return None
    return info.st_ino, info.st_mtime_ns, info.st_size, info.st_ctime_ns


@contextmanager
def published(
    directory: Path,
    *,
    outdated: Iterable[str] = (),
    is_taken: Callable[[], bool] = lambda: False,
    elsewhere: list[Path] | None = None,
) -> Iterator[Path]:
    """Yield a new folder for files; they replace those of ``directory`` when the block succeeds.

    If ``directory`` does not exist, the new folder is renamed to it. An existing one stays (it may
    be somebody's current folder, and hold other files): its files of the same names and the
    ``outdated`` ones are replaced, or all restored; ``read_together`` sees no mixture.

    Args:
      is_taken: called before files of ``directory`` are replaced; True if they belong to another
        run. The new folder is then renamed to the next free NAME_2, NAME_3, ...
      elsewhere: list; receives that folder.

    Raises:
      RecordError: the place cannot be written.
    """
    place = directory.absolute()
    inside = os.path.isdir(place)
    new = place / f".{_partial()}" if inside else place.with_name(f".{place.name}.{_partial()}")
    try:
        with made_folder(new.parent), unfinished(new):
            new.mkdir(exist_ok=True)
            yield new
            with undisturbed():
                if not _renamed(new, place):  # it exists, or has been created in the meantime
                    with _alone(place):
                        if is_taken():
                            found = _next_free(new, place.resolve())
                            if elsewhere is not None:
                                is_named = directory.is_absolute()
                                elsewhere.append(
                                    found if is_named else Path(os.path.relpath(found))
                                )
                        else:
                            _exchange(new, place, outdated)
    except OSError as error:
        raise _unwritten(directory, error, new) from error
    except RecordError as error:  # error of a file in the new folder, now removed
        raise RecordError(str(error).replace(str(new), str(directory))) from error


def read_together(paths: Sequence[Path], read: Callable[[], Result]) -> Result:
    """Read files of one folder, all old or all new while others are ``published`` there. Raises the
    errors of the function for existing files.
    """
    before = _states(paths)
    try:
        found = read()
        if before == _states(paths):
            return found
    except FfsmError:
        pass
    with ExitStack() as stack:
        is_locked = False
        with suppress(OSError):  # no such folder, or no permission to list it
            is_locked = stack.enter_context(_alone(paths[0].parent, fcntl.LOCK_SH))
        return _read_unchanged(paths, read, is_locked=is_locked)


def _read_unchanged(
    paths: Sequence[Path], read: Callable[[], Result], *, is_locked: bool
) -> Result:
    """Read files until they stay the same meanwhile. Without a lock, an error counts once no other
    program exchanges files.
    """
    while True:
        before = _states(paths)
        try:
            found = read()
        except FfsmError:
            until = time.monotonic() + _PATIENCE
            while not is_locked:
                # asked before the states: an exchange may end in between
                final = time.monotonic() > until or not any(paths[0].parent.glob(".*.partial"))
                if before != _states(paths) or final:
                    break
                time.sleep(0.01)
            if before == _states(paths):
                raise
        else:
            if before == _states(paths):
                return found


def _states(paths: Sequence[Path]) -> list[tuple[int, ...] | None]:
    """Return what changes when files are exchanged."""
    return list(map(_status, paths))


def _partial() -> str:
    """Return the name of what is not finished yet; another one each time."""
    return f"{os.getpid()}.{next(_SERIAL)}.partial"


def _renamed(new: Path, place: Path) -> bool:
    """Rename a folder, unless there is one with files, or a file, of that name."""
    if new.parent == place:
        return False
    try:
        new.rename(place)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR) and place.is_dir():
            return False
        raise
    return True


def _next_free(new: Path, place: Path) -> Path:
    for number in itertools.count(2):
        found = place.with_name(f"{place.name}_{number}")
        if os.path.lexists(found):
            continue
        try:
            new.rename(found)
        except OSError as error:  # it has been created in the meantime
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
            continue
        return found
    raise AssertionError


@contextmanager
def _alone(directory: Path, kind: int = fcntl.LOCK_EX) -> Iterator[bool]:
    """Lock a folder against exchanges of its files by other programs, if possible in time: some
    file systems have no locks, and the holder of a lock may be stopped. Yields whether it is.
    """
    folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until = time.monotonic() + _PATIENCE
        is_locked = False
        while not is_locked:
            try:
                fcntl.flock(folder, kind | fcntl.LOCK_NB)
                is_locked = True
            except OSError as error:
                if error.errno != errno.EWOULDBLOCK or time.monotonic() > until:
                    break
                time.sleep(0.01)
        yield is_locked
    finally:
        os.close(folder)


def _unwritten(place: Path, error: OSError, temporary: Path) -> RecordError:
    """Return the error of a file or folder; its text does not name the temporary one, which has
    gone.
    """
    text = one_line(error).replace(str(temporary), str(place))
    return RecordError(f"{place}: cannot be written: {text}")


def _exchange(new: Path, directory: Path, outdated: Iterable[str]) -> None:
    """Replace the files of a folder with those of a new one, and remove ``outdated`` files."""
    names = [path.name for path in new.iterdir()]
    there = [name for name in {*names, *outdated} if os.path.lexists(directory / name)]
    folders = [name for name in there if (directory / name).is_dir()]
    for name in folders:
        if not name.endswith(_OWN_FOLDER):
            raise IsADirectoryError(f"{directory / name} is a folder; move it away")
    old = new / "old"
    old.mkdir()
    done: list[str] = []
    try:
        for name in there:
            if name in folders:
                (directory / name).rename(old / name)
                done.append(name)
                continue
            try:
                os.link(directory / name, old / name, follow_symlinks=False)
            except OSError:  # some file systems have no links
                shutil.copy2(directory / name, old / name, follow_symlinks=False)
        for name in names:
            (new / name).replace(directory / name)
            done.append(name)
        for name in set(there).difference(names, folders):
            (directory / name).unlink()
            done.append(name)
    except BaseException:
        for name in dict.fromkeys(done):
            if (directory / name).is_dir():
                (directory / name).rename(new / name)
            if name in there:
                (old / name).replace(directory / name)
            else:
                (directory / name).unlink(missing_ok=True)
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
