"""The files of a control law in C99: a header, and the code.

All memory is the caller's. A sample whose inputs or results are unusable leaves the memory as it
was: the last force is held for a while, then the force is zero.
"""

import dataclasses
import hashlib
import inspect
import json
import re
import textwrap
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.compiled.apart import apart, reason_of
from ffsm_drake.plugins.flight.functions import Function, Precision
from ffsm_drake.plugins.flight.traced import PLANNED, TIME, FlightLaw, core_of, traced_motion
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import HELD, Grip, Scenario, scenario_to_yaml
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import POSITION, RATE
from ffsm_drake.spacecraft.plant import make_plant
from ffsm_drake.systems.controllers.law import is_shipped
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.limits import joint_limits
from ffsm_drake.systems.reference import make_frame_motion, make_motion

HELD_FOR = 0.1  # s, that the last force is held
LARGEST = 1e9  # of an input, rad, m, N m, N
NORM = 0.1  # tolerance of a quaternion's norm, which integrators let drift
_WHOLE = "uint32_t"
_HELD, _FREE = "", "_without_target"  # suffixes of functions
_WORDS = set(
    [
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "bool",
        "true",
        "false",
    ]
)


class Field(NamedTuple):
    """Numbers of a struct."""

    name: str
    size: int
    about: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class LawFiles:
    """The texts of an exported law, and what is known of it."""

    header: str
    source: str
    sizes: Mapping[str, int]  # bytes of each struct
    operations: int  # of a sample
    reference: str  # "polynomial", "table", or "": the caller gives it

    @classmethod
    def of(
        cls, scenario: Scenario, *, single: bool = False, table: bool = False, header: str = "law.h"
    ) -> "LawFiles":
        """Export the law of a scenario.

        Args:
          scenario: names the law, its gains, estimator, filters, limits and reference.
          single: in single precision.
          table: the reference as a table, even if it is a polynomial.
          header: the header's file name.

        Raises FfsmError: the law cannot be exported; the message names the place in its code.
        """
        laws = {
            grip.holds: FlightLaw(scenario, grip)
            for grip in ((Grip(False), HELD) if scenario.grasps else (HELD,))
        }
        writer = _Writer(scenario, laws, Precision(single), table=table, header=header)

        def made() -> str:
            return json.dumps(dataclasses.asdict(writer.files()))

        try:
            own = all(is_shipped(law.law) for law in laws.values())
            return cls(**json.loads(made() if own else apart(made)))
        except NotCovered as error:
            raise _refused(scenario, error.what) from error
        except FfsmError:
            raise
        except Exception as error:  # a law may raise anything on symbols
            raise _refused(scenario, reason_of(error)) from error


def _refused(scenario: Scenario, why: str) -> FfsmError:
    return FfsmError(f"controller '{scenario.controller}' cannot be exported as C: {why}")


