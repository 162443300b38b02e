"""Whether plain data, as JSON gives it, has the shape that its reader takes for granted."""

import dataclasses
import functools
import math
import types
from collections.abc import Iterator, Mapping
from typing import Any, Union, get_args, get_origin, get_type_hints


def misfit(value: Any, shape: Any, place: str) -> str:
    """Return the first mismatch between a value and a shape, as text; "" if it fits.

    Args:
      value: the data; numbers must be finite.
      shape: a type hint of ``str``, ``bool``, ``int``, ``float``, ``None``, their unions, lists,
        tuples and mappings by name, or a dataclass of such; a mapping of keys to shapes (a key
        with a trailing ``?`` is optional); or a list of alternative shapes.
      place: name of the value in the text.
    """
    return next(_misfits(value, shape, place), "")


def _misfits(value: Any, shape: Any, place: str) -> Iterator[str]:
    origin, arguments = get_origin(shape), get_args(shape)
    if origin in (Union, types.UnionType) or isinstance(shape, list):
        found = [misfit(value, each, place) for each in arguments or shape]
        # the alternative with the right kind gives the best message
        yield from [] if "" in found else [max(found, key=len)]
    elif isinstance(shape, dict):
        yield from _of_keys(value, shape, place)
    elif dataclasses.is_dataclass(shape) and isinstance(shape, type):
        for name, hint in _hints(shape).items():
            yield from _misfits(getattr(value, name), hint, f"{place}.{name}")
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, dict):
            yield _not(place, "an object", value)
        else:
            for name, item in value.items():
                yield from _misfits(item, arguments[1], f"{place}.{name}")
    elif origin in (list, tuple):
        counted = origin is tuple and Ellipsis not in arguments
        if not isinstance(value, (list, tuple)):
            yield _not(place, "a list", value)
        elif counted and len(value) != len(arguments):
            yield f"{place} must hold {len(arguments)} values, not {len(value)}"
        else:
            for index, item in enumerate(value):
                yield from _misfits(item, arguments[0], f"{place}[{index}]")
    else:
        yield from _of_kind(value, shape, place)


def _of_keys(value: Any, shape: dict[str, Any], place: str) -> Iterator[str]:
    if not isinstance(value, dict):
        yield _not(place, "an object", value)
        return
    for key, inner in shape.items():
        name = key.rstrip("?")
        if name in value:
            yield from _misfits(value[name], inner, f"{place}.{name}")
        elif name == key:
            yield f"{place} lacks {name}"


def _of_kind(value: Any, kind: Any, place: str) -> Iterator[str]:
    if kind in (None, types.NoneType):
        if value is not None:
            yield _not(place, "null", value)
    elif kind is float:
        try:
            known = not isinstance(value, bool) and math.isfinite(value)
        except (TypeError, OverflowError):
            known = False
        if not known:
            yield _not(place, "a number", value)
    elif not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        names = {str: "text", bool: "true or false", int: "a whole number"}
        yield _not(place, names[kind], value)


def _not(place: str, wanted: str, value: Any) -> str:
    return f"{place} must be {wanted}, not {value!r:.40}"


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    """Return name -> type hint of a dataclass's fields."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}
