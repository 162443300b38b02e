"""Tracing of user-supplied laws, in a copy of this process.

A law may keep numbers outside of its memory: in its class, its module or a random generator. On
symbols it would keep symbols, which its next run on Drake would meet.
"""

import os
import select
import signal
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ffsm_drake.common.errors import one_line
from ffsm_drake.plugins.tape import numbers
from ffsm_drake.plugins.tape.numbers import NotTraceable

_LONGEST = 120.0  # s
_MOST = 60  # characters of another library's message
_TRACERS = {Path(__file__).parent, Path(numbers.__file__).parent}  # folders, not of laws


class Refused(NotTraceable):
    """The reason why code is not traced, with its place."""


def reason_of(error: BaseException) -> str:
    """Return where and why code of a law fails on symbols, in one line."""
    if isinstance(error, Refused):
        return str(error)
    text = one_line(error)
    if not isinstance(error, NotTraceable):
        text = f"{type(error).__name__} on symbols: {text.partition('. ')[0][:_MOST]}"
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if "numpy" not in path.parts and path.parent not in _TRACERS:
            return f"{path.name}:{frame.lineno}: {text}"
    return text


def apart(make: Callable[[], str]) -> str:
    """Return the text that ``make`` returns in a copy of this process. Raises Refused."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of processes with several threads
        child = os.fork()
    if child == 0:
        _be_copy(make, writing)
    os.close(writing)
    told = b""
    try:
        with os.fdopen(reading, "rb") as pipe:
            if select.select([pipe], [], [], _LONGEST)[0]:
                told = pipe.read()
    finally:
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    if not told:
        raise Refused("the copy of this process that traces the law ended, or took too long")
    made, text = told[:1] == b"=", told[1:].decode()
    if not made:
        raise Refused(text)
    return text


def _be_copy(make: Callable[[], str], writing: int) -> None:
    """Write what ``make`` returns, or why it fails, and end."""
    try:
        signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            told = f"={make()}"
        except BaseException as error:  # a law may raise anything
            told = f"!{reason_of(error)}"
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(told.encode(errors="replace"))
    finally:
        os._exit(0)
