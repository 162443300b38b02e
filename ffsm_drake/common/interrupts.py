"""Ctrl-C and SIGTERM on the command line: the process ends, at any moment, with 130 or 143 and no
partial file.

An exception at any moment would not do: within an import it becomes an ImportError, within a
callback of a library it is printed and forgotten. So the handler itself ends the process, after it
has removed what is unfinished. Only within ``interruptible`` does a first signal raise
KeyboardInterrupt, and within ``undisturbed`` it waits. In a program that does not
``handle_signals`` these change nothing. Imported before anything else, this imports next to
nothing.
"""

import contextlib
import os
import signal

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from types import FrameType


class Interrupts:
    """The handler of a process's signals, and what it needs to know."""

    def __init__(self) -> None:
        self.number = 0  # of the first signal that came
        self.raises = self.waits = False
        self.waiting = 0  # a signal that waits
        self.unfinished: set[Path] = set()  # files and folders to remove

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        first, self.number = not self.number, self.number or number
        if self.waits:
            self.waiting = number
        elif self.raises and first:
            raise KeyboardInterrupt
        else:
            for path in list(self.unfinished):
                _remove(path)
            os._exit(128 + number)


def handle_signals() -> None:
    """End this process on Ctrl-C and SIGTERM as described above; a signal that is ignored stays
    so.
    """
    interrupts = Interrupts()
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupts)


def ignore_signals() -> None:
    """For the end of the process, when all is done."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def current() -> Interrupts | None:
    """The handler of this process, if it has one."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if isinstance(handler := signal.getsignal(number), Interrupts):
            return handler
    return None


def exit_code() -> int:
    """Of an interrupted process: 143 after SIGTERM, else 130."""
    interrupts = current()
    return 128 + (signal.SIGINT if interrupts is None else interrupts.number or signal.SIGINT)


@contextlib.contextmanager
def interruptible() -> "Iterator[Interrupts]":
    """Within, a first Ctrl-C or SIGTERM raises KeyboardInterrupt; what is given remembers it,
    should that be lost.
    """
    interrupts = current() or Interrupts()
    before, interrupts.raises = interrupts.raises, True
    try:
        yield interrupts
    finally:
        interrupts.raises = before


@contextlib.contextmanager
def undisturbed() -> "Iterator[None]":
    """Within, Ctrl-C and SIGTERM wait."""
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
    """Within, a file or folder is temporary; it is gone afterwards, however this ends."""
    interrupts = current() or Interrupts()
    interrupts.unfinished.add(path)
    try:
        yield
    finally:
        _remove(path)
        interrupts.unfinished.discard(path)


def _remove(path: "Path") -> None:
    import shutil

    with contextlib.suppress(OSError):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()
