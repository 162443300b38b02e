"""Ctrl-C, SIGTERM and SIGHUP on the command line end the process with 128 and their number, and no
partial file.

An exception raised at any moment would not work: within an import it becomes an ImportError,
within a library's callback it is printed and forgotten. So the handler itself removes unfinished
files and ends the process. Within ``interruptible`` a first signal raises KeyboardInterrupt;
within ``undisturbed`` it waits. Without ``handle_signals`` these change nothing. This module is
imported before anything else, so it imports next to nothing.
"""

import contextlib
import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import FrameType


SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupts:
    """A process's signal handler and its state."""

    def __init__(self) -> None:
        self.number = 0  # the first signal received
        self.raises = self.waits = False
        self.waiting = 0  # the pending signal
        self.unfinished: set[Path] = set()  # files and folders to remove
        self.unused: list[Path] = []  # folders to remove where they are empty, innermost first

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        first, self.number = not self.number, self.number or number
        if self.waits:
            self.waiting = number
        elif self.raises and first:
            raise KeyboardInterrupt
        else:
            for path in list(self.unfinished):
                _remove(path)
            _remove_empty(self.unused)
            os._exit(128 + number)


def handle_signals() -> None:
    """End this process on these signals as described above; ignored ones stay ignored."""
    interrupts = Interrupts()
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupts)


def ignore_signals() -> None:
    """Ignore them while the process ends."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def current() -> Interrupts | None:
    """The handler of this process, or None."""
    for number in SIGNALS:
        if isinstance(handler := signal.getsignal(number), Interrupts):
            return handler
    return None


def exit_code() -> int:
    """Exit code of an interrupted process: 143 after SIGTERM, 129 after SIGHUP, else 130."""
    interrupts = current()
    return 128 + (signal.SIGINT if interrupts is None else interrupts.number or signal.SIGINT)


def from_keyboard(error: BaseException) -> bool:
    """True for a KeyboardInterrupt from a signal, false for one raised by code."""
    if not isinstance(error, KeyboardInterrupt):
        return False
    if (interrupts := current()) is not None:
        return interrupts.number != 0
    from opcode import opmap

    # Python's own handler raises between two instructions, another one in a frame of its own.
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    if place is None:
        return True
    code = place.tb_frame.f_code
    handler = getattr(signal.getsignal(signal.SIGINT), "__code__", None)
    return code is handler or code.co_code[place.tb_lasti] != opmap["RAISE_VARARGS"]


@contextlib.contextmanager
def interruptible() -> "Iterator[Interrupts]":
    """Raise KeyboardInterrupt on the first of these signals in the block.

    Yields the handler, which keeps the signal's number if the exception is lost.
    """
    interrupts = current() or Interrupts()
    before, interrupts.raises = interrupts.raises, True
    try:
        yield interrupts
    finally:
        interrupts.raises = before


@contextlib.contextmanager
def undisturbed() -> "Iterator[None]":
    """Defer these signals to the end of the block."""
    interrupts = current() or Interrupts()
    before, interrupts.waits = interrupts.waits, True
    try:
        yield
    finally:
        interrupts.waits = before
        if interrupts.waiting and not before:
            interrupts(interrupts.waiting, None)


@contextlib.contextmanager
def unfinished(path: "Path") -> "Iterator[None]":
    """Remove a temporary file or folder after the block, however it ends."""
    interrupts = current() or Interrupts()
    interrupts.unfinished.add(path)
    try:
        yield
    finally:
        _remove(path)
        interrupts.unfinished.discard(path)


@contextlib.contextmanager
def unused(folders: "list[Path]") -> "Iterator[None]":
    """Remove those of the folders, innermost first, that are there and empty after the block."""
    interrupts = current() or Interrupts()
    before, interrupts.unused = interrupts.unused, [*folders, *interrupts.unused]
    try:
        yield
    finally:
        _remove_empty(folders)
        interrupts.unused = before


def _remove_empty(folders: "list[Path]") -> None:
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


def _remove(path: "Path") -> None:
    import shutil

    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()
