"""Ctrl-C, SIGTERM and SIGHUP on the command line end the process with 128 and their number, and no
partial file.

An exception raised at any moment would not work: within an import it becomes an ImportError,
within a library's callback it is printed and forgotten. So the handler itself removes unfinished
files, kills the processes below, and ends the process. Within ``interruptible`` a first signal
raises KeyboardInterrupt, within ``stopping`` it calls a function; within ``undisturbed`` it waits.
Without ``handle_signals`` these change nothing. This module is imported before anything else, so
it imports next to nothing.

Python runs a handler between two of its instructions only: not while compiled code works or
waits, nor where user-supplied code catches everything. So a second process, ``watch``, reads the
numbers of signals, which Python's C code writes to a pipe at once, and acts where this one does
not: after GRACE it repeats the signal, then it kills.
"""

import contextlib
import os
import signal
import time

from ffsm_drake.common.processes import kill_below

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from pathlib import Path
    from types import FrameType


ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE = 7.0  # s for what a first signal ends, after which the signal is repeated
_AT_ONCE = 2.0  # s for the end after a second one
_SAME = 0.2  # s within which it is the same signal, sent on by a wrapper such as ``timeout``
_SILENCE = 0.3  # s to the first line after a signal
_WRITING = 60.0  # s for a result that is being written
_MOST = 4000  # bytes of a message, less than what a pipe takes at once


class Interrupts:
    """A process's signal handler and its state."""

    def __init__(self) -> None:
        self.number = 0  # the first signal received
        self.raises = self.waits = False
        self.stop: Callable[[], None] | None = None  # instead of an exception
        self.waiting = 0  # the pending signal
        self.words: list[str] = []  # of the command that goes on, if it is another one
        self._last = -1.0  # time of the last signal
        self.left: dict[Path, bool] = {}  # to remove; True: folders, where they are empty
        self.pid = os.getpid()
        self.spared = set[int]()  # processes below this one that are not killed
        self._pipe = -1

    def __call__(self, number: int, frame: "FrameType | None") -> None:
        now = time.monotonic()
        same, self._last = now - self._last < _SAME, now
        first, self.number = not self.number, self.number or number
        if self.waits:
            self.waiting = number
        elif same:
            return
        elif first and self.stop is not None:
            self.stop()
        elif first and self.raises:
            raise KeyboardInterrupt
        else:
            self.end(number)

    def act(self) -> None:
        """Handle the pending signal."""
        number, self.waiting, self._last = self.waiting, 0, -1.0
        if number:
            self(number, None)

    def end(self, number: int) -> None:
        """End this process now, with those below it."""
        self.clear()
        _say(self.last_words())
        os._exit(128 + number)

    def last_words(self, ended: str = "interrupted") -> str:
        """Return the line that names the command to type next."""
        import shlex
        import sys

        self.tell(b".", "")  # it shall be the last
        how, words = ("go on", self.words) if self.words else ("again", sys.argv[1:])
        return f"{ended}; {how}: {shlex.join(['ffsm', *words])}"

    def leave_none(self, paths: "Iterable[Path]", *, empty: bool = False) -> None:
        """Remove files and folders, or folders that are ``empty``, at a sudden end."""
        for path in [path.absolute() for path in paths]:
            self.left[path] = empty
            self.tell(b"/" if empty else b"+", path)

    def keep(self, paths: "Iterable[Path]") -> None:
        """Undo ``leave_none``."""
        for path in [path.absolute() for path in paths]:
            self.left.pop(path, None)
            self.tell(b"-", path)

    def watch(self) -> None:
        """Start the watcher, while this process has one thread; it ends with this process."""
        reading, writing = os.pipe()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING_SIGNALS)
        try:
            watcher = os.fork()
        except OSError:  # no more processes are allowed
            watcher = -1
        if watcher == 0:  # the signals remain blocked
            try:
                os.close(writing)
                _Watcher(self, reading).follow()
            finally:
                os._exit(0)
        os.close(reading)
        os.set_blocking(writing, False)
        self.spared.add(watcher)
        self._pipe = writing
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        os.register_at_fork(after_in_child=self._be_fork)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _be_fork(self) -> None:
        """Forget what is the parent's."""
        signal.set_wakeup_fd(-1)
        os.close(self._pipe)
        self._pipe, self.pid = -1, os.getpid()
        self.left.clear()

    def tell(self, kind: bytes, text: "str | Path") -> None:
        """Tell the watcher."""
        message = kind + os.fsencode(text) + b"\0"
        if self._pipe >= 0 and len(message) <= _MOST:
            with contextlib.suppress(OSError):
                os.write(self._pipe, message)

    def clear(self) -> None:
        """Kill the processes below, and remove what is unfinished."""
        kill_below(self.pid, but=self.spared)
        left = [*self.left.items()]  # empty ones last, innermost first
        for path, empty in sorted(left, key=lambda each: (each[1], -len(each[0].parts))):
            _remove(path, empty=empty)


