"""Progress on standard error: a command's line, and signs of life."""

import math
import sys
import threading
import time

import click

from ffsm_drake.common.steps import current_step

_WIDTH = 100  # characters of an updated line, which cover the one before
_BAR = 24  # characters
# options of commands that wait for their user
_LIVE = {"--controls", "--meshcat", "--foxglove"}


class ProgressLine:
    """Progress of a command: an updated line on a terminal, elsewhere a line every ``period`` s.

    A context manager: leaving it ends the updated line.
    """

    def __init__(self, period: float = 10.0) -> None:
        self._is_terminal = sys.stderr.isatty()
        self._period = 0.2 if self._is_terminal else period
        self._shown = -math.inf  # s, when the last line was printed
        self._begun = time.monotonic()
        self._is_open = False

    def __enter__(self) -> "ProgressLine":
        return self

    def __exit__(self, *error: object) -> None:
        if self._is_open:
            click.echo(err=True)

    @property
    def seconds(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self._begun

    def show(self, text: str, *, share: float | None = None, last: bool = False) -> None:
        """Print the text if it is due; ``share``: finished part of the work, as a bar on a
        terminal; ``last``: print it in any case, and end the line.
        """
        now = time.monotonic()
        if not last and now - self._shown < self._period:
            return
        self._shown = now
        if not self._is_terminal:
            click.echo(text, err=True)
            return
        bar = "" if share is None else f"[{'#' * int(_BAR * share):.<{_BAR}}] "
        click.echo(f"\r{bar + text:<{_WIDTH}}", nl=last, err=True)
        self._is_open = not last


def show_life(over: threading.Event, *, first: float | None = None, then: float = 10.0) -> None:
    """Print a sign of progress to standard error after ``first`` s of silence (default: 2 on a
    terminal, elsewhere 10), later after ``then`` s, until it is ``over``.
    """
    stream, begun = sys.stderr, time.monotonic()
    silence = first or (2.0 if stream.isatty() else then)
    while not _LIVE.intersection(sys.argv) and not over.wait(0.2 * silence):
        now = time.monotonic()
        if now - getattr(stream, "written", now) >= silence:
            at = current_step() or f"running {' '.join(['ffsm', *sys.argv[1:2]])}"
            click.echo(f"{now - begun:4.0f} s: {at}", file=stream)
            silence = then
