"""The step that a command is at, for its signs of progress."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

_steps: list[str | Callable[[], str]] = []


@contextmanager
def step(name: str | Callable[[], str]) -> Iterator[None]:
    """Name a step of more than a moment while it lasts, with a function if its name changes; a
    decorator too.
    """
    _steps.append(name)
    try:
        yield
    finally:
        _steps.pop()


def current_step() -> str:
    """Return the outermost step with the steps within it in parentheses; empty between steps."""
    first, *within = [name if isinstance(name, str) else name() for name in _steps] or [""]
    return f"{first} ({': '.join(within)})" if within else first