class _Writer:
    """Writes the files."""

    def __init__(
        self,
        scenario: Scenario,
        laws: Mapping[bool, FlightLaw],
        precision: Precision,
        *,
        table: bool,
        header: str,
    ) -> None:
        self._scenario, self._laws, self._precision = scenario, laws, precision
        self._law, self._table, self._file = laws[True], table, header
        self._names: Coordinates = self._law.coordinates
        self._nq, self._nv = self._names.num_positions, self._names.num_velocities
        self._captures = len(laws) > 1
        self._motions = [] if self._captures else self._planned_motions()
        # the memory of both laws; fields of one name have one size, or are apart
        self._places = {
            holds: {name: self._field_of(name, holds) for name in of.memory}
            for holds, of in laws.items()
        }

    def _field_of(self, name: str, holds: bool) -> str:
        own, other = (of.memory.get(name) for of in (self._laws[holds], self._laws[True]))
        alike = holds or (own is None or other is None) or np.array_equal(own, other)
        return _identifier(name) + ("" if alike else _FREE)

    def _planned_motions(self) -> list[tuple[str, Any]]:
        """The motion, and the path of a frame, by the fields of ``law_in`` that they fill."""
        motion = make_motion(self._scenario, self._names, self._law.grip)
        path = make_frame_motion(self._scenario, self._law.nominal, motion)
        return [("q_d", motion), *([] if path is None else [("desired_frame", path)])]

    def files(self) -> LawFiles:
        """The files. Raises what the law raises on symbols."""
        functions = {
            holds: [law.sample(self._precision, is_first=first) for first in (True, False)]
            for holds, law in self._laws.items()
        }
        self._reads = {name for of in functions.values() for each in of for name, _ in each.reads}
        references = list(map(self._reference, self._motions))
        self._references = references
        kinds = {"table" if isinstance(each, np.ndarray) else "polynomial" for each in references}
        fields = {name: self._fields(name) for name in ("in", "gains", "state", "out")}
        own = 4 if self._precision.single else 8
        sizes = {
            f"law_{name}": _bytes(given, own, wholes=_WHOLES[name])
            for name, given in fields.items()
        }
        sample = functions[True][1]
        made = LawFiles(
            header="", source="", sizes=sizes, operations=sum(sample.operations.values()),
            reference=max(kinds, default=""),
        )  # fmt: skip
        header = "\n".join(self._header(fields, made)) + "\n"
        source = "\n".join(self._source(functions)) + "\n"
        return dataclasses.replace(made, header=header, source=source)

    def _reference(self, motion: tuple[str, Any]) -> Function | np.ndarray:
        """A motion as a function, or as a table of its control samples."""
        if not self._table:
            try:
                return traced_motion(motion[1], self._precision)
            except Exception:  # NumPy raises many kinds on symbols
                pass
        count = self._scenario.num_control_periods + 1
        return motion[1].rows(self._scenario.sample_time * np.arange(count))

    def _fields(self, struct: str) -> list[Field]:
        """The numbers of a struct."""
        nq, nv = self._nq, self._nv
        if struct == "gains":
            return [
                Field(_identifier(name), values.size, f"{of.unit or '1'}: {of.meaning}")
                for name, (of, values) in self._law.gains.items()
            ]
        if struct == "out":
            return [
                Field("force", nv, "hold it until the next sample"),
                Field("commanded", nv, "before limits and quantisation of the force"),
            ]
        if struct == "state":
            found = {
                place: Field(place, law.memory[name].size, f"'{name}' of the law")
                for holds, law in self._laws.items()
                for name, place in self._places[holds].items()
            }
            return [*found.values(), Field("last_force", nv, "of the last good sample")]
        wrench = self._law.inputs.get("measured_wrench", 0)
        read = {
            "measurement_is_new": Field("is_new", nq + nv, "1: measured anew, 0: repeated; [q; v]"),
            "desired_frame": Field(
                "desired_frame", FRAME_SIZE, "[quaternion; p; w; v; alpha; a] of the frame, world"
            ),
            "measured_wrench": Field("measured_wrench", wrench, "at the contacts"),
        }
        return [
            Field("q", nq, "measured"),
            Field("v", nv, "measured"),
            Field("q_d", nq, "reference"),
            Field("v_d", nv, "reference"),
            Field("a_d", nv, "reference: time derivative of v_d"),
            Field("applied_force", nv, "over the last period; at the first sample zero"),
            *(field for name, field in read.items() if name in self._reads),
        ]

    def _header(self, fields: Mapping[str, list[Field]], made: LawFiles) -> Iterator[str]:
        precision, scenario = self._precision, self._scenario
        guard = f"FFSM_{re.sub('[^A-Z0-9]', '_', self._file.upper())}"
        yield from self._about(made)
        yield f"#ifndef {guard}"
        yield f"#define {guard}"
        yield "#include <stdint.h>"
        yield "#ifdef __cplusplus"
        yield 'extern "C" {'
        yield "#endif"
        yield ""
        yield f"typedef {precision.name} law_real;"
        yield ""
        defined = {
            "NQ": str(self._nq), "NV": str(self._nv),
            "SAMPLE_TIME": precision.number(scenario.sample_time),
            "NUM_INPUTS": str(sum(each.size for each in fields["in"])),
            "READS_IS_NEW": str(int("measurement_is_new" in self._reads)),
            "READS_FRAME": str(int("desired_frame" in self._reads)),
            "NUM_WRENCHES": str(sum(e.size for e in fields["in"] if e.name == "measured_wrench")),
            "HAS_REFERENCE": str(int(bool(self._motions))),
            "HAS_CAPTURE": str(int(self._captures)),
            # a bad sample: the last force is held over so many in a row
            "HELD_SAMPLES": f"{max(1, round(HELD_FOR / scenario.sample_time))}U",
            # inputs are good up to these sizes, and a quaternion's norm^2 within that of 1
            "LARGEST": precision.number(LARGEST),
            "FASTEST": precision.number(scenario.divergence_speed),
            "NORM": precision.number(NORM),
        }  # fmt: skip
        for name, value in defined.items():
            yield f"#define LAW_{name} {value}"
        yield from ("", _text("guards.h"))
        for name, given in fields.items():
            yield from self._struct(name, given)
        yield _DECLARED
        if self._motions:
            yield _DECLARED_REFERENCE
        yield "/* The mass matrix of the nominal model, with the target. */"
        yield f"void law_mass_matrix({_MATRIX});"
        if self._captures:
            yield "/* Without the target. */"
            yield f"void law_mass_matrix{_FREE}({_MATRIX});"
        yield ""
        yield "#ifdef __cplusplus"
        yield "}"
        yield "#endif"
        yield "#endif"

    def _about(self, made: LawFiles) -> Iterator[str]:
        """What the law is, where it comes from, and its conventions."""
        scenario = self._scenario
        text = scenario_to_yaml(scenario)
        told = inspect.getdoc(type(core_of(self._law.law))) or ""
        first = told.partition("\n\n")[0]
        base, *_ = self._names.position_names
        names = ", ".join(self._names.names)
        lines = [
            f"Control law '{scenario.controller}' of a free-flying space manipulator.", "",
            *textwrap.wrap(first, 92), "",
            f"Made by ffsm_drake {version('ffsm-drake')} from the scenario with the SHA-256",
            f"{hashlib.sha256(text.encode()).hexdigest()}", f"and the seed {scenario.random_seed}.",
            "",
            f"A call of law_step is one control sample of {scenario.sample_time:g} s:",
            f"{made.operations} operations. No allocation, recursion or mutable static data.",
            "Units are rad, m, s, N m and N. The base is in world axes.",
            *textwrap.wrap(f"v is [{names}];", 92),
            f"q is [quaternion w, x, y, z of the base; position of the base; joints] ({base}, ...).",
        ]  # fmt: skip
        yield "/*"
        yield from (f" * {line.replace('*/', '* /')}".rstrip() for line in lines)
        yield " */"

    def _struct(self, name: str, fields: list[Field]) -> Iterator[str]:
        yield f"/* {_STRUCTS[name]} */"
        yield "typedef struct {"
        for each in fields:
            yield f"  law_real {each.name}[{each.size}]; /* {each.about} */"
        for whole, about in _WHOLES[name].items():
            yield f"  {_WHOLE} {whole}; /* {about} */"
        if not fields and not _WHOLES[name]:
            yield f"  {_WHOLE} unused; /* the law has none */"
        yield f"}} law_{name};"
        yield ""

    def _source(self, functions: Mapping[bool, list[Function]]) -> Iterator[str]:
        precision = self._precision
        yield f'#include "{self._file}"'
        yield ""
        yield "#include <math.h>"
        yield "#include <stdbool.h>"
        yield "#include <string.h>"
        yield ""
        yield self._constant_gains()
        body = "\n".join(self._body(functions))
        helpers = _text("helpers.c").split("\n\n")
        yield "\n\n".join(each for each in helpers if _is_used(each, body))
        yield body

    def _body(self, functions: Mapping[bool, list[Function]]) -> Iterator[str]:
        """All functions but the helpers."""
        precision = self._precision
        yield from self._limit_tables()
        for holds, (first, sample) in functions.items():
            yield from self._sample(holds, first, sample)
        if self._captures:
            for holds, law in self._laws.items():
                function = law.resumed(self._laws[not holds], precision)
                arguments = f"const law_in *in, {_RESUMED}"
                yield function.text(arguments, self._source_of(not holds), self._target_of(holds))
        for holds, law in self._laws.items():
            suffix = _HELD if holds else _FREE
            function = law.mass_matrix(precision)
            text = function.text(
                _MATRIX, lambda _, i: f"q[{i}]", self._entry_of_matrix, local=False
            )
            yield text.replace(f"void mass_matrix{suffix}(", f"void law_mass_matrix{suffix}(")
        yield from self._reference_texts()
        yield from self._start()
        yield from self._checks()
        yield _text("step.c")

    def _entry_of_matrix(self, _: str, entry: int) -> str:
        return f"H[{entry // self._nv}][{entry % self._nv}]"

    def _sample(self, holds: bool, first: Function, sample: Function) -> Iterator[str]:
        """The functions of a sample, with what they read by sample."""
        suffix, law = _HELD if holds else _FREE, self._laws[holds]
        planned = "NULL"
        if PLANNED in self._reads:
            planned = f"planned_at{suffix}(in)"
            yield from self._planned(law, suffix)
        for function in (first, sample):
            yield function.text(_SAMPLE, self._source_of(holds), self._target_of(holds))
        yield f"""static void any_sample{suffix}(bool is_first, {_ANY})
{{
  const law_real *planned = {planned};
  if (is_first) {{
    first_sample{suffix}(planned, in, gains, before, next, out);
  }} else {{
    sample{suffix}(planned, in, gains, before, next, out);
  }}
}}
"""

    def _planned(self, law: FlightLaw, suffix: str) -> Iterator[str]:
        """The function that finds the numbers that the law reads at a sample, with their table."""
        name = f"PLANNED{suffix.upper()}"
        head = f"static const law_real *planned_at{suffix}(const law_in *in)"
        if (found := law.postures(self._precision)) is not None:
            rows, function = found
            yield self._table_of(name, rows)
            arguments = "const law_in *in, law_real *place"
            target = lambda array, entry: f"{array}[{entry}]"  # noqa: E731
            yield function.text(arguments, self._source_of(law.grip.holds), target)
            yield f"{head}\n{{"
            yield f"  law_real place[1];\n  posture{suffix}(in, place);"
            yield f"  return {name}[(uint32_t)place[0]];\n}}\n"
            return
        if self._captures:
            raise _refused(self._scenario, "it reads a table by sample; a capture plans it anew")
        times = self._scenario.sample_time * np.arange(self._scenario.num_control_periods + 1)
        _, motion = self._motions[0]
        yield self._table_of(name, law.rows(motion.evaluate(times)[0]))
        yield f"{head}\n{{\n  return {name}[row_at(in->sample, NUM_{name})];\n}}\n"

    def _source_of(self, holds: bool) -> Any:
        """Where a function of a law reads."""

        def place(array: str, entry: int) -> str:
            if array == PLANNED:
                return f"planned[{entry}]"
            if array in ("memory", "gains"):
                own = self._laws[holds]
                sizes = {n: v.size for n, v in own.memory.items()}
                if array == "gains":
                    sizes = {n: values.size for n, (_, values) in own.gains.items()}
                name, at = _located(sizes, entry)
                field = _identifier(name) if array == "gains" else self._places[holds][name]
                return f"{'gains' if array == 'gains' else 'before'}->{field}[{at}]"
            name, at = self._in_place(array, entry)
            return f"in->{name}[{at}]"

        return place

    def _in_place(self, array: str, entry: int) -> tuple[str, int]:
        """The field of ``law_in`` with an entry of an input."""
        position, velocity = {
            "estimated_state": ("q", "v"), "desired_state": ("q_d", "v_d"),
            "desired_acceleration": ("a_d", ""), "applied_force": ("applied_force", ""),
            "measurement_is_new": ("is_new", ""),
        }.get(array, (array, ""))  # fmt: skip
        if velocity and entry >= self._nq:
            return velocity, entry - self._nq
        return position, entry

    def _target_of(self, holds: bool) -> Any:
        """Where a function of a law writes."""

        def place(array: str, entry: int) -> str:
            if array == "after":
                sizes = {name: value.size for name, value in self._laws[holds].memory.items()}
                name, at = _located(sizes, entry)
                return f"next->{self._places[holds][name]}[{at}]"
            return f"out->{array}[{entry}]"

        return place

    def _constant_gains(self) -> str:
        rows = [
            f"  {{{', '.join(map(self._precision.number, values.tolist()))}}}, /* {name} */"
            for name, (_, values) in self._law.gains.items()
        ]
        inner = "\n".join(rows or ["  0U"])
        return f"const law_gains LAW_GAINS = {{\n{inner}\n}};\n"

    def _limit_tables(self) -> Iterator[str]:
        """The tightest limits of positions and rates, of v's coordinates."""
        limits = joint_limits(self._scenario, make_plant(self._scenario.model))
        for name, quantity in (("POSITION", POSITION), ("RATE", RATE)):
            lower, upper = np.full(self._nv, -np.inf), np.full(self._nv, np.inf)
            for each in limits:
                if each.quantity == quantity:
                    lower, upper = np.maximum(lower, each.lower), np.minimum(upper, each.upper)
            for end, values in (("LEAST", lower), ("MOST", upper)):
                text = ", ".join(map(self._precision.number, values.tolist()))
                yield f"static const law_real {end}_{name}[LAW_NV] = {{{text}}};"
        yield ""

    def _table_of(self, name: str, rows: np.ndarray) -> str:
        texts = (", ".join(map(self._precision.number, row)) for row in rows.tolist())
        inner = "},\n  {".join(texts)
        count, size = rows.shape
        return (
            f"#define NUM_{name} {count}U\n"
            f"static const law_real {name}[NUM_{name}][{size}] = {{\n  {{{inner}}}\n}};\n"
        )

    def _reference_texts(self) -> Iterator[str]:
        """The function ``law_reference``."""
        if not self._motions:
            return
        calls = list[str]()
        for (field, _), found in zip(self._motions, self._references, strict=True):
            is_frame = field == "desired_frame"
            if is_frame and "desired_frame" not in self._reads:
                continue
            name = "FRAME" if is_frame else "REFERENCE"
            places = [(field, FRAME_SIZE)] if is_frame else self._row()
            if isinstance(found, np.ndarray):
                yield self._table_of(name, found)
                first = 0
                for own, size in places:
                    calls.append(
                        f"  copy(in->{own}, &{name}[row_at(sample, NUM_{name})][{first}], {size}U);"
                    )
                    first += size
            else:
                function = f"{name.lower()}_at"
                text = found.text(
                    f"law_real {TIME}, law_in *in", lambda *_: TIME, self._within(places)
                )
                yield text.replace("reference_at", function)
                calls.append(f"  {function}((law_real)sample * LAW_SAMPLE_TIME, in);")
        yield "void law_reference(uint32_t sample, law_in *in)"
        yield "{"
        yield from calls
        yield "  in->sample = sample;"
        yield "}"
        yield ""

    def _row(self) -> list[tuple[str, int]]:
        return [("q_d", self._nq), ("v_d", self._nv), ("a_d", self._nv)]

    @staticmethod
    def _within(places: list[tuple[str, int]]) -> Any:
        def place(_: str, entry: int) -> str:
            name, at = _located(dict(places), entry)
            return f"in->{name}[{at}]"

        return place

    def _start(self) -> Iterator[str]:
        yield "void law_start(law_state *state)"
        yield "{"
        yield "  (void)memset(state, 0, sizeof *state);"
        for holds, law in self._laws.items():
            for name, values in law.memory.items():
                for at, value in enumerate(values.ravel().tolist()):
                    if value != 0.0:
                        number = self._precision.number(value)
                        yield f"  state->{self._places[holds][name]}[{at}] = {number};"
        yield "}"
        yield ""

    def _checks(self) -> Iterator[str]:
        """The checks of inputs and results."""
        yield "static uint32_t causes_in(const law_in *in)"
        yield "{"
        yield "  uint32_t causes = 0U;"
        for bit, test in self._tests():
            yield f"  if (!({test})) {{"
            yield f"    causes |= {bit};"
            yield "  }"
        yield "  return causes;"
        yield "}"
        yield ""
        yield "static bool is_usable(const law_state *next, const law_out *out)"
        yield "{"
        tests = ["are_within(out->force, LAW_NV, LAW_LARGEST)"]
        fields = self._fields("state")
        tests += [f"are_finite(next->{name}, {size}U)" for name, size, _ in fields]
        joined = "\n    && ".join(tests)
        yield f"  return {joined};"
        yield "}"
        yield ""

    def _tests(self) -> Iterator[tuple[str, str]]:
        """Bit of ``law_out.causes``, and what holds for usable inputs."""
        yield (
            "LAW_BAD_MEASUREMENT",
            (
                "is_unit(in->q) && are_within(in->q, LAW_NQ, LAW_LARGEST) "
                "&& are_within(in->v, LAW_NV, LAW_FASTEST)"
            ),
        )
        yield (
            "LAW_BAD_REFERENCE",
            (
                "is_unit(in->q_d) && are_within(in->q_d, LAW_NQ, LAW_LARGEST) "
                "&& are_within(in->v_d, LAW_NV, LAW_LARGEST) "
                "&& are_within(in->a_d, LAW_NV, LAW_LARGEST)"
            ),
        )
        yield "LAW_BAD_FORCE", "are_within(in->applied_force, LAW_NV, LAW_LARGEST)"
        for name, size, _ in self._fields("in")[6:]:
            test = f"are_within(in->{name}, {size}U, LAW_LARGEST)"
            if name == "desired_frame":
                test = f"is_unit(in->{name}) && {test}"
            yield "LAW_BAD_OTHER", test


