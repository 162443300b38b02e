"""The scenario as a JSON Schema: types and defaults from the dataclasses, units and meanings from
their comments.
"""

import dataclasses
import inspect
import io
import tokenize
import types
import typing
from typing import Any

from pydrake.systems.analysis import SimulatorConfig

from ffsm_drake.scenario import PerCoordinate, Scenario, scenario_to_dict, schema_fields

# Drake's parameter structs carry no comments.
_SIMULATOR_COMMENTS = {
    "integration_scheme": "Drake's name of the integrator; the paper's: explicit_euler at "
    "max_step_size = sample_time",
    "max_step_size": "s; step of a fixed-step integrator, largest step of one with error control",
    "accuracy": "relative accuracy asked of an integrator with error control",
    "use_error_control": "let the integrator choose its steps",
    "start_time": "s; Drake's start time; a scenario starts at 0",
    "target_realtime_rate": "1 paces the run to real time; 0 runs as fast as it can",
    "publish_every_time_step": "Drake's publishing at every step; not needed here",
}
_LEAVES = {float: "number", int: "integer", bool: "boolean", str: "string"}


def scenario_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scenario file."""
    schema = _schema(Scenario, scenario_to_dict(Scenario()))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "ffsm_drake scenario",
        **schema,
    }


def field_comments(schema: type) -> dict[str, str]:
    """Field name -> the comment behind or above it in the source of a dataclass: "unit; meaning",
    or the meaning.
    """
    if schema is SimulatorConfig:
        return dict(_SIMULATOR_COMMENTS)
    if not dataclasses.is_dataclass(schema):
        return {}
    comments: dict[str, str] = {}
    above: list[str] = []
    field = ""
    for base in reversed(schema.__mro__[:-1]):
        depth = 0
        for token in tokenize.generate_tokens(io.StringIO(inspect.getsource(base)).readline):
            text = token.string
            if token.type == tokenize.OP:
                depth += (text in "([{") - (text in ")]}")
            if (
                token.type == tokenize.NAME
                and token.start[1] == 4
                and depth == 0
                and text != "class"
            ):
                field = text
                if above:
                    comments[field] = " ".join(above)
                above = []
            elif token.type == tokenize.COMMENT:
                text = text.lstrip("# ")
                if token.line.lstrip().startswith("#"):
                    above.append(text)
                else:
                    comments[field] = " ".join((comments.get(field, ""), text)).strip()
    return comments


def summary_of(kind: object) -> str:
    """The first paragraph of a docstring, on one line."""
    return " ".join((inspect.getdoc(kind) or "").partition("\n\n")[0].split())


def _schema(kind: Any, default: Any) -> dict[str, Any]:
    if kind is Any:
        return {}
    fields = schema_fields(kind)
    if fields is not None:
        described = field_comments(kind)
        properties = {}
        for name, field_kind in fields.items():
            value = None if default is None else default[name]
            properties[name] = _schema(field_kind, value)
            if name in described:
                properties[name]["description"] = described[name]
            if value is not None and not isinstance(value, dict) and value != []:
                properties[name]["default"] = value
        meaning = summary_of(kind) if dataclasses.is_dataclass(kind) else ""
        result = {"type": "object", "properties": properties, "additionalProperties": False}
        if hasattr(kind, "SHORTHAND"):
            result = {"anyOf": [{"type": "string"}, result]}
        return {"description": meaning, **result} if meaning else result
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        auto = [{"const": "auto"}] if args[0] is float else []
        return {"anyOf": [_schema(args[0], default), *auto, {"type": "null"}]}
    if kind == PerCoordinate:
        by_name = {"type": "object", "additionalProperties": {"type": "number"}}
        return {"anyOf": [{"type": "number"}, by_name]} | ({"default": default} if default else {})
    if origin is dict:
        return {"type": "object", "additionalProperties": _schema(args[1], None)}
    if origin is list:
        return {"type": "array", "items": _schema(args[0], None)}
    return {"type": _LEAVES[kind]}
