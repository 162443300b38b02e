"""The guard around every call of user-supplied code.

Whatever such code raises or returns, the caller gets a result that can be used, or a BlockError of
one line with the original exception as its cause. Ctrl-C and a time limit pass through.
"""

import functools
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import ContextDecorator, contextmanager
from importlib.metadata import entry_points
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.common.interrupts import from_keyboard
from ffsm_drake.common.time_limit import TimeLimit

_CALLERS = "of_the_caller"  # attribute of an exception
_OURS = ("ffsm_drake", "pydrake")


def passes(error: BaseException) -> bool:
    """True for exceptions that pass the guard unchanged: Ctrl-C, from the keyboard or this
    package's panel, a time limit, the caller's own, and errors with a message of this package.
    """
    return (
        isinstance(error, (FfsmError, TimeLimit))
        or getattr(error, _CALLERS, False) is True
        or from_keyboard(error)
        or (isinstance(error, KeyboardInterrupt) and _is_ours(error))
    )


@contextmanager
def callers_own() -> Iterator[None]:
    """Mark a call of the caller's function: its exceptions are left to the caller."""
    try:
        yield
    except BaseException as error:
        setattr(error, _CALLERS, True)
        raise


def is_user_supplied(kind: type) -> bool:
    """True for a class that is not from Drake or this package."""
    return kind.__module__.partition(".")[0] not in _OURS


class Guard(ContextDecorator):
    """A block, or a function, with many calls of user-supplied code.

    An exception from such code becomes a BlockError, any other is raised unchanged.
    """

    def __enter__(self) -> None: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        place: TracebackType | None,
    ) -> None:
        if error is None or passes(error):
            return
        if user_frame(error) is not None:
            raise failure(error, f"user-supplied '{_owner(error)}'") from error
        if (name := _suspect(error)) is not None:
            said = f"{type(error).__name__}: {one_line(error)}{where(error)}"
            problem = f"user-supplied '{name}' returns an unusable result: {said}"
            raise BlockError(problem) from error


guarded = Guard()


def calling(
    place: str,
    function: Callable[..., Any],
    *arguments: Any,
    time: float | None = None,
    did: str = "failed",
) -> Any:
    """Call user-supplied code and return its result. Raises the error of ``failure``."""
    try:
        return function(*arguments)
    except BaseException as error:
        if passes(error):
            raise
        raise failure(error, place, time, did) from error


def failure(
    error: BaseException, place: str, time: float | None = None, did: str = "failed"
) -> BlockError:
    """Return the error for a failed block: its place, what it did, time (s), cause, and source
    line.
    """
    at = "" if time is None else f" at t = {time:.2f} s"
    kind = type(error).__name__
    said = f"{kind}: {one_line(error)}{where(error)}{_advice(error)}"
    return BlockError(f"{place} {did}{at}: {said}")


def where(error: BaseException) -> str:
    """Return the innermost user-supplied function of an exception's traceback, with file and
    line.
    """
    found = user_frame(error) or _last_frame(error)
    if found is None:
        return ""
    code, line = found[0].f_code, found[1]
    return f" (in {code.co_qualname}: {code.co_filename}, line {line})"


def _advice(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit):
        return "; raise an Exception to end a run"
    if "read-only" in one_line(error):
        return "; inputs must not be changed in place: copy them"
    return ""


def user_frame(error: BaseException) -> tuple[FrameType, int] | None:
    """Return the innermost frame of user-supplied code in an exception's traceback, or in that of
    its cause, and its line.
    """
    found, place = None, error.__traceback__
    while place is not None:
        if _is_users(place.tb_frame):
            found = place.tb_frame, place.tb_lineno
        place = place.tb_next
    if found is None and error.__cause__ is not None and isinstance(error, Exception):
        return user_frame(error.__cause__)  # as of StopIteration in a generator
    return found


def _last_frame(error: BaseException) -> tuple[FrameType, int] | None:
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    return None if place is None else (place.tb_frame, place.tb_lineno)


def _is_ours(error: BaseException) -> bool:
    """True if this package's own code raised an exception."""
    found = _last_frame(error)
    return found is not None and str(found[0].f_globals.get("__name__")).startswith("ffsm_drake.")


def _suspect(error: BaseException) -> str | None:
    """Return the class of the user-supplied object in use when this package failed on the object's
    result; None: there was none.
    """
    found, place = None, error.__traceback__
    while place is not None and isinstance(error, Exception) and not isinstance(error, OSError):
        frame = place.tb_frame
        module = str(frame.f_globals.get("__name__", ""))
        if module.startswith("ffsm_drake.") and not module.startswith("ffsm_drake.cli"):
            for value in list(frame.f_locals.values()):
                for each in (value, *getattr(value, "__dict__", {}).values()):
                    found = type(each).__name__ if _is_users_object(each) else found
        place = place.tb_next
    return found


def _is_users_object(value: Any) -> bool:
    module = type(value).__module__
    file = getattr(sys.modules.get(module), "__file__", None) or "<frozen"
    return _is_users_file(module.partition(".")[0], file)


def _is_users(frame: FrameType) -> bool:
    top = str(frame.f_globals.get("__name__", "")).partition(".")[0]
    return _is_users_file(top, frame.f_code.co_filename)


def _is_users_file(top: str, file: str) -> bool:
    """True for a file of user-supplied code, whose top-level package or module is given."""
    if top in _OURS or file.startswith("<frozen"):
        return False
    return not is_installed(file) or top in _offering_packages()


def user_code_is_loaded() -> bool:
    """True if a module of user-supplied code is loaded, in addition to the script that runs."""
    return any(
        _is_users_file(name.partition(".")[0], file)
        for name, module in list(sys.modules.items())
        if name not in ("__main__", "__mp_main__")
        and (file := getattr(module, "__file__", None)) is not None
    )


def is_installed(file: str) -> bool:
    """True for a file of Python's library or an installed package."""
    return file.startswith(_installed())


@functools.cache
def _installed() -> tuple[str, ...]:
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    # of an environment below this one, too
    below = [each for each in sys.path if Path(each).name in ("site-packages", "dist-packages")]
    return (*{str(Path(sysconfig.get_path(name))) for name in names}, *below)


@functools.cache  # reads the metadata of every installed package
def _offering_packages() -> frozenset[str]:
    """Top-level names of installed packages that offer blocks."""
    every = entry_points()
    groups = [group for group in every.groups if group.startswith("ffsm_drake.")]
    return frozenset(
        each.module.partition(".")[0] for group in groups for each in every.select(group=group)
    )


def _owner(error: BaseException) -> str:
    """Return the innermost user-supplied class of an exception's traceback, or module where none
    is.
    """
    found, module, place = "", "", error.__traceback__
    while place is not None:
        frame = place.tb_frame
        if _is_users(frame):
            module = str(frame.f_globals.get("__name__", frame.f_code.co_name))
            first = frame.f_code.co_varnames[:1]
            if first in (("self",), ("cls",)) and (owner := frame.f_locals.get(first[0])):
                kind = owner if isinstance(owner, type) else type(owner)
                found = kind.__name__ if is_user_supplied(kind) else found
        place = place.tb_next
    if not module and error.__cause__ is not None:
        return _owner(error.__cause__)
    return found or module
