"""Errors caused by bad input. Each is one line: place, problem, and a valid choice."""

import difflib
import functools
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

_MAX_LENGTH = 1500  # characters of an error text


class FfsmError(Exception):
    """Base class of every error that bad input causes. The text of the error is one line.

    A text of more than 1500 characters is shortened.

    Example:
      >>> from ffsm_drake import FfsmError, load_scenario
      >>> try:
      ...     load_scenario("postcapture", ["payload.truth.mass=-1"])
      ... except FfsmError as error:
      ...     print(type(error).__name__)
      ScenarioError
    """

    def __init__(self, text: str) -> None:
        line = " ".join(text.splitlines())
        super().__init__(
            line
            if len(line) <= _MAX_LENGTH
            else f"{line[: _MAX_LENGTH // 2]} ... {line[-_MAX_LENGTH // 2 :]}"
        )


class ScenarioError(FfsmError):
    """A scenario file, key or override that cannot be used.

    Attributes:
      key: dotted key, such as "payload.truth.mass".
      problem: what is wrong, and a valid choice.
      source: file or option that has the key; empty: none.

    Example:
      >>> from ffsm_drake import ScenarioError, load_scenario
      >>> try:
      ...     load_scenario("postcapture", ["duraton=3"])
      ... except ScenarioError as error:
      ...     print("did you mean 'duration'" in str(error))
      True
    """

    def __init__(self, key: str, problem: str, *, source: str = "") -> None:
        self.key = key
        self.problem = problem
        self.source = source
        super().__init__(": ".join(filter(None, (placed(source, key), problem))))

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(ScenarioError, source=self.source), (self.key, self.problem)

    def located(self, source: str) -> "ScenarioError":
        """Return the same error, with its file named first."""
        return self if self.source else ScenarioError(self.key, self.problem, source=source)


def placed(source: str, text: str) -> str:
    """Return a text after its source: a file, or an option such as ``--set``."""
    return (" " if source.startswith("--") else ": ").join(filter(None, (source, text)))


class LimitError(ScenarioError):
    """A motion that exceeds a limit at any duration; ``limit`` names it."""

    def __init__(self, key: str, problem: str, *, limit: str) -> None:
        super().__init__(key, problem)
        self.limit = limit


class ModelError(FfsmError):
    """A URDF or model directive that does not describe a usable spacecraft.

    Example:
      >>> from ffsm_drake import ModelError, load_scenario, make_true_plant
      >>> scenario = load_scenario("postcapture", ["payload.body=debris::nobody"])
      >>> try:
      ...     make_true_plant(scenario)
      ... except ModelError as error:
      ...     print("nobody" in str(error))
      True
    """


class BlockError(FfsmError):
    """A user-supplied controller or other block that cannot be loaded, built, wired or run.

    Attributes:
      log: samples before a failure in ``Rollout.run``; None: there are none.
      record: record of the samples before a failure in ``simulate``; None: there is none.

    Example:
      >>> from ffsm_drake import BlockError, load_scenario, simulate
      >>> scenario = load_scenario("postcapture", ["controller=nowhere:Law"])
      >>> try:
      ...     simulate(scenario)
      ... except BlockError as error:
      ...     print("nowhere" in str(error))
      True
    """

    log: Any = None
    record: Any = None


class RecordError(FfsmError):
    """A run folder that cannot be written or read.

    Example:
      >>> from ffsm_drake import RecordError, RunRecord
      >>> try:
      ...     RunRecord.load("no_such_folder")
      ... except RecordError as error:
      ...     print("no_such_folder" in str(error))
      True
    """


class CampaignError(FfsmError):
    """A campaign that cannot be planned, run or read."""


class InterruptedCampaign(KeyboardInterrupt):
    """The campaign was interrupted; finished runs are stored."""

    def __init__(self, done: int, total: int) -> None:
        super().__init__(f"interrupted after run {done} of {total}")


class WorkersError(FfsmError):
    """Worker processes, or a cluster, that cannot do the work."""


def one_line(error: BaseException) -> str:
    """Return the text of any exception on a single line; the name of its type where it has none."""
    try:
        text = str(error)
    except (Exception, GeneratorExit, SystemExit):  # a user's exception may fail even here
        text = ""
    return " ".join(text.split()) or type(error).__name__


def some(names: Iterable[str], length: int = 70) -> str:
    """Return names as text of about ``length`` characters, with the number of further names.

    Without any name it is "none".
    """
    known = list(names)
    shown = next((k for k in range(len(known), 1, -1) if len(", ".join(known[:k])) <= length), 1)
    more = len(known) - shown
    return ", ".join(known[:shown]) + f" and {more} more" * (more > 0) or "none"


def did_you_mean(name: object, valid: Iterable[str]) -> str:
    """``; did you mean 'x'?`` with the closest valid name, or an empty string when none is
    close.
    """
    close = difflib.get_close_matches(str(name), list(valid), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def choices(name: object, valid: Iterable[str]) -> str:
    """Return ``some`` names and the closest one, ``did_you_mean``."""
    valid = list(valid)
    close = did_you_mean(name, valid)
    return some(valid, 48 if close else 70) + close


@contextmanager
def spared(what: str, failed: list[str] | None = None) -> Iterator[None]:
    """A step that a record can do without: whatever it raises becomes a warning, or an entry."""
    try:
        yield
    except (Exception, SystemExit) as error:
        kind = "" if isinstance(error, FfsmError) else f"{type(error).__name__}: "
        line = f"{what} not made: {kind}{one_line(error)}"
        if failed is None:
            warnings.warn(line, stacklevel=3)
        else:
            failed.append(line)


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print warnings as single lines on standard error, each once, without their place in the
    source.
    """
    said = set[str]()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        line = f"warning: {' '.join(str(message).split())}"
        if line not in said:
            said.add(line)
            print(line, file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
