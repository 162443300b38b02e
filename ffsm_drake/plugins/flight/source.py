"""The code of an exported law."""

from collections.abc import Iterator, Mapping

import numpy as np

from ffsm_drake.plugins.flight.functions import Function, Place
from ffsm_drake.plugins.flight.header import MATRIX, static_text
from ffsm_drake.plugins.flight.layout import WITHOUT, Layout, located, numbers
from ffsm_drake.plugins.flight.traced import PLANNED, TIME, FlightLaw
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.spacecraft.limits import POSITION, RATE
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.mission_limits import joint_limits

_RESUMED = "const law_gains *gains, const law_state *before, law_state *next"
_ANY = f"const law_in *in, {_RESUMED}, law_out *out"
_GIVEN = "in, gains, before, next, out"
References = Mapping[str, Function | np.ndarray]  # field of ``law_in`` -> function or table


def source_text(
    layout: Layout,
    samples: Mapping[bool, tuple[Function, Function]],
    references: References,
    *,
    header: str,
) -> str:
    """The code.

    Args:
      layout: the structs.
      samples: the first sample and the others, by whether the target is held.
      references: the motion ``q_d`` and the path ``desired_frame``, as far as the law has them.
      header: its file name.

    Raises what the law raises on symbols.
    """
    body = "\n".join(_body(layout, samples, references))
    return file_text(body, header)


def file_text(body: str, header: str) -> str:
    """A file of C functions after its header, and the helper functions that they call."""
    includes = [f'#include "{header}"', ""]
    includes += [f"#include <{name}.h>" for name in ("math", "stdbool", "string")]
    includes += ["", "#if defined(__clang__) /* GCC: -ffp-contract=off, or -std=c99 */"]
    includes += ["#pragma STDC FP_CONTRACT OFF", "#endif"]
    functions = "\n".join(map(static_text, ("angles.c", "helpers.c"))).split("\n\n")
    used = (each for each in functions if f"{each.partition('(')[0].split()[-1]}(" in body)
    return "\n".join((*includes, "", "\n\n".join(used), body)) + "\n"


def _body(
    layout: Layout, samples: Mapping[bool, tuple[Function, Function]], references: References
) -> Iterator[str]:
    yield _constant_gains(layout)
    yield from _limits(layout)
    for holds, (first, other) in samples.items():
        yield from _sample(layout, layout.laws[holds], first, other, references)
    if layout.captures:
        for holds, law in layout.laws.items():
            function = law.resumed(layout.laws[not holds], layout.precision)
            source, target = layout.source(holds=not holds), layout.target(holds=holds)
            yield function.text(f"const law_in *in, {_RESUMED}", source, target)
    for law in layout.laws.values():
        function = law.mass_matrix(layout.precision)
        matrix = lambda _, at: f"H[{at // layout.nv}][{at % layout.nv}]"  # noqa: E731
        text = function.text(MATRIX, lambda _, at: f"q[{at}]", matrix, local=False)
        yield text.replace("void mass_matrix", "void law_mass_matrix")
    yield from _references(layout, references)
    yield from _start(layout)
    yield from _checks(layout)
    yield static_text("step.c")


def _constant_gains(layout: Layout) -> str:
    values = [given for _, given in layout.law.gains.values()]
    rows = [
        f"  {{{numbers(given, layout.precision)}}}, /* {field.name} */"
        for field, given in zip(layout.fields["gains"], values, strict=True)
    ]
    inner = "\n".join(rows or ["  0U"])
    return f"const law_gains LAW_GAINS = {{\n{inner}\n}};\n"


def _limits(layout: Layout) -> Iterator[str]:
    """The tightest limits of positions and rates, by coordinate of v."""
    limits = joint_limits(layout.law.mission)
    for name, quantity in (("POSITION", POSITION), ("RATE", RATE)):
        least, most = np.full(layout.nv, -np.inf), np.full(layout.nv, np.inf)
        for each in limits:
            if each.quantity == quantity:
                least, most = np.maximum(least, each.lower), np.minimum(most, each.upper)
        has_limits = np.isfinite([least, most]).any()
        yield f"#define HAS_{name}_LIMITS {int(has_limits)}"
        for end, values in (("LEAST", least), ("MOST", most)) if has_limits else ():
            given = numbers(values, layout.precision)
            yield f"static const law_real {end}_{name}[LAW_NV] = {{{given}}};"
    limit, resolution = layout.law.actuation
    changes = bool(np.isfinite(limit).any() or resolution.any())
    yield f"#define CHANGES_FORCE {int(changes)}\n"


def _sample(
    layout: Layout, law: FlightLaw, first: Function, other: Function, references: References
) -> Iterator[str]:
    """The functions of a sample, with what they read by sample."""
    holds, planned = law.grip.holds, "NULL"
    suffix = "" if holds else WITHOUT
    if PLANNED in layout.reads:
        planned = f"planned_at{suffix}(in)"
        yield from _planned(layout, law, suffix, references)
    arguments = f"const law_real *planned, {_ANY}"
    source, target = layout.source(holds=holds), layout.target(holds=holds)
    at_first, later = (each.text(arguments, source, target) for each in (first, other))
    yield later
    chosen = f"  (void)is_first;\n  sample{suffix}(planned, {_GIVEN});\n"
    if at_first.replace(f"first_sample{suffix}(", f"sample{suffix}(") != later:
        yield at_first
        chosen = f"""  if (is_first) {{
    first_sample{suffix}(planned, {_GIVEN});
  }} else {{
    sample{suffix}(planned, {_GIVEN});
  }}
"""
    head = f"static void any_sample{suffix}(bool is_first, {_ANY})"
    yield f"{head}\n{{\n  const law_real *planned = {planned};\n{chosen}}}\n"


