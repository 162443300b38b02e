"""Choices by values that may be symbols (``ffsm_drake.tape``)."""

from collections.abc import Callable
from typing import Any

import numpy as np


def is_known(value: Any) -> bool:
    """Whether it holds numbers, and no symbols."""
    return np.asanyarray(value).dtype != object


def may_be(truths: Any) -> bool:
    """Whether any of some truths is, as far as it is known."""
    return not is_known(truths) or bool(np.any(truths))


def choose(condition: Any, then: Callable[[], Any], otherwise: Any) -> Any:
    """Return ``then()`` if a condition is true, otherwise the other; arrays, or tuples of them.

    Where the condition is a symbol, both are computed and entries selected.
    """
    if is_known(condition):
        return then() if condition else otherwise
    made = then()
    if isinstance(made, tuple):
        pairs = zip(made, otherwise, strict=True)
        return tuple(np.where(condition, one, other) for one, other in pairs)
    return np.where(condition, made, otherwise)
