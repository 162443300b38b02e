"""The table of every scenario key, read from the dataclasses of ffsm_drake.scenario and the comments at their fields.

A page that holds the line ``<!-- scenario reference -->`` gets it there, as Markdown, whenever the site is built.
"""

import ast
import dataclasses
import inspect
import io
import re
import tokenize
import types
import typing
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from pydrake.systems.analysis import SimulatorConfig

from ffsm_drake import scenario as schema

if TYPE_CHECKING:
    from sphinx.application import Sphinx

MARKER = "<!-- scenario reference -->"

# Meanings that a field's comment leaves to its name; a comment in the source wins.
_MEANINGS = {
    "Scenario.description": "title of plots and records",
    "Scenario.random_seed": "seed of the measurement noise; the same seed gives the same bits",
    "Scenario.controller": f"one of {', '.join(f'`{name}`' for name in schema.CONTROLLER_NAMES)}",
    "Payload.body": "scoped name of the captured body in the model",
    "MassProperties.mass": "mass",
    "MassProperties.center_of_mass": "position of the centre of mass",
    "Posture.base_position": "position of the base",
    "Posture.joints": "joint positions",
    "k_d": "gain $K_D$ on the error's rate",
    "k_p": "gain $K_P$ on the error",
    "k_e": "stiffness on the error",
    "k_s": "reaching gain $K_s$",
    "k_s_initial": "reaching gain $K_s$ at the start",
    "k_s_max": "upper bound of $K_s$",
    "g_initial": "switching gain $G$ at the start",
    "g_max": "upper bound of $G$",
    "Estimator.position_noise": "position noise that the filter assumes",
    "Estimator.velocity_noise": "velocity noise that the filter assumes",
    "Harmonic.amplitude": "amplitude",
    "Harmonic.frequency": "angular frequency",
    "Harmonic.phase": "phase",
    "Harmonic.bias": "constant part",
    "Sensing.velocity_noise": "noise of the measured velocities",
    "Sensing.position_noise": "noise of the measured positions",
    "Sensing.velocity_bias": "constant error of the measured velocities",
    "Sensing.position_bias": "constant error of the measured positions",
    "Sensing.velocity_quantization": "resolution of the measured velocities",
    "Sensing.position_quantization": "resolution of the measured positions",
    "Sensing.delay": "age of a measurement when the controller reads it",
    "Actuation.limit": "largest force",
    "Actuation.quantization": "resolution of the force",
    "Actuation.delay": "age of a command when it acts",
    "SimulatorConfig.integration_scheme": "Drake's name of the integrator; `explicit_euler` at `max_step_size = "
    "sample_time` is the paper's",
    "SimulatorConfig.max_step_size": "step of a fixed-step integrator, largest step of one with error control",
    "SimulatorConfig.accuracy": "relative accuracy asked of an integrator with error control",
    "SimulatorConfig.use_error_control": "let the integrator choose its steps",
    "SimulatorConfig.target_realtime_rate": "1 paces the run to real time; 0 runs as fast as it can",
    "SimulatorConfig.publish_every_time_step": "Drake's per-step publish; not needed here",
    "SimulatorConfig.start_time": "Drake's start time; a scenario starts at 0",
}
_RATE, _SLIDING = "1/(rad s) or 1/(m s)", "rad/s or m/s"
_UNITS = {
    "SimulatorConfig.max_step_size": "s",
    "SimulatorConfig.start_time": "s",
    "AismcGains.alpha": _RATE,
    "AismcGains.beta": _RATE,
    "TdeAismcGains.alpha": _RATE,
    "TdeAismcGains.beta": "1/rad or 1/m",
    "TdeAismcGains.phi": "1/s^2",
    "TdeAismcGains.epsilon": _SLIDING,
    "AsmcGains.epsilon": _SLIDING,
    "AsmcGains.a": "rad/s^3 or m/s^3",
    "AsmcGains.b": "s/rad or s/m",
}

_UNIT = re.compile(
    r"(?:kg m\^2|N m or N|rad/s\^2 or m/s\^2(?: per sqrt\(s\))?|rad/s or m/s|rad \(revolute\) or m \(prismatic\)"
    r"|rad or m|control samples|N m/rad or N/m|N m s/rad or N s/m|1/s\^2|1/s|rad/s|kg|rad|m|s)(?=$|[,;:.])"
)


@dataclasses.dataclass(frozen=True)
class Row:
    """One key of a scenario."""

    key: str
    kind: str
    default: str
    unit: str
    meaning: str


