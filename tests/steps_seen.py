"""The steps that a command names while it works, as its signs of progress would show them."""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from ffsm_drake.common.steps import current_step


@contextmanager
def steps_seen() -> Iterator[Counter[str]]:
    """How often each step (empty: none) was seen in the block, looked at every 5 ms."""
    seen, over = Counter[str](), threading.Event()

    def look() -> None:
        while not over.wait(0.005):
            seen[current_step()] += 1

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield seen
    finally:
        over.set()
        watcher.join()
