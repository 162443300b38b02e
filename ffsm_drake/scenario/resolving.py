"""Plain data against the schema: defaults overlaid with what is given, every leaf checked,
overrides applied.
"""

import dataclasses
import functools
import itertools
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.errors import ScenarioError, choices, one_line, some
from ffsm_drake.common.settings import fresh, join, require_valid, settings_of
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml

_LEAVES = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
_PLAIN = {*_LEAVES, type(None)}
MAX_NUMBER = 1e20  # keeps products of a few values finite


def as_dict(value: Any) -> Any:
    """Plain data (mappings, lists, leaves) of a dataclass, one of Drake's parameter structs, or a
    container of them.
    """
    kind: Any = type(value)
    if kind in _PLAIN:
        return value
    fields = schema_fields(kind)
    if fields is not None:
        return {key: as_dict(getattr(value, key)) for key in fields}
    if isinstance(value, Mapping):
        return {key: as_dict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_dict(item) for item in value]
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


@functools.cache
def schema_fields(schema: Any) -> dict[str, Any] | None:
    """Return name -> type of the settings of a dataclass or of one of Drake's parameter structs;
    None for anything else.
    """
    names = settings_of(schema)
    if not names and not hasattr(schema, "UNKNOWN"):
        return None
    if dataclasses.is_dataclass(schema):
        kinds = typing.get_type_hints(schema)
    else:
        kinds = {field.name: field.type for field in schema.__fields__}
    return {name: kinds[name] for name in names}


class _Shape(NamedTuple):
    """A type of the schema, taken apart."""

    fields: dict[str, Any] | None  # see ``schema_fields``
    inner: Any  # see ``without_null``
    origin: Any
    args: tuple[Any, ...]
    shorthand: str | None  # key of a group whose value may stand for the group


@functools.cache
def _shape_of(schema: Any) -> _Shape:
    inner, origin = without_null(schema), typing.get_origin(schema)
    shorthand = getattr(schema, "SHORTHAND", None)
    return _Shape(schema_fields(schema), inner, origin, typing.get_args(schema), shorthand)


@functools.cache
def _defaults_of(schema: Any) -> Any:
    return as_dict(schema())


def defaults_of(schema: Any) -> Any:
    """Return the default values of a schema as plain data, which the caller may change."""
    return fresh(_defaults_of(schema))


def without_null(schema: Any) -> Any:
    """Return the type of an optional value; any other type unchanged. A schema has no further
    unions.
    """
    if typing.get_origin(schema) not in (typing.Union, types.UnionType):
        return schema
    return next(kind for kind in typing.get_args(schema) if kind is not types.NoneType)


def build(schema: Any, data: Any) -> Any:
    """Build the typed object from plain data, complete and checked."""
    if data is None:
        return None
    schema = _shape_of(schema).inner
    fields, _, origin, args, _ = _shape_of(schema)
    if fields is not None:
        return schema(**{key: build(kind, data[key]) for key, kind in fields.items()})
    if origin is dict:
        return {key: build(args[1], item) for key, item in data.items()}
    return list(data) if origin is list else data


def build_settings(cls: Any, data: Any, key: str, scenario: Any = None) -> Any:
    """Build an instance of a dataclass of settings (see ``common.settings``) from the data of a
    file.

    Args:
      cls: the dataclass; fields that are no settings need a default.
      data: plain data; missing keys keep their defaults.
      key: where ``data`` stands, such as ``blocks.sensing.settings``, for errors.
      scenario: passed to the ``check`` of the dataclass; None: no check.

    Raises:
      ScenarioError: an unknown key, a wrong type, or a value out of its range.
    """
    if schema_fields(cls) is None:  # a class without settings
        for name in data:
            raise _unknown_key(key, name, ())
        built = cls()
    else:
        built = build(cls, resolve(cls, defaults_of(cls), data, key))
    require_valid(built, key, scenario)
    return built


