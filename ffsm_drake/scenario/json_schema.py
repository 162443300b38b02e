"""The scenario as a JSON Schema: types, defaults, units, meanings and ranges, from its settings."""

import dataclasses
import inspect
import math
import typing
from typing import Any

from ffsm_drake.common.settings import Setting, settings_of
from ffsm_drake.scenario.layers import EXTENDS
from ffsm_drake.scenario.loading import scenario_to_dict
from ffsm_drake.scenario.resolving import schema_fields, without_null
from ffsm_drake.scenario.schema import Scenario

_LEAVES = {float: "number", int: "integer", bool: "boolean", str: "string"}


def scenario_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scenario file."""
    schema = _schema(Scenario, scenario_to_dict(Scenario()), Setting())
    extends = (
        "base scenario: a shipped one, or a file relative to this one; settings here override it"
    )
    schema["properties"] = {EXTENDS: {"type": "string", "description": extends}} | (
        schema["properties"]
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "ffsm_drake scenario",
        **schema,
    }


def _schema(kind: Any, default: Any, declared: Setting) -> dict[str, Any]:
    if kind is Any:
        return {}
    inner = without_null(kind)
    if inner is not kind:
        auto = [{"const": "auto"}] if inner is float else []
        return {"anyOf": [_schema(inner, default, declared), *auto, {"type": "null"}]}
    fields = schema_fields(kind)
    if fields is not None:
        return _group(kind, fields, default)
    low, high = declared.size
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is dict:
        by_name = {
            "type": "object",
            **_given(minProperties=low or None, maxProperties=high),
            "additionalProperties": _schema(args[1], None, declared),
        }
        if args[1] not in (float, int):
            return by_name
        either = {"anyOf": [by_name["additionalProperties"], by_name]}
        return either | ({"default": default} if default else {})
    if origin is list:
        items = _schema(args[0], None, declared)
        sizes = _given(minItems=low or None, maxItems=high)
        several = {"type": "array", "items": items, **sizes}
        return {"anyOf": [items, several]} if args[0] is float and low <= 1 else several
    return {"type": _LEAVES[kind]} | _given(
        exclusiveMinimum=declared.above,
        minimum=declared.least,
        exclusiveMaximum=declared.below,
        maximum=declared.most,
        enum=list(declared.one_of) or None,
    )


def _group(kind: Any, fields: dict[str, Any], default: Any) -> dict[str, Any]:
    properties = {}
    for name, declared in settings_of(kind).items():
        value = None if default is None else default[name]
        properties[name] = _schema(fields[name], value, declared)
        if declared.meaning:
            description = "; ".join(filter(None, (declared.unit, declared.meaning)))
            properties[name]["description"] = description
        if value is not None and not isinstance(value, dict) and value != []:
            properties[name]["default"] = value
    result = {"type": "object", "properties": properties, "additionalProperties": False}
    if hasattr(kind, "SHORTHAND"):
        result = {"anyOf": [{"type": "string"}, result]}
    if not dataclasses.is_dataclass(kind):
        return result
    first_paragraph, *_ = (inspect.getdoc(kind) or "").split("\n\n")
    return {"description": " ".join(first_paragraph.split()), **result}


def _given(**keywords: Any) -> dict[str, Any]:
    return {
        name: value for name, value in keywords.items() if value not in (None, -math.inf, math.inf)
    }
