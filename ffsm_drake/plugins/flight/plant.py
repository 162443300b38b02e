"""The plant of a scenario as an FMU: the compiled loop without its law, as C."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.apart import apart, reason_of
from ffsm_drake.plugins.compiled.blocks import COUNTS, laid
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.functions import functions_of, traced_function
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.flight.functions import Function, Precision
from ffsm_drake.plugins.flight.layout import numbers
from ffsm_drake.plugins.flight.source import file_text
from ffsm_drake.plugins.flight.traced import TIME, traced_motion
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape, number
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import Scenario
from ffsm_drake.scenario.contacts import closing_times
from ffsm_drake.systems.controllers import ControlLaw
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.reference import make_frame_motion
from ffsm_drake.systems.sensing.errors import SensorErrors

_DOUBLE = Precision(single=False)
_CELLS = "plant_cells *cells"
_ROUNDING = 1e-9  # relative, of what is affine in the payload's mass
# cells of ``derivative`` that are arguments
_ARGUMENTS = ("state", "t", "rates")


class _Outside(ControlLaw):
    """In place of the law, which is not in the plant."""

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        """See ControlLaw."""
        return 0.0 * sample.e, state


class Shown(NamedTuple):
    """Numbers of a sample that the FMU outputs: of a cell, from an entry on."""

    name: str
    cell: str
    first: int
    size: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantFiles:
    """The texts of an exported plant, and what is known of it."""

    header: str
    source: str
    shown: Sequence[Shown]
    has_payload: bool  # its mass can be changed
    has_seed: bool

    @classmethod
    def of(cls, scenario: Scenario, *, table: bool = False) -> "PlantFiles":
        """Export the plant of a scenario.

        Args: the scenario; whether the reference is a table, even if it is a polynomial.

        Raises FfsmError: the plant cannot be exported; the message names what prevents it.
        """
        if scenario.capture is not None:
            raise FfsmError("capture: a scenario with a capture cannot be an FMU; leave it out")
        if len(closing_times(scenario)) > 1:
            raise FfsmError(
                "contacts: hands that close later cannot be in an FMU; leave closes out"
            )
        try:
            return _Plant(scenario, table=table).files()
        except NotCovered as error:
            why = error.what
        except FfsmError:
            raise
        except Exception as error:  # a user's block may raise anything on symbols
            why = reason_of(error)
        raise FfsmError(f"the plant of this scenario cannot be exported as C: {why}")


class _Plant:
    """Writes the files."""

    def __init__(self, scenario: Scenario, *, table: bool) -> None:
        self._scenario, self._table = scenario, table
        self._mission = Mission(scenario)
        self._run = Run(self._mission, law=lambda setup: _Outside()).with_called_law("FMU")
        self._case = case = self._run.case
        for what, is_there in {
            "the supervisor": case.made.watch is not None,
            "sensing.detection": case.made.detector is not None,
            "blocks.reference": case.made.reference is not None,
        }.items():
            if is_there:
                raise NotCovered(what)
        self._blocks = blocks = self._run.blocks
        self._nq, self._nv = blocks.nq, blocks.nv
        self._last = scenario.num_control_periods
        self._rows = case.planned | {}
        errors = {"error": self._nv, "error_rate": self._nv}
        cells = blocks.parameters | blocks.states | blocks.results | blocks.row | COUNTS | errors
        self._sizes = {name: size for name, size in cells.items() if size}

    def files(self) -> PlantFiles:
        """The files. Raises what tracing raises."""
        is_own = self._run.key_on_disk is not None
        functions = self._functions() if is_own else apart(self._functions)
        start, has_payload = self._start()
        shown = list(self._shown())
        body = "\n".join((*self._reference(), *start, functions, self._move(), *self._show(shown)))
        return PlantFiles(
            header="\n".join(self._header(shown)) + "\n",
            source=file_text(body, "plant.h").replace("law_real", "double"),
            shown=shown,
            has_payload=has_payload,
            has_seed=self._scenario.faults is None,
        )

    def _header(self, shown: Sequence[Shown]) -> Iterator[str]:
        blocks = self._blocks
        yield "/* The plant of a closed loop: spacecraft, actuators, sensors, forces, reference. */"
        yield "#ifndef FFSM_PLANT_H\n#define FFSM_PLANT_H\n#include <math.h>\n#include <stdint.h>\n"
        yield f"#define PLANT_NV {self._nv}"
        yield f"#define PLANT_NUM_NOISE {blocks.row['noise']}"
        yield f"#define PLANT_NUM_DRIFTS {blocks.num_drifts}"
        yield f"#define PLANT_NUM_OUTPUTS {sum(each.size for each in shown)}"
        yield "\ntypedef struct {"
        yield from (f"  double {name}[{size}];" for name, size in self._sizes.items())
        yield "} plant_cells;\n"
        yield "/* Set the cells to the start, with a mass of the payload (kg). */"
        yield f"void plant_start(double payload_mass, {_CELLS});"
        yield "/* Set what a sample reads: reference, phases of sensors. */"
        yield f"void plant_row(uint32_t sample, {_CELLS});"
        yield f"void instants({_CELLS});"
        yield "/* What comes before the law in a sample, and after it; the motion to the next. */"
        yield f"void plant_sense({_CELLS});\nvoid plant_act({_CELLS});\nvoid plant_move({_CELLS});"
        yield "/* The outputs. */\nvoid plant_show(const plant_cells *cells, double *outputs);"
        yield "\n#endif"

    def _functions(self) -> str:
        """The traced functions."""
        found = list[str]()
        for name, made in functions_of(self._blocks, steps=self._run.steps, begins=True).items():
            traced = traced_function(self._blocks, made)
            arguments = _CELLS
            if name == "derivative":
                arguments = f"{_CELLS}, const double *state, const double *t, double *rates"
            function = Function(name, traced.tape, traced.results, _DOUBLE)
            found.append(function.text(arguments, _place, _place, local=name != "instants"))
        return "\n".join((*found, self._errors()))

    def _errors(self) -> str:
        """The tracking errors."""
        tape, nx = Tape(), self._nq + self._nv
        desired, measured = (inputs(tape, name, (nx,)) for name in ("reference", "measurement"))
        made = tracking_errors(desired, measured, self._nq)
        rows = {
            name: [number(one) for one in values.ravel()]
            for name, values in zip(("error", "error_rate"), made, strict=True)
        }
        return Function("tracking", tape, rows, _DOUBLE).text(_CELLS, _place, _place)

    def _move(self) -> str:
        """The functions that call the traced ones."""
        per_sample = self._blocks.per_sample
        lines = ["instants(cells);"]
        if per_sample > 1:
            part = self._run.steps // per_sample
            lines.append(f"if ((step % {part}U) == 0U) {{\n      touching(cells);\n    }}")
        for i in range(len(SCHEMES[self._blocks.scheme].times)):
            state = "x" if i == 0 else "y"
            lines.append(f"derivative(cells, cells->{state}, cells->t{i}, cells->k{i});")
            lines.append(f"point{i}(cells);")
        inner = "\n".join(f"    {line}" for line in lines)
        return f"""void plant_sense({_CELLS})
{{
  sensed(cells);
  tracking(cells);
}}

