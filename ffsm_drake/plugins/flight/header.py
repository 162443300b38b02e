"""The header of an exported law."""

import hashlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

from ffsm_drake.plugins.flight.layout import HELD_FOR, LARGEST, NORM, WHOLES, WITHOUT, Layout
from ffsm_drake.plugins.flight.traced import core_of
from ffsm_drake.scenario import scenario_to_yaml

MATRIX = "const law_real q[LAW_NQ], law_real H[LAW_NV][LAW_NV]"
_STRUCTS = {
    "in": "What a sample reads.",
    "gains": "Gains, by coordinate in the order of v, or one for all.",
    "state": "Memory of the law. Set it with law_start; it is the caller's.",
    "out": "What a sample makes.",
}


def static_text(name: str) -> str:
    """C that is the same for all laws, from its file."""
    return (Path(__file__).parent / "c" / name).read_text()


def header_text(layout: Layout, *, file: str, operations: int, has_reference: bool) -> str:
    """The header.

    Args: the structs; its file name; operations of a sample; whether there is a reference.
    """
    return "\n".join(_lines(layout, file, operations, has_reference=has_reference)) + "\n"


def _lines(layout: Layout, file: str, operations: int, *, has_reference: bool) -> Iterator[str]:
    guard = f"FFSM_{re.sub('[^A-Z0-9]', '_', file.upper())}"
    yield from _about(layout, operations)
    yield f"#ifndef {guard}"
    yield f"#define {guard}"
    yield "#include <stdint.h>"
    yield "#ifdef __cplusplus"
    yield 'extern "C" {'
    yield "#endif"
    yield ""
    yield f"typedef {layout.precision.name} law_real;"
    yield ""
    yield from _macros(layout, has_reference=has_reference)
    yield ""
    yield static_text("guards.h")
    for name, about in _STRUCTS.items():
        yield f"/* {about} */"
        yield "typedef struct {"
        fields = [
            f"law_real {each.name}[{each.size}]; /* {_comment(each.about)} */"
            for each in layout.fields[name]
        ]
        fields += [f"uint32_t {whole}; /* {told} */" for whole, told in WHOLES[name].items()]
        yield from (f"  {field}" for field in fields or ["uint32_t none; /* the law has none */"])
        yield f"}} law_{name};"
        yield ""
    yield static_text("functions.h").rstrip()
    yield f"void law_mass_matrix({MATRIX});"
    if layout.captures:
        yield f"void law_mass_matrix{WITHOUT}({MATRIX});"
    yield ""
    yield "#ifdef __cplusplus"
    yield "}"
    yield "#endif"
    yield "#endif"


def _about(layout: Layout, operations: int) -> Iterator[str]:
    """What the law is, where it comes from, and its conventions."""
    scenario, coordinates = layout.scenario, layout.law.coordinates
    told = inspect.getdoc(type(core_of(layout.law.law))) or ""
    own_hash = hashlib.sha256(scenario_to_yaml(scenario).encode()).hexdigest()
    lines = [
        f"Control law '{scenario.controller}' of a free-flying space manipulator.",
        "",
        *told.partition("\n\n")[0].splitlines(),
        "",
        f"Made by ffsm_drake {version('ffsm-drake')} from the scenario with the SHA-256",
        own_hash,
        f"(seed {scenario.random_seed}).",
        "",
        f"A call of law_step is one control sample of {scenario.sample_time:g} s, and makes",
        f"{operations} operations. No allocation, recursion or mutable static data.",
        "Units are rad, m, s, N m and N. The base is in world axes.",
        f"v is [{', '.join(coordinates.names)}];",
        f"q is [{', '.join(coordinates.position_names)}].",
    ]
    yield "/*"
    for line in lines:
        for part in textwrap.wrap(_comment(line), 92) or [""]:
            yield f" * {part}".rstrip()
    yield " */"


def _comment(text: str) -> str:
    """A text that cannot end a comment, or begin another."""
    return " ".join(text.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").split())


def _macros(layout: Layout, *, has_reference: bool) -> Iterator[str]:
    scenario, number = layout.scenario, layout.precision.number
    inputs = {each.name: each.size for each in layout.fields["in"]}
    macros = [
        ("NQ", layout.nq, "numbers in q"),
        ("NV", layout.nv, "numbers in v"),
        ("SAMPLE_TIME", number(scenario.sample_time), "between calls of law_step, s"),
        ("NUM_INPUTS", sum(inputs.values()), "numbers at the beginning of law_in"),
        ("READS_IS_NEW", int("is_new" in inputs), "1: law_in has is_new"),
        ("READS_FRAME", int("desired_frame" in inputs), "1: law_in has desired_frame"),
        ("NUM_WRENCHES", inputs.get("measured_wrench", 0), "numbers in measured_wrench"),
        ("HAS_REFERENCE", int(has_reference), "1: there is law_reference"),
        ("HAS_CAPTURE", int(layout.captures), "1: law_in.holds matters"),
        ("HELD_SAMPLES", f"{max(1, round(HELD_FOR / scenario.sample_time))}U", "in 0.1 s"),
        ("LARGEST", number(LARGEST), "of a good input or force, rad, m, N m, N"),
        ("FASTEST", number(scenario.divergence_speed), "of a good v, rad/s or m/s"),
        ("NORM", number(NORM), "of a good quaternion: |norm^2 - 1|"),
    ]
    for name, value, about in macros:
        yield f"#define LAW_{name} {value} /* {about} */"