def field_comments(cls: type) -> dict[str, tuple[str, str]]:
    """Field name -> (comment lines above it, comment beside it), of a class's own annotated fields."""
    source = inspect.getsource(cls)
    comments = {
        token.start[0]: (token.string.lstrip("# ").strip(), token.line.lstrip().startswith("#"))
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    found = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        above, line = [], node.lineno - 1
        while line in comments and comments[line][1]:
            above.insert(0, comments[line][0])
            line -= 1
        last = node.end_lineno or node.lineno
        beside = comments[last][0] if last in comments and not comments[last][1] else ""
        found[node.target.id] = (" ".join(above), beside)
    return found


def _inherited_comments(cls: type) -> dict[str, tuple[str, str]]:
    return {name: found for base in reversed(cls.__mro__[:-1]) for name, found in field_comments(base).items()}


def _split_unit(text: str) -> tuple[str, str]:
    """Unit and remaining meaning of a comment; the unit stands at its start, or at its end after a comma."""
    if start := _UNIT.match(text):
        return start.group(), text[start.end() :].lstrip(",;:. ")
    for found in _UNIT.finditer(text):
        if found.start() >= 2 and text[found.start() - 2 : found.start()] == ", ":
            return found.group(), (text[: found.start()].rstrip(", ") + text[found.end() :]).rstrip(". ")
    return "", text


def _optional(kind: Any) -> tuple[Any, bool]:
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        return typing.get_args(kind)[0], True
    return kind, False


def _kind(kind: Any) -> str:
    kind, _ = _optional(kind)
    if kind == schema.PerCoordinate:
        return "by coordinate"
    if typing.get_origin(kind) is list:
        return "list of numbers"
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
    found = []
    comments = _inherited_comments(cls) if dataclasses.is_dataclass(cls) else {}
    for name, kind in (schema._schema_fields(cls) or {}).items():
        if schema._schema_fields(_optional(kind)[0]) is not None:
            continue
        own = f"{cls.__name__}.{name}"
        above, beside = comments.get(name, ("", ""))
        unit, meaning = _split_unit(beside)
        if not unit:
            unit, above = _split_unit(above)
        stated = _MEANINGS.get(own) or (_MEANINGS.get(name, "") if not above else "")
        if stated and above:
            above = above[0].lower() + above[1:]
        parts = [part for part in (stated, above.rstrip("."), meaning) if part]
        found.append(
            Row(name, _kind(kind), _default(getattr(default, name)), unit or _UNITS.get(own, ""), "; ".join(parts))
        )
    return found


def _groups(cls: type, default: Any, path: str = "") -> Iterator[tuple[str, type, Any]]:
    yield path, cls, default
    for name, kind in (schema._schema_fields(cls) or {}).items():
        inner = _optional(kind)[0]
        place = f"{path}.{name}" if path else name
        if schema._schema_fields(inner) is not None:
            yield from _groups(inner, getattr(default, name), place)
        elif typing.get_origin(inner) is dict and schema._schema_fields(typing.get_args(inner)[1]) is not None:
            element = typing.get_args(inner)[1]
            yield f"{place}.COORDINATE", element, element()


def markdown() -> str:
    """Every key of a scenario, one table per group of settings."""
    lines: list[str] = []
    described = set()
    for path, cls, default in _groups(schema.Scenario, schema.Scenario()):
        table = rows(cls, default)
        if not table:
            continue
        lines += [f"## `{path}`" if path else "## Top level", ""]
        summary = inspect.getdoc(cls) or ""
        if cls is SimulatorConfig:
            summary = "Drake's own settings of the simulator."
        if summary and cls not in described:
            lines += [summary.split("\n\n")[0].replace("\n", " "), ""]
        described.add(cls)
        lines += ["| key | value | default | unit | meaning |", "|---|---|---|---|---|"]
        lines += [
            f"| `{row.key}` | {row.kind} | {row.default} | {_escaped(row.unit)} | {_escaped(row.meaning)} |"
            for row in table
        ]
        lines.append("")
    return "\n".join(lines)


def _escaped(text: str) -> str:
    text = re.sub(r"``(.+?)``", r"`\1`", text).replace("|", "\\|")
    text = re.sub(r"\b(sqrt)\(s\)", "√s", text)
    text = re.sub(r"(?<![\\$\w^])(\w+)\^2", lambda found: found.group(1) + "²", text).replace("s^3", "s³")
    return text if "`" in text or "$" in text else re.sub(r"(?<=\w)_(?=\w)", r"\\_", text)


def _insert(app: "Sphinx", docname: str, source: list[str]) -> None:
    if MARKER in source[0]:
        source[0] = source[0].replace(MARKER, markdown())


def setup(app: "Sphinx") -> dict[str, Any]:
    app.connect("source-read", _insert)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