def resolve(schema: Any, default: Any, data: Any, path: str) -> Any:
    """Plain data for ``schema``: ``default`` (plain data, complete) overlaid with ``data``, each
    leaf checked.
    """
    if schema in _LEAVES:
        return _convert_leaf(schema, data, path)
    if schema is Any:
        return _plain(data, path)
    data = _in_full(schema, data)
    fields, inner, origin, args, _ = _shape_of(schema)
    if fields is not None:
        return _resolve_group(schema, default, data, path)
    if inner != schema:  # equal types may be two objects
        if default is None and schema_fields(inner) is not None:
            default = defaults_of(inner)
        absent = data is None or (data == "auto" and inner is float)
        return None if absent else resolve(inner, default, data, path)
    if origin is dict:
        return _resolve_named(args[1], data, path)
    if origin is list:
        if args[0] is float and type(data) in (int, float):  # a number alone
            data = [data]
        if not isinstance(data, (list, tuple)):
            wanted = "a number or a list of numbers" if args[0] is float else "a list"
            raise ScenarioError(path, f"must be {wanted}, not {shown(data)}")
        return [resolve(args[0], None, item, f"{path}[{i}]") for i, item in enumerate(data)]
    return _convert_leaf(schema, data, path)


def _resolve_group(schema: Any, default: Any, data: Any, path: str) -> dict[str, Any]:
    """``resolve`` for a group of settings."""
    fields: Mapping[str, Any] = _shape_of(schema).fields or {}
    if not isinstance(data, Mapping):
        raise ScenarioError(path, f"must be a mapping with keys {some(fields)}, not {shown(data)}")
    for key in data:
        if key not in fields:
            raise _unknown_key(path, key, fields, schema)
    return {
        key: resolve(kind, default[key], data[key], join(path, key))
        if key in data
        else default[key]
        for key, kind in fields.items()
    }


def _resolve_named(kind: Any, data: Any, path: str) -> dict[str, Any]:
    """``resolve`` for values of one kind by name."""
    if kind in (float, int) and not isinstance(data, Mapping):
        if isinstance(data, (list, tuple)):
            raise ScenarioError(
                join(path, "all"),
                f"must be a number, not {shown(data)}; several go by name, as in "
                "{all: 1, joints: 2}",
            )
        data = {"all": data}
    if not isinstance(data, Mapping):
        raise ScenarioError(path, f"must be a mapping, not {shown(data)}")
    blank = None if schema_fields(kind) is None else defaults_of(kind)
    for key in data:
        if not isinstance(key, str):
            raise ScenarioError(join(path, shown(key)), "a name must be text; put it in quotes")
        _convert_leaf(str, key, join(path, key))
    return {key: resolve(kind, blank, item, join(path, key)) for key, item in data.items()}


def _in_full(schema: Any, data: Any) -> Any:
    """Data with a short form written out: a text for a group, or one group for several by name."""
    shape = _shape_of(schema)
    if shape.shorthand is not None and isinstance(data, str):
        return {shape.shorthand: data}
    if shape.origin is dict and (key := _shape_of(shape.args[1]).shorthand) is not None:
        alone = isinstance(data, str) or (isinstance(data, Mapping) and key in data)
        return {"own": data} if alone else data
    return data


def _plain(data: Any, path: str) -> Any:
    """Settings of a user-supplied block: mappings, lists and leaves that a file can hold."""
    if isinstance(data, Mapping):
        return {
            _convert_leaf(str, key, join(path, shown(key))): _plain(item, join(path, key))
            for key, item in data.items()
        }
    if isinstance(data, (list, tuple)):
        return [_plain(item, f"{path}[{i}]") for i, item in enumerate(data)]
    if data is None or isinstance(data, bool):
        return data
    if isinstance(data, (int, float)):
        number = _convert_leaf(float, data, path)
        return data if isinstance(data, int) else number
    return _convert_leaf(str, data, path)


def _convert_leaf(schema: Any, data: Any, path: str) -> Any:
    if schema is float is type(data) and -MAX_NUMBER <= data <= MAX_NUMBER:
        return data
    wanted = _LEAVES.get(schema)
    if wanted is None:
        kinds = "float, int, bool, str, list, dict or a dataclass of settings"
        raise ScenarioError(path, f"its class must declare it as {kinds}, not {schema}")
    if schema is float and isinstance(data, (int, float, str)) and not isinstance(data, bool):
        try:
            number = float(data)
            # some take it for octal
            if isinstance(data, str) and re.fullmatch(r"[-+]?0[0-9]+", data):
                raise ValueError
        except ValueError:
            raise ScenarioError(path, f"must be {wanted}, not {shown(data)}") from None
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise ScenarioError(path, f"must be finite, not {shown(data)}")
        if abs(number) > MAX_NUMBER:
            raise ScenarioError(path, f"must be at most {MAX_NUMBER:g} in size, not {shown(data)}")
        return number
    if schema is int and isinstance(data, (int, float)) and not isinstance(data, bool):
        if isinstance(data, int) or data.is_integer():
            return int(data)
    elif schema is bool and isinstance(data, bool):
        return data
    elif schema is str and isinstance(data, str):
        if "\0" in data or any("\ud800" <= character <= "\udfff" for character in data):
            raise ScenarioError(path, f"must be text that a file can hold, not {shown(data)}")
        return data
    raise ScenarioError(path, f"must be {wanted}, not {shown(data)}")


