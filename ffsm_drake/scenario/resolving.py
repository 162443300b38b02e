"""Plain data against the schema: defaults overlaid with what is given, every leaf checked,
overrides applied.
"""

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping

from ffsm_drake.common.errors import ScenarioError, did_you_mean, one_line
from ffsm_drake.scenario.schema import Scenario
from ffsm_drake.scenario.strict_yaml import StrictYamlError, read_yaml

MAX_NUMBER = 1e20  # so that what is computed from a few values stays finite


def as_dict(value: typing.Any) -> typing.Any:
    """Plain data (mappings, lists, leaves) of a dataclass, one of Drake's parameter structs, or a
    container of them.
    """
    kind: typing.Any = type(value)
    fields = schema_fields(kind)
    if fields is not None:
        return {key: as_dict(getattr(value, key)) for key in fields}
    if isinstance(value, Mapping):
        return {key: as_dict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_dict(item) for item in value]
    return value


@functools.cache
def schema_fields(schema: typing.Any) -> dict[str, typing.Any] | None:
    """Field name -> type of a dataclass or of one of Drake's parameter structs; None for anything
    else.
    """
    if dataclasses.is_dataclass(schema):
        return {field.name: field.type for field in dataclasses.fields(schema)}
    fields = getattr(schema, "__fields__", None)
    return None if fields is None else {field.name: field.type for field in fields}


def build(schema: typing.Any, data: typing.Any) -> typing.Any:
    """The typed object that plain data, complete and checked, stands for."""
    fields = schema_fields(schema)
    if fields is not None:
        return schema(**{key: build(kind, data[key]) for key, kind in fields.items()})
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):
        return None if data is None else build(args[0], data)
    if origin is dict:
        return {key: build(args[1], item) for key, item in data.items()}
    return list(data) if origin is list else data


def resolve(schema: typing.Any, default: typing.Any, data: typing.Any, path: str) -> typing.Any:
    """Plain data for ``schema``: ``default`` (plain data, complete) overlaid with ``data``, each
    leaf checked.
    """
    if schema is typing.Any:
        return _plain(data, path)
    fields = schema_fields(schema)
    if fields is not None:
        if isinstance(data, str) and hasattr(schema, "SHORTHAND"):
            data = {schema.SHORTHAND: data}
        if not isinstance(data, Mapping):
            raise ScenarioError(
                path, f"must be a mapping with keys {', '.join(fields)}, not {shown(data)}"
            )
        for key in data:
            if key not in fields:
                raise _unknown_key(path, key, fields)
        return {
            key: resolve(kind, default[key], data[key], join(path, key))
            if key in data
            else default[key]
            for key, kind in fields.items()
        }
    origin, args = typing.get_origin(schema), typing.get_args(schema)
    # the only unions of the schema are optional values
    if origin in (typing.Union, types.UnionType):
        if default is None and schema_fields(args[0]) is not None:
            default = as_dict(args[0]())
        return (
            None
            if data is None or (data == "auto" and args[0] is float)
            else resolve(args[0], default, data, path)
        )
    if origin is dict:
        if args[1] is float and isinstance(data, (list, tuple)):
            raise ScenarioError(
                join(path, "all"),
                f"must be a number, not {shown(data)}; several go by name, as in "
                f"{{all: 1, joints: 2}}",
            )
        if args[1] is float and not isinstance(data, Mapping):
            data = {"all": data}
        if not isinstance(data, Mapping):
            raise ScenarioError(path, f"must be a mapping, not {shown(data)}")
        blank = None if schema_fields(args[1]) is None else as_dict(args[1]())
        for key in data:
            if not isinstance(key, str):
                raise ScenarioError(join(path, shown(key)), "a name must be text; put it in quotes")
            _convert_leaf(str, key, join(path, key))
        return {key: resolve(args[1], blank, item, join(path, key)) for key, item in data.items()}
    if origin is list:
        if not isinstance(data, (list, tuple)):
            raise ScenarioError(path, f"must be a list, not {shown(data)}")
        return [resolve(args[0], None, item, f"{path}[{i}]") for i, item in enumerate(data)]
    return _convert_leaf(schema, data, path)


def _plain(data: typing.Any, path: str) -> typing.Any:
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


def _convert_leaf(schema: type, data: typing.Any, path: str) -> typing.Any:
    wanted = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}[schema]
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


def apply_override(resolved: dict[str, typing.Any], override: str) -> str:
    """Write one ``key=value`` into plain data; returns the key."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError(f"'{override}'", "must have the form key=value")
    try:
        value = read_yaml(text)
    except StrictYamlError as error:
        raise ScenarioError(key, f"value is not valid YAML: {one_line(error)}") from error
    schema: typing.Any = Scenario
    target: typing.Any = resolved
    *parents, last = key.split(".")
    for depth, part in enumerate(parents):
        schema = _child_schema(schema, part, ".".join(parents[:depth]))
        if typing.get_origin(schema) in (typing.Union, types.UnionType):
            schema = typing.get_args(schema)[0]
        if target.get(part) is None:
            target[part] = {} if schema_fields(schema) is None else as_dict(schema())
        target = target[part]
    schema = _child_schema(schema, last, ".".join(parents))
    fields = schema_fields(schema)
    if fields is not None and not isinstance(value, Mapping) and not hasattr(schema, "SHORTHAND"):
        raise ScenarioError(key, f"is a group of settings; set one of them: {', '.join(fields)}")
    default = target.get(last) or as_dict(schema()) if fields is not None else None
    target[last] = resolve(schema, default, value, key)
    if key in ("model.directives", "model.servicer") and value is not None:
        target["servicer" if last == "directives" else "directives"] = None
    return key


def _child_schema(schema: typing.Any, part: str, path: str) -> typing.Any:
    """The type of one step down a dotted key."""
    if schema is typing.Any:
        return schema
    fields = schema_fields(schema)
    if fields is not None:
        if part not in fields:
            raise _unknown_key(path, part, fields)
        return fields[part]
    if typing.get_origin(schema) is dict:
        return typing.get_args(schema)[1]
    holds = "a list; give it whole" if typing.get_origin(schema) is list else "a single value"
    raise ScenarioError(join(path, part), f"unknown key; {path} holds {holds}")


def _unknown_key(path: str, key: typing.Any, fields: Iterable[str]) -> ScenarioError:
    valid = list(fields)
    return ScenarioError(
        join(path, key if isinstance(key, str) else shown(key)),
        f"unknown key; valid here: {', '.join(valid)}{did_you_mean(key, valid)}",
    )


def join(path: str, key: typing.Any) -> str:
    return f"{path}.{key}" if path else str(key)


def shown(data: typing.Any) -> str:
    if data is None:
        return "null (no value)"
    try:
        text = repr(data)
    except ValueError:  # Python does not print integers of thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= 60 else text[:57] + "..."


def build_settings(cls, data, key):
    return build(cls, resolve(cls, as_dict(cls()), data, key))