class _Watcher:
    """The second process: it follows the signals and messages of the first."""

    def __init__(self, of: Interrupts, pipe: int) -> None:
        """Args: the handler as it was at the fork; the pipe that it writes to."""
        self._of, self._pipe = of, pipe
        self._number = 0  # the first signal
        self._begun = self._end = 0.0  # its time, and the end of the first process's time
        self._rest = b""  # of a message
        self._said = self._repeated = False

    def follow(self) -> None:
        """Follow the first process to its end, or bring that about."""
        import select

        self._of.spared.add(os.getpid())
        while True:
            due = self._end if self._said else self._begun + _SILENCE
            patience = max(0.0, due - time.monotonic()) if self._number else None
            if select.select([self._pipe], [], [], patience)[0]:
                if not (more := os.read(self._pipe, 1 << 16)):
                    return  # it has ended
                self._read(self._rest + more)
            elif os.getppid() != self._of.pid:
                return
            elif not self._said:
                self._said = True
                _say(
                    f"ending: the present step has {GRACE:.0f} s to finish; a second signal "
                    "ends it at once"
                )
            elif not self._repeated:
                self._repeated = True
                self._end = time.monotonic() + _AT_ONCE
                os.kill(self._of.pid, self._number)
            else:
                break
        kill_below(self._of.pid, but=self._of.spared)  # before they have another parent
        os.kill(self._of.pid, signal.SIGKILL)
        self._of.clear()
        _say(f"killed: it did not end by itself\n{self._of.last_words()}")

    def _read(self, text: bytes) -> None:
        """Take the numbers of signals and the whole messages out of a text."""
        while text:
            if text[0] < 32:  # the number of a signal
                self._count(text[0])
                text = text[1:]
                continue
            message, found, later = text.partition(b"\0")
            if not found:
                break
            self._obey(message[:1], os.fsdecode(message[1:]))
            text = later
        self._rest = text

    def _count(self, number: int) -> None:
        """A signal of the first process."""
        now = time.monotonic()
        if number in ENDING_SIGNALS and not self._number:
            self._number, self._begun, self._end = number, now, now + GRACE
        elif number in ENDING_SIGNALS and not self._repeated and now > self._begun + _SAME:
            self._said, self._repeated, self._end = True, True, now + _AT_ONCE

    def _obey(self, kind: bytes, text: str) -> None:
        """A message of the first process: see ``Interrupts.tell``."""
        from pathlib import Path

        if kind == b".":
            self._said = True
        elif kind == b"!":
            self._of.words = text.split("\n")
        elif kind == b"=":
            self._of.spared.add(int(text))
        elif kind == b">":
            self._end = max(self._begun + GRACE, time.monotonic() + float(text))
        elif kind == b"-":
            self._of.left.pop(Path(text), None)
        else:
            self._of.left[Path(text)] = kind == b"/"


def _say(line: str) -> None:
    """Write to standard error, below the line of a progress."""
    with contextlib.suppress(OSError):
        os.write(2, f"{chr(10) if os.isatty(2) else ''}{line}\n".encode("utf-8", "replace"))


