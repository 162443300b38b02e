"""Checks of what user-supplied functions return."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import BlockError, one_line
from ffsm_drake.common.guard import failure, passes

MOST_MEMORY = 100_000  # numbers in a block's memory; every sample copies them
_NUMBERS = "fiu"  # kinds of arrays that count as numbers


def numbers(value: Any, shape: tuple[int, ...] | None, what: str, *, kinds: str = _NUMBERS) -> Any:
    """Return a value as an array of floats.

    Args:
      value: the result.
      shape: its shape; None: any vector of at most MOST_MEMORY numbers.
      what: its name in the error.
      kinds: the allowed kinds of arrays.

    Raises:
      BlockError: it is something else.
    """
    wanted = "a vector of numbers" if shape is None else f"numbers of shape {shape}"
    try:
        array = value if isinstance(value, np.ndarray) else np.asarray(value)
        size, found, kind = array.size, array.shape, array.dtype.kind
    except BaseException as error:
        if passes(error):
            raise
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise BlockError(f"{what}, no array ({reason}); it must be {wanted}") from error
    if kind not in kinds:
        raise BlockError(f"{what}, {described(array)}; it must be {wanted}")
    if shape is None and (len(found) != 1 or size > MOST_MEMORY):
        raise BlockError(
            f"{what} of shape {found}; it must be a vector, all of at most {MOST_MEMORY} numbers"
        )
    if shape is not None and found != shape:
        raise BlockError(f"{what} of shape {found}; it must be {shape}")
    return np.asarray(array, dtype=float)


def arrays(
    value: Any, at: str, *, of: str = "memory", shapes: Mapping[str, tuple[int, ...]] | None = None
) -> dict[str, np.ndarray]:
    """Return a mapping of names to arrays, as arrays of floats.

    Args:
      value: the result.
      at: the function that returned it, for errors.
      of: what it is.
      shapes: their shapes by name; None: vectors of any names, of at most MOST_MEMORY numbers.

    Raises:
      BlockError: it is something else.
    """
    found, made = mapping(value, at), dict[str, np.ndarray]()
    if shapes is not None and found.keys() != shapes.keys():
        wanted = f"{of} {', '.join(shapes)}" if shapes else f"no {of}"
        raise BlockError(f"{at} must return {wanted}, not {', '.join(found) or 'none'}")
    for name, each in found.items():
        shape = None if shapes is None else shapes[name]
        made[name] = numbers(each, shape, f"{at} returned '{name}'", kinds=f"{_NUMBERS}b")
    if (total := sum(each.size for each in made.values())) > MOST_MEMORY:
        raise BlockError(f"{at} has {total} numbers; at most {MOST_MEMORY} can be kept")
    return made


def described(value: Any) -> str:
    """Return the type of a value, in words."""
    if isinstance(value, np.ndarray):
        return f"an array of {value.dtype}"
    if isinstance(value, tuple):
        return f"a tuple of {', '.join(type(part).__name__ for part in value) or 'nothing'}"
    return type(value).__name__


def mapping(value: Any, what: str) -> dict[str, Any]:
    """Return a mapping with names as keys, as a dict. Raises BlockError for anything else."""
    try:
        found = dict(value) if isinstance(value, Mapping) else None
    except BaseException as error:
        if passes(error):
            raise
        raise failure(error, what) from error
    if found is None or not all(isinstance(key, str) for key in found):
        raise BlockError(f"{what} must return a mapping of names to arrays, not {described(value)}")
    return found
