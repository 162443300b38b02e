"""The tables of the documentation that are made from the package when the site is built.

On the pages scenario and blocks, the line ``<!-- table -->`` stands for the table of keys or ports.
On any page, the keys of ``LISTS``, such as ``<!-- laws -->``, stand for lists of what the package
contains. ``python docs/_ext/settings_tables.py`` prints all of
them.
"""

import dataclasses
import inspect
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ffsm_drake.common.registrations import own_plugins, plugin_of
from ffsm_drake.common.settings import Setting, settings_of
from ffsm_drake.loop.blocks import BLOCKS
from ffsm_drake.scenario import (
    PerCoordinate,
    Scenario,
    load_scenario,
    schema_fields,
    shipped_scenarios,
)
from ffsm_drake.scenario.resolving import without_null
from ffsm_drake.systems.controllers.law import gains_of
from ffsm_drake.systems.faults import fault_kinds
from ffsm_drake.systems.registry import find_factory, shipped_names

MARK = "<!-- table -->"
DOCS = Path(__file__).parents[1]
# keys of Drake's own settings that not every version has
_OLDER_DRAKE = ("publish_every_time_step",)
_BLOCK_KEYS = {
    "controller": "`controller`",
    "supervisor": "`supervisor`",
    "forces": "`blocks.forces.<name>`",
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One key of a scenario."""

    key: str
    kind: str
    default: str
    unit: str
    meaning: str


@dataclasses.dataclass(frozen=True)
class Section:
    """The keys of one group of settings."""

    path: str  # dotted; empty: the top level
    summary: str  # what the group is; empty where it was said before
    rows: list[Row]


def _kind(kind: Any, declared: Setting) -> str:
    """The type of a key's value, with its range."""
    if kind in (PerCoordinate, dict[str, int]):
        words = "by coordinate"
    elif typing.get_origin(kind) is list:
        words = "list of texts" if typing.get_args(kind) == (str,) else "list of numbers"
    elif typing.get_origin(kind) is dict:
        words = "mapping"
    else:
        words = {float: "number", int: "whole number", bool: "true/false", str: "text"}[kind]
    low, high = declared.size
    if low == high:
        words = words.replace("list of", f"list of {low}")
    if words == "text" and declared.one_of:
        words = f"text: {', '.join(f'`{choice}`' for choice in declared.one_of)}"
    return f"{words}, {declared.range}" if declared.range else words


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
    fields = schema_fields(cls) or {}
    return [
        Row(
            name,
            _kind(without_null(fields[name]), declared),
            _default(getattr(default, name)),
            declared.unit,
            declared.meaning,
        )
        for name, declared in settings_of(cls).items()
        if schema_fields(without_null(fields[name])) is None and name not in _OLDER_DRAKE
    ]


def _groups(cls: type, default: Any, path: str = "") -> Iterator[tuple[str, type, Any]]:
    yield path, cls, default
    for name, kind in (schema_fields(cls) or {}).items():
        inner = without_null(kind)
        place = f"{path}.{name}" if path else name
        if schema_fields(inner) is not None:
            given = getattr(default, name)
            yield from _groups(inner, inner() if given is None else given, place)
        elif (
            typing.get_origin(inner) is dict
            and schema_fields(typing.get_args(inner)[1]) is not None
        ):
            element = typing.get_args(inner)[1]
            yield (
                f"{place}.{'COORDINATE' if place == 'disturbance.harmonics' else 'NAME'}",
                element,
                element(),
            )


def _gains(controller: str) -> list[Row]:
    """The gains that a controller declares."""
    return [
        Row(
            name,
            _kind(float if item.scalar else PerCoordinate, item),
            _default(item.default),
            item.unit,
            item.meaning,
        )
        for name, item in gains_of(find_factory("controller", controller)).items()
    ]


def _table(rows: list[Row]) -> list[str]:
    return [
        "| key | value | default | unit | meaning |",
        "|---|---|---|---|---|",
        *(
            f"| `{row.key}` | {row.kind} | {row.default} | {_escaped(row.unit)} | "
            f"{_escaped(row.meaning)} |"
            for row in rows
        ),
        "",
    ]


def scenario_keys() -> Iterator[Section]:
    """Every key of a scenario with default, unit and meaning, by group; the gains of the shipped
    controllers last.
    """
    described = set()
    for path, cls, default in _groups(Scenario, Scenario()):
        if found := rows(cls, default):
            summary = (
                inspect.getdoc(cls)
                if dataclasses.is_dataclass(cls)
                else ("Drake's own settings of the simulator.")
            )
            yield Section(path, "" if cls in described else summary or "", found)
            described.add(cls)
    for controller in shipped_names("controller"):
        yield Section(f"controllers.{controller}", "", _gains(controller))


def scenario_table() -> str:
    """The table of every key, as Markdown."""
    lines = []
    for section in scenario_keys():
        lines += [f"## `{section.path}`" if section.path else "## Top level", ""]
        lines += [_prose(section.summary), ""] if section.summary else []
        lines += _table(section.rows)
    return "\n".join(lines).rstrip()


def _prose(docstring: str) -> str:
    """A docstring as Markdown, with its example as code."""
    text, _, example = docstring.partition("\n\nExample:\n")
    code = f"\n\n```pycon\n{inspect.cleandoc(example)}\n```" if example else ""
    return text + code


def block_table() -> str:
    """One row for each port of each block, as Markdown."""
    lines = ["| scenario key | port | size |", "|---|---|---|"]
    for block, ports in BLOCKS.items():
        key = _BLOCK_KEYS.get(block, f"`blocks.{block}`")
        for kind, names, optional in (
            ("in", ports.inputs, ""),
            ("in", ports.optional_inputs, ", optional"),
            ("out", ports.outputs, ""),
            ("out", ports.optional_outputs, ", optional"),
        ):
            for name, size in names.items():
                shown = size.replace(" ", "&nbsp;")
                lines.append(f"| {key} | {kind} `{name}`{optional} | {shown} |")
                key = ""
    return "\n".join(lines)


def law_table() -> str:
    """The shipped control laws with the first line of their docstrings, as Markdown."""
    lines = ["| `controller` | law | page |", "|---|---|---|"]
    for name in shipped_names("controller"):
        factory: Any = find_factory("controller", name)
        plugin = plugin_of(factory.__module__)
        page = own_plugins()[plugin].page if plugin else "controllers"
        lines.append(f"| `{name}` | {_first(factory.__doc__)} | {_link(page)} |")
    return "\n".join(lines)


def law_modules() -> str:
    """A directive for the docstrings of each shipped control law, as reStructuredText."""
    laws = (find_factory("controller", name) for name in shipped_names("controller"))
    modules = dict.fromkeys(law.__module__ for law in laws)
    return "\n\n".join(f".. automodule:: {module}" for module in modules)


def scenario_list() -> str:
    """The shipped scenarios with their descriptions, as Markdown."""
    lines = ["| scenario | what it simulates |", "|---|---|"]
    for name in shipped_scenarios():
        lines.append(f"| `{name}` | {_escaped(load_scenario(name).description)} |")
    return "\n".join(lines)


def plugin_table() -> str:
    """The plug-ins, with what they bring, import and use, as Markdown."""
    lines = ["| plug-in | capability | brings | imports | uses |", "|---|---|---|---|---|"]
    for name, plugin in own_plugins().items():
        brings = [
            f"{group.replace('_', ' ')} {_names(names)}" for group, names in plugin.brings.items()
        ]
        page = f" ({_link(plugin.page)})" if plugin.page else ""
        lines.append(
            f"| `{name}` | {_escaped(plugin.about)}{page} | {'; '.join(brings)} | "
            f"{_names(plugin.needs)} | {_names(plugin.uses)} |"
        )
    return "\n".join(lines)


def fault_table() -> str:
    """The kinds of faults that the parts declare, as Markdown."""
    lines = ["| unit | kind | effect | default of `size` |", "|---|---|---|---|"]
    for part, kinds in fault_kinds().items():
        unit = f"`{part}.NAME`"
        for name, kind in kinds.items():
            default = f"{kind.default:g}" if kind.size and kind.default is not None else ""
            lines.append(f"| {unit} | `{name}` | {_escaped(kind.effect)} | {default} |")
            unit = ""
    return "\n".join(lines)


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _link(page: str) -> str:
    return f"[{page.replace('_', ' ')}]({page}.md)"


def _first(docstring: str | None) -> str:
    """The first paragraph of a docstring without its full stop, as Markdown for a table's cell."""
    return _escaped(" ".join((docstring or "").split("\n\n")[0].split()).removesuffix("."))


PAGES: dict[str, Callable[[], str]] = {"scenario": scenario_table, "blocks": block_table}
LISTS: dict[str, Callable[[], str]] = {
    "<!-- laws -->": law_table,
    "<!-- law modules -->": law_modules,
    "<!-- scenarios -->": scenario_list,
    "<!-- plugins -->": plugin_table,
    "<!-- faults -->": fault_table,
}


def with_table(page: str, text: str) -> str:
    """A page's text with its tables in place of their marks."""
    lists = {mark: table for mark, table in LISTS.items() if mark in text}
    for mark, table in lists.items() | ({MARK: PAGES[page]} if page in PAGES else {}).items():
        text = text.replace(mark, table())
    return text


def _fill_in(_: Any, page: str, source: list[str]) -> None:
    source[0] = with_table(page, source[0])


def setup(app: Any) -> dict[str, Any]:
    app.connect("source-read", _fill_in)
    return {"parallel_read_safe": True}


def _escaped(text: str) -> str:
    """A text as Markdown for a table's cell."""
    text = re.sub(r"``(.+?)``", r"`\1`", text).replace("|", "\\|")
    text = re.sub(r"\bK_([A-Za-z])\b", r"$K_\1$", text)
    text = text.replace("sqrt(s)", "√s").replace("^2", "²").replace("^3", "³")
    return "".join(
        part if part[:1] in ("`", "$") else part.replace("_", "\\_")
        for part in re.split(r"(`[^`]*`|\$[^$]*\$)", text)
    )


if __name__ == "__main__":
    for table in (*PAGES.values(), *LISTS.values()):
        print(table(), end="\n\n")
