"""A limit on the wall time of user-supplied code, which may never return."""

import contextlib
import faulthandler
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import parent_process
from typing import Any

GRACE = 10.0  # s beyond the limit until a worker process is ended
_RETRY = 1.0  # s until the exception is raised again, in case user code caught it


class TimeLimit(BaseException):
    """The time limit has passed. Not an Exception, so ``except Exception`` does not catch it."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise TimeLimit in the block after ``seconds`` of wall time.

    It interrupts Python in the main thread. Code that cannot be interrupted (compiled code, or a
    thread of a cluster's worker) is ended GRACE later in a worker process, and has no limit
    elsewhere.
    """

    def handle(number: int, frame: Any) -> None:
        raise TimeLimit(f"took longer than {seconds:g} s of wall time (time_limit)")

    is_main, is_worker = (
        threading.current_thread() is threading.main_thread(),
        parent_process() is not None,
    )
    with contextlib.ExitStack() as stack:
        if is_worker:
            nowhere = stack.enter_context(open(os.devnull, "w", encoding="ascii"))
            faulthandler.dump_traceback_later(seconds + GRACE, exit=True, file=nowhere)
            stack.callback(faulthandler.cancel_dump_traceback_later)
        if is_main:
            before = signal.signal(signal.SIGALRM, handle)
            stack.callback(signal.signal, signal.SIGALRM, before)
            stack.callback(signal.setitimer, signal.ITIMER_REAL, 0.0)
            signal.setitimer(signal.ITIMER_REAL, seconds, _RETRY)
        yield