void plant_act({_CELLS})
{{
  acted(cells);
  judged(cells);
  carried(cells);
}}

void plant_move({_CELLS})
{{
  for (uint32_t step = 0U; step < {self._run.steps}U; ++step) {{
{inner}
  }}
}}
"""

    def _reference(self) -> Iterator[str]:
        """The function ``plant_row``."""
        calls, case = list[str](), self._case
        motions: dict[str, Any] = {"reference": case.motion}
        if "frame" in self._sizes:
            motions["frame"] = make_frame_motion(self._mission, case.nominal, case.motion)
        for name, motion in motions.items():
            function = None if self._table else _function_of(motion)
            if function is None:
                yield from self._row(name, calls)
                continue
            target = lambda _, at, cell=name: f"cells->{cell}[{at}]"  # noqa: E731
            text = function.text(f"double {TIME}, {_CELLS}", lambda *_: TIME, target)
            yield text.replace("row_of_motion", f"{name}_at")
            time = f"{_DOUBLE.number(self._scenario.sample_time)} * (double)sample"
            calls.append(f"{name}_at({time}, cells);")
        for name in {"phases", "request"} & self._sizes.keys():
            yield from self._row(name, calls)
        inner = "\n".join(f"  {call}" for call in calls)
        yield f"void plant_row(uint32_t sample, {_CELLS})\n{{\n{inner}\n}}\n"

    def _row(self, name: str, calls: list[str]) -> Iterator[str]:
        """A table by sample."""
        rows, size = self._rows[name][: self._last + 1], self._sizes[name]
        yield _constant(f"{name.upper()}[{len(rows)}][{size}]", rows)
        calls.append(f"copy(cells->{name}, {name.upper()}[row_at(sample, {len(rows)}U)], {size}U);")

    def _start(self) -> tuple[list[str], bool]:
        """The function ``plant_start``, and whether it is affine in the payload's mass."""
        mass = self._scenario.payload.truth.mass
        found, calls = list[str](), list[str]()
        first = self._numbers(self._case)
        slopes = self._slopes(mass, first)
        for name, values in first.items():
            upper, size = f"START_{name.upper()}", f"{values.size}"
            found.append(_constant(f"{upper}[{size}]", values))
            calls.append(f"copy(cells->{name}, {upper}, {size}U);")
            if slopes is not None and slopes[name].any():
                found.append(_constant(f"{upper}_PER_KG[{size}]", slopes[name]))
                calls.append(f"for (uint32_t i = 0U; i < {size}U; ++i) {{")
                calls.append(f"  cells->{name}[i] += change * {upper}_PER_KG[i];\n  }}")
        change = f"const double change = payload_mass - {_DOUBLE.number(mass)};"
        inner = "\n".join(f"  {line}" for line in (change, *calls, "(void)change;"))
        head = f"void plant_start(double payload_mass, {_CELLS})"
        return [*found, f"{head}\n{{\n{inner}\n}}\n"], slopes is not None

    def _slopes(self, mass: float, first: dict[str, np.ndarray]) -> dict[str, np.ndarray] | None:
        """What the cells begin with, per mass of the payload; None: that is not affine, or other
        masses are not possible.
        """
        try:
            second, third = (self._numbers(self._of_mass(k * mass)) for k in (2.0, 3.0))
        except FfsmError:
            return None
        found = dict[str, np.ndarray]()
        for name, values in first.items():
            with np.errstate(invalid="ignore"):  # infinite limits
                slope = np.where(second[name] == values, 0.0, (second[name] - values) / mass)
                error = third[name] - values - 2.0 * mass * slope
            bound = _ROUNDING * np.maximum(1.0, np.abs(values))
            if not ((third[name] == values) | (np.abs(error) <= bound)).all():
                return None
            found[name] = slope
        return found

    def _of_mass(self, mass: float) -> Case:
        return Case(self._mission.of(self._scenario.replace(payload={"truth": {"mass": mass}})))

    def _numbers(self, case: Case) -> dict[str, np.ndarray]:
        """What the cells begin with. Drift is that of one deviation."""
        drift = SensorErrors(
            self._scenario.sensing, self._run.coordinates, self._scenario.sample_time
        ).drift()
        values = self._run.parameters | case.parameters | case.states | {"drift": drift.start}
        return {name: np.ravel(values[name]) for name in values if name in self._sizes}

    def _shown(self) -> Iterator[Shown]:
        """The outputs, in their order."""
        nq, nv = self._nq, self._nv
        for name, cell in (("", "known"), ("measured_", "measurement"), ("desired_", "reference")):
            yield Shown(f"{name}position", cell, 0, nq)
            yield Shown(f"{name}velocity", cell, nq, nv)
        yield Shown("desired_acceleration", "reference", nq + nv, nv)
        yield Shown("error", "error", 0, nv)
        yield Shown("error_rate", "error_rate", 0, nv)
        yield Shown("applied_force", "applied", 0, nv)
        is_new = "is_new" if "is_new" in self._sizes else ""
        yield Shown("is_new", is_new, 0, nq + nv)
        if "frame" in self._sizes:
            yield Shown("desired_frame", "frame", 0, FRAME_SIZE)
        places = laid("shown_last", self._blocks.shown_last)
        if "measured_wrench" in places:
            yield Shown("measured_wrench", *places["measured_wrench"])

    def _show(self, shown: Sequence[Shown]) -> Iterator[str]:
        """The function ``plant_show``."""
        yield "void plant_show(const plant_cells *cells, double *outputs)\n{"
        first = 0
        for each in shown:
            if each.cell:
                yield f"  copy(&outputs[{first}], &cells->{each.cell}[{each.first}], {each.size}U);"
            else:
                yield f"  for (uint32_t i = 0U; i < {each.size}U; ++i) {{"
                yield f"    outputs[{first} + i] = 1.0;\n  }}"
            first += each.size
        yield "}\n"


def _function_of(motion: Any) -> Function | None:
    """A motion as a function of time; None: it cannot be traced."""
    try:
        return traced_motion(motion, _DOUBLE)
    except Exception:  # NumPy raises many kinds on symbols
        return None


def _place(array: str, entry: int) -> str:
    return f"{array}[{entry}]" if array in _ARGUMENTS else f"cells->{array}[{entry}]"


def _constant(declared: str, values: np.ndarray) -> str:
    if values.ndim == 1:
        return f"static const double {declared} = {{{numbers(values, _DOUBLE)}}};"
    inner = "},\n  {".join(numbers(row, _DOUBLE) for row in values)
    return f"static const double {declared} = {{\n  {{{inner}}}\n}};\n"