def handle_signals() -> Interrupts:
    """End this process on these signals as described above; ignored ones stay ignored."""
    interrupts = Interrupts()
    for number in ENDING_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, interrupts)
    return interrupts


def end_at_once() -> None:
    """Let these signals end this process, whose work is done, without a word."""
    for number in ENDING_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def current() -> Interrupts:
    """Return the handler of this process, or one that nothing calls."""
    return _installed() or Interrupts()


def _installed() -> Interrupts | None:
    for number in ENDING_SIGNALS:
        if isinstance(handler := signal.getsignal(number), Interrupts):
            return handler
    return None


def go_on_by(*words: str) -> None:
    """Name, in the last line of an interrupted process, the command that goes on."""
    interrupts = current()
    interrupts.words = list(words)
    interrupts.tell(b"!", "\n".join(words))


def spare(pid: int) -> None:
    """Kill a process below this one not."""
    interrupts = current()
    interrupts.spared.add(pid)
    interrupts.tell(b"=", str(pid))


def last_words(how: str) -> str:
    """Return the last line of an interrupted process."""
    return current().last_words(how)


@contextlib.contextmanager
def writing() -> "Iterator[None]":
    """Give the block, which writes a result after a signal, more time than GRACE."""
    interrupts = current()
    interrupts.tell(b">", str(_WRITING))
    try:
        yield
    finally:
        interrupts.tell(b">", str(_AT_ONCE))


def exit_code() -> int:
    """Exit code of an interrupted process: 143 after SIGTERM, 129 after SIGHUP, else 130."""
    return 128 + (current().number or signal.SIGINT)


def from_keyboard(error: BaseException) -> bool:
    """True for a KeyboardInterrupt from a signal, false for one raised by code."""
    if not isinstance(error, KeyboardInterrupt):
        return False
    if (interrupts := _installed()) is not None:
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
    interrupts = current()
    before, interrupts.raises = interrupts.raises, True
    try:
        yield interrupts
    finally:
        interrupts.raises = before


@contextlib.contextmanager
def stopping(stop: "Callable[[], None]") -> "Iterator[None]":
    """Call a function on the first of these signals in the block; the second ends the process.

    Without ``handle_signals`` the second raises KeyboardInterrupt.
    """
    interrupts, before = _installed(), {}
    if interrupts is None:
        interrupts = _Lent()
        heard = [number for number in ENDING_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
        before = {number: signal.signal(number, interrupts) for number in heard}
    interrupts.stop = stop
    try:
        yield
    finally:
        interrupts.stop = None
        for number, handler in before.items():
            signal.signal(number, handler)


class _Lent(Interrupts):
    """A handler in somebody else's process, which goes on."""

    def end(self, number: int) -> None:
        raise KeyboardInterrupt


@contextlib.contextmanager
def undisturbed() -> "Iterator[None]":
    """Defer these signals to the end of the block."""
    interrupts = current()
    before, interrupts.waits = interrupts.waits, True
    try:
        yield
    finally:
        interrupts.waits = before
        if not before:
            interrupts.act()


def unfinished(path: "Path") -> "contextlib.AbstractContextManager[None]":
    """Remove a temporary file or folder after the block, however it ends."""
    return _removing([path], empty=False)


def unused(folders: "list[Path]") -> "contextlib.AbstractContextManager[None]":
    """Remove those of the folders, innermost first, that are there and empty after the block."""
    return _removing(folders, empty=True)


@contextlib.contextmanager
def _removing(paths: "list[Path]", *, empty: bool) -> "Iterator[None]":
    interrupts = current()
    interrupts.leave_none(paths, empty=empty)
    try:
        yield
    finally:
        for path in paths:
            _remove(path, empty=empty)
        interrupts.keep(paths)


def _remove(path: "Path", *, empty: bool) -> None:
    import shutil

    with contextlib.suppress(OSError):
        if empty:
            path.rmdir()
        elif path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()
