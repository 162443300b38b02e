"""Results that are kept: one decorator, whose key is everything that is passed."""

import copy
import dataclasses
import enum
import functools
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
_LEAVES = (str, bytes, int, type(None), type, enum.Enum)


def memoized(*, maxsize: int, besides: str = "") -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that keeps the results of a function, by the content of its arguments (``content_of``).

    Every caller gets lists, mappings, sets and dataclasses of its own, and arrays that are
    read-only; other objects are shared.

    Args:
      maxsize: how many results are kept: those that were asked for last.
      besides: a keyword argument that is not part of the key, as it follows from the others.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.lru_cache(maxsize=maxsize)
        def kept(call: _Call) -> Any:
            return _mapped(function(*call.args, **call.kwargs), _frozen)

        @functools.wraps(function)
        def memo(*args: P.args, **kwargs: P.kwargs) -> R:
            keyed = {name: value for name, value in kwargs.items() if name != besides}
            call = _Call(content_of((args, keyed)), args, kwargs)
            result: R = _mapped(kept(call), np.ndarray.view)
            return result

        return memo

    return decorate


@dataclasses.dataclass(frozen=True)
class _Call:
    """Equal for calls with equal content."""

    content: Hashable
    args: tuple[Any, ...] = dataclasses.field(compare=False)
    kwargs: Mapping[str, Any] = dataclasses.field(compare=False)


def content_of(value: Any) -> Hashable:
    """Equal for values of equal type and content, and for no others.

    Dataclasses and Drake's structs count by every field, arrays by type, shape and bytes, mappings
    and sequences by their items in order, files (``Path``) by name and the time of their last change.

    Raises TypeError for anything else: what it holds cannot be told.
    """
    kind = type(value)
    if isinstance(value, _LEAVES):
        return kind, value
    if isinstance(value, float):
        return kind, value.hex()  # which tells -0 from 0, and finds nan again
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        return kind, value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return kind, tuple((content_of(key), content_of(item)) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return kind, tuple(map(content_of, value))
    if isinstance(value, (set, frozenset)):
        return kind, frozenset(map(content_of, value))
    if isinstance(value, Path):
        return kind, str(value), _changed(value)
    is_dataclass = dataclasses.is_dataclass(kind)
    fields = dataclasses.fields(kind) if is_dataclass else getattr(kind, "__fields__", None)
    if fields is None:
        raise TypeError(f"a {kind.__name__} has no content that a result could be kept by")
    return kind, tuple(content_of(getattr(value, field.name)) for field in fields)


def _changed(path: Path) -> int | None:
    """When a file was last written, ns; None where there is none."""
    try:
        return path.stat().st_mtime_ns
    except (OSError, ValueError):
        return None


def _frozen(array: np.ndarray) -> np.ndarray:
    result = array.copy()
    result.setflags(write=False)
    return result


def _mapped(value: Any, of_array: Callable[[np.ndarray], np.ndarray]) -> Any:
    """A copy of containers and dataclasses, with a function applied to each array in them."""
    if isinstance(value, np.ndarray):
        return of_array(value)
    if isinstance(value, dict):
        result = copy.copy(value)
        result.update({key: _mapped(item, of_array) for key, item in value.items()})
        return result
    if isinstance(value, (list, tuple)):
        items = [_mapped(item, of_array) for item in value]
        return tuple.__new__(type(value), items) if isinstance(value, tuple) else type(value)(items)
    if isinstance(value, (set, bytearray)):
        return copy.copy(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fresh: Any = object.__new__(type(value))  # without what a cached property has left in it
        for field in dataclasses.fields(value):
            object.__setattr__(fresh, field.name, _mapped(getattr(value, field.name), of_array))
        return fresh
    return value
