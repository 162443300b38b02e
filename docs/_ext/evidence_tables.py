"""The tables of the evidence pages that are made from the models and the tests.

The keys of ``TABLES``, such as ``<!-- requirements -->``, stand for these tables on any page.
``python docs/_ext/evidence_tables.py`` prints all of them.
"""

import collections
import functools
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, NamedTuple

import yaml

import ffsm_drake
from ffsm_drake.scenario import load_scenario, scenario_to_dict

DOCS = Path(__file__).parents[1]
ROOT = DOCS.parent
SCENARIO = Path(ffsm_drake.__file__).parent / "scenario"
PARAMETERS = DOCS / "validation" / "parameters.yaml"
REQUIREMENTS = DOCS / "validation" / "requirements.yaml"
KINDS = ("published", "derived", "typical", "assumed")
MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


class Link(NamedTuple):
    """What a URDF gives of a link."""

    mass: float  # kg
    inertia: tuple[float, ...]  # ixx, iyy, izz, ixy, ixz, iyz about the centre of mass, kg m^2
    center: tuple[float, ...]  # of mass, in the link's frame, m


class Row(NamedTuple):
    """One row of a table of parameters."""

    place: str  # file, or scenarios
    what: str
    values: list[str]
    unit: str
    kind: str
    source: str
    spread: str


@functools.cache
def entries() -> Any:
    """The sources of the parameters."""
    return yaml.safe_load(PARAMETERS.read_text(encoding="utf-8"))


def links_of(urdf: Path) -> dict[str, Link]:
    """The links of a URDF that have a mass, by name."""
    found = {}
    for link in ElementTree.parse(urdf).getroot().iter("link"):
        if (inertial := link.find("inertial")) is not None:
            moments = {key: float(value) for key, value in inertial.find("inertia").items()}
            origin = inertial.find("origin")
            center = "0 0 0" if origin is None else origin.get("xyz", "0 0 0")
            found[link.get("name", "")] = Link(
                float(inertial.find("mass").get("value")),
                tuple(moments[key] for key in MOMENTS),
                tuple(map(float, center.split())),
            )
    return found


def leaves(tree: Any, path: str = "") -> dict[str, Any]:
    """The values of nested mappings by dotted key, without nulls."""
    if not isinstance(tree, dict):
        return {} if tree is None else {path: tree}
    found = {}
    for key, value in tree.items():
        found |= leaves(value, f"{path}.{key}" if path else str(key))
    return found


@functools.cache
def written(scenario: str) -> dict[str, Any]:
    """The values that the file of a shipped scenario gives itself, by dotted key."""
    text = (SCENARIO / "shipped" / f"{scenario}.yaml").read_text(encoding="utf-8")
    return leaves(yaml.safe_load(text))


def layouts() -> dict[str, Any]:
    """The values of the shipped layouts of thrusters, by dotted key."""
    return leaves(yaml.safe_load((SCENARIO / "thruster_layouts.yaml").read_text(encoding="utf-8")))


def matching(pattern: str, values: dict[str, Any]) -> dict[str, Any]:
    """The values of the keys that a pattern names; its part after # only tells entries apart."""
    parts = pattern.partition("#")[0].split(".")
    return {
        key: value
        for key, value in values.items()
        if len(names := key.split(".")) == len(parts) and all(map(fnmatchcase, names, parts))
    }


def shown(value: Any) -> str:
    """A value as in a table."""
    if isinstance(value, (list, tuple)):
        return "(" + ", ".join(map(shown, value)) + ")"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def different(values: Any) -> list[str]:
    """The values as in a table, each one once."""
    return list(dict.fromkeys(map(shown, values)))


def named(kind: str, key: str) -> str:
    """The text that a short name in the file stands for, or the name itself."""
    return str(entries()[kind].get(key, key))


def _shape(link: Link) -> str:
    """Inertia without products that are zero, and a centre of mass that is not zero."""
    inertia = link.inertia if any(link.inertia[3:]) else link.inertia[:3]
    return f"{shown(inertia)} kg m²" + (f" at {shown(link.center)} m" if any(link.center) else "")


def mass_rows() -> Iterator[Row]:
    """Rows of masses, and of inertias with centres of mass."""
    for file, patterns in entries()["masses"].items():
        links = links_of(ROOT / "models" / "urdf" / file)
        for pattern, (of_mass, of_inertia, source, spread) in patterns.items():
            found = [link for name, link in links.items() if fnmatchcase(name, pattern)]
            end = (named("sources", source), named("spreads", spread))
            what = f"`{pattern}`"
            masses = different(link.mass for link in found)
            inertias = different(_shape(link) for link in found)
            yield Row(f"`{file}`", f"{what}, mass", masses, "kg", of_mass, *end)
            yield Row(
                f"`{file}`",
                f"{what}, inertia",
                inertias,
                "",
                of_inertia,
                *end,
            )


def setting_rows() -> Iterator[Row]:
    """Rows of sensors, actuators, payloads and flexible parts."""
    for pattern, (unit, kind, source, spread, scenarios) in entries()["figures"].items():
        found = [value for name in scenarios for value in matching(pattern, written(name)).values()]
        place = ", ".join(f"`{name}`" for name in scenarios)
        yield _row(place, pattern, found, unit, kind, source, spread)
    for pattern, (unit, kind, source, spread) in entries()["thrusters"].items():
        found = list(matching(pattern, layouts()).values())
        yield _row("layouts of thrusters", pattern, found, unit, kind, source, spread)
    for pattern, (unit, kind, source, spread, scenario) in entries()["defaults"].items():
        found = list(matching(pattern, resolved(scenario)).values())
        yield _row("default", pattern, found, unit, kind, source, spread)


