"""A control law as traced functions: its sample, its first one, and how it goes on after a grasp.

The law is the very object of the scenario, with symbols in place of its gains. Its other numbers,
such as nominal mass properties, are constants.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.mission import Mission, make_mission
from ffsm_drake.plugins.compiled.models import traced_model
from ffsm_drake.plugins.compiled.parameters import (
    parameters_of,
    reader_of,
    rows_of,
    with_symbols,
)
from ffsm_drake.plugins.compiled.parts import at_start, sizes_of
from ffsm_drake.plugins.compiled.stepping import joined, parted, stepped
from ffsm_drake.plugins.equations import equations
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.flight.functions import Function, Precision
from ffsm_drake.plugins.tape.arrays import inputs, traced
from ffsm_drake.plugins.tape.numbers import NotTraceable, Symbol, Tape, none_caught, number
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers import SampledController, make_controller
from ffsm_drake.systems.controllers.law import Gain, gains_of
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.reference import make_frame_motion, make_motion, prescribes_frame
from ffsm_drake.systems.sampled import Now

TIME = "time"  # the input of a traced motion
PLANNED = "planned"  # that of a sample with the numbers that a law reads by sample


class FlightLaw:
    """A control law with one nominal model of the spacecraft."""

    def __init__(self, given: Scenario | Mission, grip: Grip) -> None:
        """Args: the scenario, or its mission; what holds the target.

        Raises FfsmError: the controller is a Drake system, or has a field of an unknown kind.
        """
        self.mission = mission = make_mission(given)
        self.scenario, self.grip = mission.scenario, grip
        self.nominal: PlantModel = mission.craft.nominal(grip)
        controller = make_controller(mission, self.nominal)
        if not isinstance(controller, SampledController):
            raise FfsmError(f"{self.scenario.controller} is a Drake system, not a control law")
        self.controller, self.law = controller, controller.law
        self.coordinates = self.nominal.coordinates
        self._block = LawBlock(self.law, self.coordinates)
        self.memory = at_start(self._block)
        self._parameters = parameters_of(self.law)

    @property
    def inputs(self) -> dict[str, int]:
        """Numbers in each input of a sample."""
        planned = self._parameters.num_planned
        return {**self._block.inputs, **({PLANNED: planned} if planned else {})}

    @property
    def times(self) -> np.ndarray:
        """The control samples of a run (n), s."""
        return self.scenario.sample_time * np.arange(self.scenario.num_control_periods + 1)

    def motions(self) -> dict[str, PlannedMotion]:
        """The planned motion, and the path of a frame if one is prescribed, by the fields of
        ``law_in`` that they begin with.
        """
        motion = make_motion(self.mission, self.grip)
        path = make_frame_motion(self.mission, self.nominal, motion)
        return {"q_d": motion} | ({} if path is None else {"desired_frame": path})

    def rows_by_sample(self) -> np.ndarray:
        """The numbers that the law reads by sample (n, m)."""
        return rows_of(self.law, self.motions()["q_d"].evaluate(self.times)[0])

    def postures(self, precision: Precision) -> tuple[np.ndarray, Function] | None:
        """Rows (n, m) of the numbers that the law reads by sample, and the ``place`` of the row for
        a ``desired_state``; None: the number of the sample decides.
        """
        parts = [part for part in _parts_of(self.law) if getattr(type(part), "by_sample", ())]
        if len(parts) != 1 or not hasattr(parts[0], "nearest"):
            return None
        (part,), tape = parts, Tape()
        desired = inputs(tape, "desired_state", (self._block.inputs["desired_state"],))
        place = part.nearest(desired[: self.coordinates.num_positions])
        rows = np.hstack(
            [getattr(part, name).reshape(len(part.gain), -1) for name in part.by_sample]
        )
        return rows, self._function("posture", tape, {"place": [place]}, precision)

    @property
    def gains(self) -> dict[str, tuple[Gain, np.ndarray]]:
        """The gains by name: as declared, and their values."""
        return {
            name: (declared, np.atleast_1d(np.asarray(value, float)))
            for name, declared, value in _gains_in(self.law)
        }

    def sample(self, precision: Precision, *, is_first: bool) -> Function:
        """A sample: from the inputs, ``gains`` and ``memory`` to ``commanded``, the law's force,
        ``force``, that after limits and quantisation, and the memory ``after`` it.

        Raises what the law raises on symbols.
        """
        tape = Tape()
        law = self._with_symbols(tape)
        block = LawBlock(law, self.coordinates, errors=tracking_errors)
        given = {name: inputs(tape, name, (size,)) for name, size in block.inputs.items()}
        if not prescribes_frame(self.scenario):
            given.pop("desired_frame", None)
        memory, _ = parted(self._input(tape, "memory", self.memory), self.memory)
        now = Now(0.0, is_first=is_first)
        outputs, after = stepped(block, block.outputs, given, memory, now)
        commanded = outputs["generalized_force"]
        rows = {
            "commanded": commanded,
            "force": self._limited(commanded),
            "after": joined(after[name] for name in memory),
        }
        name = "first_sample" if is_first else "sample"
        return self._function(name, tape, rows, precision)

    def resumed(self, before: "FlightLaw", precision: Precision) -> Function:
        """How it goes on after another law: from the other's ``memory`` and the reference
        ``desired_state`` to the memory ``after``.
        """
        tape = Tape()
        theirs, _ = parted(self._input(tape, "memory", before.memory), before.memory)
        alike = {
            name: theirs[name] if _is_like(theirs.get(name), first) else traced(first)
            for name, first in self.memory.items()
        }
        own, other = self._with_symbols(tape), before._with_symbols(tape)
        reference = inputs(tape, "desired_state", (self._block.inputs["desired_state"],))
        with none_caught():
            after = own.resume(alike, other, reference)
        row = joined(traced(after[name]) for name in self.memory)
        return self._function("resumed", tape, {"after": row}, precision)

    def mass_matrix(self, precision: Precision) -> Function:
        """The mass matrix ``H`` (nv nv) of the nominal model at a configuration ``q`` (nq)."""
        tape, reader = Tape(), reader_of(self.nominal)
        own = traced(reader.parameters(self.nominal.context).tolist())
        q = inputs(tape, "q", (self.coordinates.num_positions,))
        rows = traced(equations.mass_matrix(reader.tree, q, own))
        return self._function("mass_matrix", tape, {"H": rows}, precision)

    def _function(
        self, name: str, tape: Tape, rows: Mapping[str, Any], precision: Precision
    ) -> Function:
        suffix = "" if self.grip.holds else "_without_target"
        return Function(name + suffix, tape, _plain(tape, rows), precision)

    @staticmethod
    def _input(tape: Tape, name: str, shapes: Mapping[str, np.ndarray]) -> Any:
        return inputs(tape, name, (sum(sizes_of(shapes).values()),))

    def _with_symbols(self, tape: Tape) -> Any:
        """The law with symbols as its gains, and numbers as all else."""
        count, planned = self._parameters.values.size, self._parameters.num_planned
        by_sample = inputs(tape, PLANNED, (planned,))
        numbers = traced(self._parameters.values.tolist())
        gains = self._input(tape, "gains", {name: value for name, (_, value) in self.gains.items()})
        # a law with places in place of its parameters tells where the gains are
        places = with_symbols(self.law, np.arange(float(count)), by_sample, _same)
        found = [np.ravel(value) for _, _, value in _gains_in(places)]
        for symbol, place in zip(gains, np.concatenate([[], *found]).astype(int), strict=True):
            numbers[place] = symbol
        return with_symbols(self.law, numbers, by_sample, traced_model)

    @property
    def actuation(self) -> tuple[np.ndarray, np.ndarray]:
        """Limits (nv; infinite: none) and resolutions (nv; zero: none) of the force, N m and N."""
        settings = self.scenario.actuation
        given = ((settings.limit, np.inf), (settings.quantization, 0.0))
        limit, resolution = (
            self.coordinates.vector(values or {}, key="actuation", default=default)
            for values, default in given
        )
        return limit, resolution

    def _limited(self, force: Any) -> Any:
        """A force after limits and quantisation (``actuation``), as in the loop."""
        limit, resolution = self.actuation
        if np.isfinite(limit).any():
            force = np.minimum(np.maximum(force, -limit), limit)
        return quantize(force, resolution) if resolution.any() else force


def traced_motion(motion: PlannedMotion, precision: Precision) -> Function:
    """The ``row`` of a motion at a ``time``. Raises what it raises on symbols."""
    tape = Tape()
    with none_caught():
        row = motion.rows(inputs(tape, TIME, (1,)))[0]
    return Function("row_of_motion", tape, _plain(tape, {"row": row}), precision)


def _parts_of(law: Any) -> Iterator[Any]:
    """A law and what it consists of."""
    if dataclasses.is_dataclass(law) and not isinstance(law, PlantModel):
        yield law
        for field in dataclasses.fields(law):
            yield from _parts_of(getattr(law, field.name))


def _gains_in(law: Any) -> Iterator[tuple[str, Gain, Any]]:
    """The gains of a law and of what it consists of: name, declaration and value. One whose name
    is known has its part's name before it.
    """
    known = set[str]()
    for part in _parts_of(law):
        for name, declared in gains_of(type(part)).items():
            own = f"{type(part).__name__}_{name}" if name in known else name
            known.add(own)
            yield own, declared, getattr(part, name)


def core_of(law: Any) -> Any:
    """What a law is without filters and estimators: the last of its parts with gains."""
    return next((part for part in reversed([*_parts_of(law)]) if gains_of(type(part))), law)


def _plain(tape: Tape, rows: Mapping[str, Any]) -> dict[str, list[Symbol | float]]:
    """Symbols and numbers, a row for each array. Raises NotTraceable: others."""
    found = {
        name: [number(one) for one in np.asarray(row, dtype=object).ravel()]
        for name, row in rows.items()
    }
    for row in found.values():
        for one in row:
            if one is NotImplemented:
                raise NotTraceable("a result that is no number")
            tape.place_of(one)
    return found


def _is_like(value: Any, first: np.ndarray) -> bool:
    return value is not None and np.shape(value) == first.shape


_same: Callable[[Any, Any], Any] = lambda model, own: model  # noqa: E731