def _planned(layout: Layout, law: FlightLaw, suffix: str, references: References) -> Iterator[str]:
    """The function that finds the numbers that the law reads at a sample, with their table."""
    name = f"PLANNED{suffix.upper()}"
    head = f"static const law_real *planned_at{suffix}(const law_in *in)\n{{"
    if (found := law.postures(layout.precision)) is not None:
        rows, function = found
        yield _table(layout, name, rows)
        source = layout.source(holds=law.grip.holds)
        yield function.text("const law_in *in, law_real *place", source, _entry)
        yield f"{head}\n  law_real place[1];\n  posture{suffix}(in, place);"
        yield f"  return {name}[(uint32_t)place[0]];\n}}\n"
        return
    if not references:
        raise NotTraceable("it reads a table by sample, which a capture plans anew")
    yield _table(layout, name, law.rows_by_sample())
    yield f"{head}\n  return {name}[row_at(in->sample, NUM_{name})];\n}}\n"


def _entry(array: str, at: int) -> str:
    return f"{array}[{at}]"


def _table(layout: Layout, name: str, rows: np.ndarray) -> str:
    count, size = rows.shape
    inner = "},\n  {".join(numbers(row, layout.precision) for row in rows)
    declared = f"static const law_real {name}[NUM_{name}][{size}]"
    return f"#define NUM_{name} {count}U\n{declared} = {{\n  {{{inner}}}\n}};\n"


def _place_in_input(sizes: Mapping[str, int]) -> Place:
    """The text of the entry of an input, by its number in the arrays of ``sizes`` in a row."""
    return lambda _, entry: "in->{}[{}]".format(*located(sizes, entry))


def _references(layout: Layout, references: References) -> Iterator[str]:
    """The function ``law_reference``, with what it reads and calls."""
    calls = list[str]()
    for field, found in references.items():
        name, places = "FRAME", {field: FRAME_SIZE}
        if field == "q_d":
            name = "REFERENCE"
            places = {"q_d": layout.nq, "v_d": layout.nv, "a_d": layout.nv}
        if isinstance(found, Function):
            arguments = f"law_real {TIME}, law_in *in"
            text = found.text(arguments, lambda *_: TIME, _place_in_input(places))
            yield text.replace("row_of_motion", f"{name.lower()}_at")
            calls.append(f"{name.lower()}_at((law_real)sample * LAW_SAMPLE_TIME, in);")
            continue
        yield _table(layout, name, found)
        first = 0
        for own, size in places.items():
            row = f"&{name}[row_at(sample, NUM_{name})][{first}]"
            calls.append(f"copy(in->{own}, {row}, {size}U);")
            first += size
    if references:
        inner = "\n".join(f"  {call}" for call in (*calls, "in->sample = sample;"))
        yield f"void law_reference(uint32_t sample, law_in *in)\n{{\n{inner}\n}}\n"


def _start(layout: Layout) -> Iterator[str]:
    yield "void law_start(law_state *state)\n{"
    yield "  (void)memset(state, 0, sizeof *state);"
    for holds, law in layout.laws.items():
        values = _memory(law)
        for at in np.flatnonzero(values).tolist():
            place, number = layout.memory_at(at, holds=holds), layout.precision.number(values[at])
            yield f"  state->{place} = {number};"
    yield "}\n"


def _memory(law: FlightLaw) -> np.ndarray:
    """All numbers of a law's memory at its start."""
    return np.concatenate([np.zeros(0), *map(np.ravel, law.memory.values())])


def _checks(layout: Layout) -> Iterator[str]:
    """The checks of inputs and results."""
    yield "static uint32_t causes_in(const law_in *in)\n{"
    yield "  uint32_t causes = 0U;"
    for field in layout.fields["in"]:
        most = "LAW_FASTEST" if field.name == "v" else "LAW_LARGEST"
        test = f"are_within(in->{field.name}, {field.size}U, {most})"
        if field.name in ("q", "q_d", "desired_frame"):
            test = f"is_unit(in->{field.name}) && {test}"
        bit = _CAUSES.get(field.name, "LAW_BAD_OTHER")
        yield f"  if (!({test})) {{\n    causes |= {bit};\n  }}"
    yield "  return causes;\n}\n"
    infinite = {
        layout.memory_at(at, holds=holds).partition("[")[0]
        for holds, law in layout.laws.items()
        for at in np.flatnonzero(~np.isfinite(_memory(law))).tolist()
    }
    counts = [
        "number_beyond(out->force, LAW_NV, LAW_LARGEST)",
        "number_not_finite(out->commanded, LAW_NV)",
        *(
            f"number_not_finite(next->{name}, {size}U)"
            if name not in infinite
            else f"number_changed(next->{name}, before->{name}, {size}U)"
            for name, size, _ in layout.fields["state"]
        ),
    ]
    arguments = "const law_state *before, const law_state *next, const law_out *out"
    yield f"static bool is_usable({arguments})\n{{\n  uint32_t unusable = 0U;\n  (void)before;"
    yield from (f"  unusable += {each};" for each in counts)
    yield "  return unusable == 0U;\n}\n"


_CAUSES = {
    **dict.fromkeys(("q", "v"), "LAW_BAD_MEASUREMENT"),
    **dict.fromkeys(("q_d", "v_d", "a_d"), "LAW_BAD_REFERENCE"),
    "applied_force": "LAW_BAD_FORCE",
}
