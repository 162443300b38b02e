"""Memoization: a decorator that keys results by the content of all arguments."""

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


def memoized(
    *, maxsize: int, files: Callable[[Any], Any] | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that caches results by the content of the arguments (``content_of``).

    Every caller gets its own lists, mappings, sets and dataclasses, and read-only arrays; other
    objects are shared.

    Args:
      maxsize: number of results to keep; the least recently used one is dropped.
      files: the first argument -> the files (``Path``) that a result depends on; default: none.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.lru_cache(maxsize=maxsize)
        def kept(call: _Call) -> Any:
            return _mapped(function(*call.args, **call.kwargs), _frozen)

        @functools.wraps(function)
        def memo(*args: P.args, **kwargs: P.kwargs) -> R:
            read = None if files is None else files(args[0])
            call = _Call(content_of((args, kwargs, read)), args, kwargs)
            return _mapped(kept(call), np.ndarray.view)

        return memo

    return decorate


@dataclasses.dataclass(frozen=True)
class _Call:
    """A call; equal to others with equal content."""

    content: Hashable
    args: tuple[Any, ...] = dataclasses.field(compare=False)
    kwargs: Mapping[str, Any] = dataclasses.field(compare=False)


def each_once(function: Callable[..., R], *arrays: np.ndarray) -> list[R]:
    """Return a function of corresponding items of arrays (n, ...), once for those that are
    equal.
    """
    keys = [b"".join(item.tobytes() for item in items) for items in zip(*arrays, strict=True)]
    items = dict(zip(keys, zip(*arrays, strict=True), strict=True))
    found = {key: function(*each) for key, each in items.items()}
    return [found[key] for key in keys]


def content_of(value: Any) -> Hashable:
    """Return a key that is equal for values of equal type and content only.

    It holds every field of dataclasses and Drake's structs, type, shape and bytes of arrays, the
    items of mappings and sequences in order, name and modification time of files (``Path``).

    Raises TypeError for anything else: its content is unknown.
    """
    kind = type(value)
    if isinstance(value, _LEAVES):
        return kind, value
    if isinstance(value, float):
        return kind, value.hex()  # distinguishes -0 from 0; equal for nan
    if isinstance(value, (np.ndarray, np.generic)) and not value.dtype.hasobject:
        return kind, value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, Mapping):
        return kind, tuple((content_of(key), content_of(item)) for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return kind, tuple(map(content_of, value))
    if isinstance(value, (set, frozenset)):
        return kind, frozenset(map(content_of, value))
    if isinstance(value, Path):
        return kind, str(value), _modified(value)
    is_dataclass = dataclasses.is_dataclass(kind)
    fields = dataclasses.fields(kind) if is_dataclass else getattr(kind, "__fields__", None)
    if fields is None:
        raise TypeError(f"a {kind.__name__} cannot be part of a cache key")
    return kind, tuple(content_of(getattr(value, field.name)) for field in fields)


def _modified(path: Path) -> int | None:
    """Modification time of a file, ns; None if it does not exist."""
    try:
        return path.stat().st_mtime_ns
    except (OSError, ValueError):
        return None


def _frozen(array: np.ndarray) -> np.ndarray:
    result = array.copy()
    result.setflags(write=False)
    return result


def _mapped(value: Any, of_array: Callable[[np.ndarray], np.ndarray]) -> Any:
    """Return a copy of containers and dataclasses, with a function applied to each array inside."""
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
        fresh: Any = object.__new__(type(value))  # without cached properties
        for field in dataclasses.fields(value):
            object.__setattr__(fresh, field.name, _mapped(getattr(value, field.name), of_array))
        return fresh
    return value