def _bytes(fields: list[Field], real: int, *, wholes: Mapping[str, str]) -> int:
    """The size of a struct of numbers and then of whole ones."""
    size = real * sum(each.size for each in fields) + 4 * len(wholes)
    return -(-size // real) * real


def _located(sizes: Mapping[str, int], entry: int) -> tuple[str, int]:
    """The array that has an entry, and its place there."""
    for name, size in sizes.items():
        if entry < size:
            return name, entry
        entry -= size
    raise IndexError(entry)


def _text(name: str) -> str:
    """A file of C that is the same for all laws."""
    return (Path(__file__).parent / "c" / name).read_text()


def _is_used(helper: str, text: str) -> bool:
    """Whether a helper function is called in a text."""
    name = helper.partition("(")[0].split()[-1]
    return f"{name}(" in text


def _identifier(name: str) -> str:
    """A name that C has."""
    found = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"{found}_" if found in _WORDS or found in _WHOLES["state"] else found


_RESUMED = "const law_gains *gains, const law_state *before, law_state *next"
_ANY = (
    "const law_in *in, const law_gains *gains, const law_state *before, law_state *next, "
    "law_out *out"
)
_SAMPLE = f"const law_real *planned, {_ANY}"
_MATRIX = "const law_real q[LAW_NQ], law_real H[LAW_NV][LAW_NV]"
_STRUCTS = {
    "in": "What a sample reads.",
    "gains": "Gains, by coordinate in the order of v or one for all.",
    "state": "Memory of the law. Set it with law_start; it is the caller's.",
    "out": "What a sample makes.",
}
_WHOLES: Mapping[str, Mapping[str, str]] = {
    "in": {
        "sample": "number of the control sample, from 0",
        "is_first": "1: forget what was a sample ago, as velocities jumped",
        "holds": "1: the target is held; read only if LAW_HAS_CAPTURE",
    },
    "gains": {},
    "state": {
        "has_started": "1: there was a good sample",
        "has_previous": "1: the last sample was good",
        "holds": "1: the last sample had the target",
        "bad": "bad samples in a row",
    },
    "out": {
        "status": "law_status",
        "causes": "bits LAW_BAD_...: why the sample was not good",
        "warnings": "bits: LAW_BEYOND_..., LAW_FORCE_LIMITED",
    },
}
_DECLARED = """extern const law_gains LAW_GAINS; /* as in the scenario */

/* Set the memory to that before the first sample. */
void law_start(law_state *state);
/* One control sample. A bad one leaves the law's memory as it was; the next good one is a first
   sample. */
law_status law_step(const law_in *in, const law_gains *gains, law_state *state, law_out *out);"""
_DECLARED_REFERENCE = """/* Set q_d, v_d, a_d (and desired_frame) and the number of a sample. */
void law_reference(uint32_t sample, law_in *in);"""
