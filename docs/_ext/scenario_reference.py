"""The table of every scenario key: types, defaults and meanings from ffsm_drake.scenario, gains from the control laws.

It replaces the line ``<!-- scenario reference -->`` of a page, as Markdown, when the site is built.
"""

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from ffsm_drake.scenario import PerCoordinate, Scenario, schema_fields
from ffsm_drake.scenario.json_schema import field_comments
from ffsm_drake.systems.controllers import controller_names
from ffsm_drake.systems.controllers.law import gains_of
from ffsm_drake.systems.registry import find_factory

if TYPE_CHECKING:
    from sphinx.application import Sphinx

MARKER = "<!-- scenario reference -->"

_UNIT = re.compile(r"(?:(?:kg|rad|m|s|N|1)(?:\^\d)?|sqrt\(s\)|control samples|or|per|[ /()])+")


@dataclasses.dataclass(frozen=True)
class Row:
    """One key of a scenario."""

    key: str
    kind: str
    default: str
    unit: str
    meaning: str


def _split_unit(comment: str) -> tuple[str, str]:
    """Unit and meaning of a comment "unit; meaning"; a quantity without unit has the meaning alone."""
    unit, _, meaning = comment.partition("; ")
    return (unit, meaning) if _UNIT.fullmatch(unit) else ("", comment)


def _without_null(kind: Any) -> Any:
    return typing.get_args(kind)[0] if typing.get_origin(kind) in (typing.Union, types.UnionType) else kind


def _kind(kind: Any) -> str:
    kind = _without_null(kind)
    if kind == PerCoordinate:
        return "by coordinate"
    if typing.get_origin(kind) is list:
        return "list of texts" if typing.get_args(kind) == (str,) else "list of numbers"
    if typing.get_origin(kind) is dict:
        return "mapping"
    return {float: "number", int: "whole number", bool: "true/false", str: "text"}[kind]


def _default(value: Any) -> str:
    def number(item: Any) -> str:
        if isinstance(item, bool) or item is None:
            return {True: "true", False: "false", None: "null"}[item]
        return f"{item:g}" if isinstance(item, float) else str(item)

    if isinstance(value, Mapping):
        if list(value) == ["all"]:
            return f"`{number(value['all'])}`"
        return "<br>".join(f"`{name}: {number(item)}`" for name, item in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        return f"`[{', '.join(map(number, value))}]`"
    return f"`{number(value)}`" if value != "" else ""


def rows(cls: type, default: Any) -> list[Row]:
    """The plain keys of one group of settings; those that are groups themselves are left out."""
    comments = field_comments(cls)
    return [
        Row(name, _kind(kind), _default(getattr(default, name)), *_split_unit(comments.get(name, "")))
        for name, kind in (schema_fields(cls) or {}).items()
        if schema_fields(_without_null(kind)) is None
    ]


def _groups(cls: type, default: Any, path: str = "") -> Iterator[tuple[str, type, Any]]:
    yield path, cls, default
    for name, kind in (schema_fields(cls) or {}).items():
        inner = _without_null(kind)
        place = f"{path}.{name}" if path else name
        if schema_fields(inner) is not None:
            given = getattr(default, name)
            yield from _groups(inner, inner() if given is None else given, place)
        elif typing.get_origin(inner) is dict and schema_fields(typing.get_args(inner)[1]) is not None:
            element = typing.get_args(inner)[1]
            yield f"{place}.{'COORDINATE' if place == 'disturbance.harmonics' else 'NAME'}", element, element()


def _gains(controller: str) -> list[Row]:
    """The gains that a controller declares."""
    return [
        Row(name, "number" if item.scalar else "by coordinate", _default(item.default), item.unit, item.meaning)
        for name, item in gains_of(find_factory("controller", controller)).items()
    ]


def _table(rows: list[Row]) -> list[str]:
    return [
        "| key | value | default | unit | meaning |",
        "|---|---|---|---|---|",
        *(
            f"| `{row.key}` | {row.kind} | {row.default} | {_escaped(row.unit)} | {_escaped(row.meaning)} |"
            for row in rows
        ),
        "",
    ]


def markdown() -> str:
    """Every key of a scenario, one table per group of settings; the gains of the installed controllers last."""
    lines: list[str] = []
    described = set()
    for path, cls, default in _groups(Scenario, Scenario()):
        table = rows(cls, default)
        if not table:
            continue
        lines += [f"## `{path}`" if path else "## Top level", ""]
        summary = inspect.getdoc(cls) if dataclasses.is_dataclass(cls) else "Drake's own settings of the simulator."
        if summary and cls not in described:
            lines += [summary, ""]
        described.add(cls)
        lines += _table(table)
    for controller in controller_names():
        lines += [f"## `controllers.{controller}`", "", *_table(_gains(controller))]
    return "\n".join(lines)


def _escaped(text: str) -> str:
    """A comment as Markdown for a table's cell."""
    text = re.sub(r"``(.+?)``", r"`\1`", text).replace("|", "\\|")
    text = re.sub(r"\bK_([A-Za-z])\b", r"$K_\1$", text)
    text = text.replace("sqrt(s)", "√s").replace("^2", "²").replace("^3", "³")
    return "".join(
        part if part[:1] in ("`", "$") else part.replace("_", "\\_") for part in re.split(r"(`[^`]*`|\$[^$]*\$)", text)
    )


def _insert(app: "Sphinx", docname: str, source: list[str]) -> None:
    if MARKER in source[0]:
        source[0] = source[0].replace(MARKER, markdown())


def setup(app: "Sphinx") -> dict[str, Any]:
    app.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