@functools.cache
def resolved(scenario: str) -> dict[str, Any]:
    """The values of a scenario with defaults, by dotted key; overrides may follow the name."""
    name, *overrides = scenario.split()
    return leaves(scenario_to_dict(load_scenario(name, overrides)))


def _row(place: str, pattern: str, values: list[Any], unit: str, kind: str, *end: str) -> Row:
    source, spread = named("sources", end[0]), named("spreads", end[1])
    key = f"`{pattern.partition('#')[0]}`"
    return Row(place, key, different(values) or ["null"], unit, kind, source, spread)


def _lines(rows: Iterator[Row], most: int) -> list[str]:
    """A table with at most this many values of a figure."""
    lines = ["| figure | values | kind | source | spread |", "|---|---|---|---|---|"]
    for row in rows:
        values = row.values
        if len(values) > most:
            values = [*values[: most - 1], "...", values[-1]]
        cell = f"{'; '.join(values)} {row.unit}".strip()
        cells = (f"{row.what}<br>{row.place}", cell, row.kind, row.source, row.spread)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def mass_table() -> str:
    """The mass properties with their sources, as Markdown."""
    return "\n".join(_lines(mass_rows(), 5))


def setting_table() -> str:
    """The figures of the scenarios with their sources, as Markdown."""
    return "\n".join(_lines(setting_rows(), 8))


def kind_table() -> str:
    """How many rows of each table are of each kind, as Markdown."""
    counts = [collections.Counter(row.kind for row in rows()) for rows in (mass_rows, setting_rows)]
    lines = ["| kind | mass properties | settings |", "|---|---|---|"]
    lines += [f"| {kind} | {' | '.join(str(count[kind]) for count in counts)} |" for kind in KINDS]
    return "\n".join(lines)


class Requirement(NamedTuple):
    """A promise, the page that makes it, the tests of it, and where it is known to fail."""

    text: str
    page: str
    tests: list[str]
    exception: str  # empty: none is known


def requirements() -> dict[str, Requirement]:
    """The requirements by identifier."""
    found = {}
    data = yaml.safe_load(REQUIREMENTS.read_text(encoding="utf-8"))
    for name, (text, page, *rest) in data.items():
        tests = [item for item in rest if item.startswith("tests/")]
        exceptions = [item for item in rest if not item.startswith("tests/")]
        found[name] = Requirement(text, page, tests, " ".join(exceptions))
    return found


def state(requirement: Requirement) -> str:
    """Whether a requirement is met, as far as its tests and the other evidence show."""
    if not requirement.tests:
        return "**not met**"
    return f"**partly**: {requirement.exception}" if requirement.exception else "tests pass"


def requirement_table() -> str:
    """The requirements with their tests, as Markdown."""
    lines = ["| requirement | text | state | tests |", "|---|---|---|---|"]
    for name, requirement in requirements().items():
        shown = [
            f"`{file.removeprefix('tests/')}`<br>`::{function}`"
            for file, function in (test.split("::") for test in requirement.tests)
        ]
        cells = (
            f"[{name}](../{requirement.page}.md)",
            requirement.text,
            state(requirement),
            "<br>".join(shown) or "**no test**",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


class Claim(NamedTuple):
    """One row of a table of claims."""

    text: str
    command: str
    date: str


def claims(text: str) -> list[Claim]:
    """The rows of the tables of claims on a page; a column that a table lacks gives ""."""
    found: list[Claim] = []
    head: list[str] = []
    for line in text.splitlines():
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if not cells:
            head = []
        elif cells[0].startswith("claim"):
            head = cells
        elif head and not line.startswith("|--"):
            row = dict(zip(head, cells, strict=False))
            found.append(Claim(cells[0], row.get("command", ""), row.get("date", "")))
    return found


# A command that can be pasted, and a word in it that the reader must replace.
COMMAND = r"`(?:time )?(?:[A-Z_]+=\S+ )*(?:pytest|python|ffsm) [^`]+`"
COMMANDS = re.compile(rf"{COMMAND}(; {COMMAND})*|the commands? below")
PLACEHOLDER = re.compile(r"\b(FILE|LAW|N|NAME|PANELS|RUN_DIR)\b")
SAME = re.compile(r"(the )?same")


def full_commands(text: str) -> list[bool]:
    """Whether each claim on a page has a full command, itself or by "the same"."""
    found = [False]
    for claim in claims(text):
        full = COMMANDS.fullmatch(claim.command) and not PLACEHOLDER.search(claim.command)
        found.append(found[-1] if SAME.fullmatch(claim.command) else bool(full))
    return found[1:]


TABLES: dict[str, Callable[[], str]] = {
    "<!-- kinds of parameters -->": kind_table,
    "<!-- mass properties -->": mass_table,
    "<!-- parameters of scenarios -->": setting_table,
    "<!-- requirements -->": requirement_table,
}


def with_tables(text: str) -> str:
    """A page's text with its tables in place of their marks."""
    for mark in [mark for mark in TABLES if mark in text]:
        text = text.replace(mark, TABLES[mark]())
    return text


def _fill_in(_: Any, _page: str, source: list[str]) -> None:
    source[0] = with_tables(source[0])


def setup(app: Any) -> dict[str, Any]:
    app.connect("source-read", _fill_in)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    for table in TABLES.values():
        print(table(), end="\n\n")
