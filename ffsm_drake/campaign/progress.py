"""Progress of a campaign: a progress bar on a terminal, plain lines elsewhere."""

import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ffsm_drake.campaign.run import Progress

_BAR = 24
_PLAIN_PERIOD, _TERMINAL_PERIOD = 30.0, 0.2  # s between lines


class ProgressLine:
    """Prints progress to standard error."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last = -float("inf")
        self._open = False

    def __call__(self, progress: "Progress") -> None:
        now, finished = time.monotonic(), progress.done == progress.total
        if not finished and now - self._last < (_TERMINAL_PERIOD if self._terminal else _PLAIN_PERIOD):
            return
        self._last = now
        line = progress_text(progress)
        if self._terminal:
            filled = _BAR * progress.done // max(progress.total, 1)
            sys.stderr.write(f"\r[{'#' * filled}{'.' * (_BAR - filled)}] {line:<90}")
            self._open = True
        else:
            sys.stderr.write(f"{line}\n")
        sys.stderr.flush()

    def close(self) -> None:
        """End the line."""
        if self._open:
            sys.stderr.write("\n")


def progress_text(progress: "Progress") -> str:
    """Such as: 120 of 10000 runs (1.2 %), 5.1/s, 32 min left, 3 not settled, 1 error."""
    parts = [f"{progress.done} of {progress.total} runs ({100.0 * progress.done / max(progress.total, 1):.1f} %)"]
    if progress.remaining is not None and progress.done < progress.total:
        parts += [f"{progress.rate:.2g}/s", f"{duration_text(progress.remaining)} left"]
    if progress.unsettled:
        parts.append(f"{progress.unsettled} not settled")
    if progress.failed:
        parts.append(f"{progress.failed} error{'s' if progress.failed > 1 else ''}")
    return ", ".join(parts)


def duration_text(seconds: float) -> str:
    """A duration in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
