"""The step that a command is at, for its signs of progress."""

from collections.abc import Iterator
from contextlib import contextmanager

_steps: list[str] = []


@contextmanager
def step(name: str) -> Iterator[None]:
    """Name a step of more than a moment while it lasts; a decorator too."""
    _steps.append(name)
    try:
        yield
    finally:
        _steps.pop()


def current_step() -> str:
    """The steps, the outermost first, empty between steps."""
    return ": ".join(_steps)
