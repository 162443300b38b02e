"""Choices and loops by values that may be symbols (of the plug-in ``tape``)."""

from collections.abc import Callable, Mapping
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


def repeated(
    step: Callable[[Mapping[str, Any], Mapping[str, Any]], Mapping[str, Any]],
    state: Mapping[str, Any],
    fixed: Mapping[str, Any],
    *,
    most: int,
) -> Mapping[str, Any]:
    """Return the state after steps of a loop, while its first array, of one number, is not zero.

    Args:
      step: returns the state after one from that before it and what is fixed; of arrays by name.
      state: before the first step.
      fixed: what every step reads.
      most: steps.
    """
    for value in (*state.values(), *fixed.values()):
        if not is_known(value):
            return value.recorded_loop(step, state, fixed, most)
    for _ in range(most):
        if not next(iter(state.values())):
            break
        state = step(state, fixed)
    return state