def merged(schema: Any, below: Any, above: Any) -> Any:
    """Merge plain data for ``schema``, not yet checked; ``above`` wins over ``below``.

    Mappings merge by key; null removes a name from a mapping by name, unless null is one of its
    values. Anything else replaces: a list, a bare number, a group of another ``KIND``.
    """
    if not below:
        return dict(above) if isinstance(above, Mapping) else above
    schema = _shape_of(schema).inner
    fields, _, origin, args, _ = _shape_of(schema)
    is_named = origin is dict
    below, above = _in_full(schema, below), _in_full(schema, above)
    if is_named and args[1] in (float, int) and isinstance(below, (float, int)):
        below = {"all": below}
    if not (isinstance(below, Mapping) and isinstance(above, Mapping)):
        return above
    if kind := getattr(schema, "KIND", None):
        known = below.get(kind, getattr(schema, kind))
        if above.get(kind, known) != known:
            return above
    result = dict(below)
    for key, value in above.items():
        child = fields.get(key) if fields is not None else args[1] if is_named else schema
        if is_named and value is None and key in below and without_null(child) is child:
            del result[key]
        else:
            result[key] = merged(child, below.get(key), value)
    return result


def apply_override(schema: Any, resolved: dict[str, Any], override: str) -> None:
    """Write one ``key=value`` into the complete plain data of a schema."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError(key or override, f"has no value; write --set {key or 'KEY'}=VALUE")
    try:
        value = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError(key, f"value is not valid YAML: {one_line(error)}") from error
    target: Any = resolved
    *parents, last = parts = key.split(".")
    for depth, (part, then) in enumerate(itertools.pairwise(parts)):
        schema = _child_schema(schema, part, ".".join(parents[:depth]))
        schema = without_null(schema)
        if target.get(part) is None:
            target[part] = {} if schema_fields(schema) is None else defaults_of(schema)
        target = target[part]
        if (entry := entry_named(target, then)) is not None:
            schema, target = Any, entry
        elif schema is Any and not isinstance(target, dict):
            schema = type(target)  # has no keys
    schema = _child_schema(schema, last, ".".join(parents))
    fields = schema_fields(schema)
    if fields is not None and not isinstance(value, Mapping) and not _shape_of(schema).shorthand:
        keys = ", ".join(f"{key}.{name}" for name in fields)
        raise ScenarioError(key, f"is a section, not a value; set one of its keys: {keys}")
    default = target.get(last) or defaults_of(schema) if fields is not None else None
    target[last] = resolve(schema, default, value, key)
    if key in ("model.directives", "model.servicer") and value is not None:
        target["servicer" if last == "directives" else "directives"] = None


def entry_named(data: Any, name: str) -> dict[str, Any] | None:
    """Return the entry {name: settings} of a list such as ``phases``, in which a name alone is an
    entry without settings; None: there is none, or the data are no list.
    """
    for place, entry in enumerate(data if isinstance(data, list) else ()):
        found = {name: {}} if entry == name else entry
        if isinstance(found, dict) and name in found:
            data[place] = found
            return found
    return None


def _child_schema(schema: Any, part: str, path: str) -> Any:
    """Return the type of one step down a dotted key."""
    if schema is Any:
        return schema
    fields = schema_fields(schema)
    if fields is not None:
        if part not in fields:
            raise _unknown_key(path, part, fields, schema)
        return fields[part]
    if typing.get_origin(schema) is dict:
        return typing.get_args(schema)[1]
    holds = "a list; give it whole" if typing.get_origin(schema) is list else "a single value"
    raise ScenarioError(join(path, part), f"unknown key; {path} holds {holds}")


def _unknown_key(path: str, key: Any, fields: Iterable[str], schema: Any = None) -> ScenarioError:
    problem = getattr(schema, "UNKNOWN", "unknown key")
    valid = list(fields)
    return ScenarioError(
        join(path, key if isinstance(key, str) else shown(key)),
        f"{problem}; valid here: {choices(key, valid)}",
    )


def shown(data: Any) -> str:
    if data is None:
        return "null (no value)"
    try:
        text = repr(data)
    except ValueError:  # Python does not print integers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."
