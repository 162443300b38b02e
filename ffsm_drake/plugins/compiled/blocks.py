"""The blocks of a compiled loop, and the cells of numbers that they read and make.

Everything that the code depends on stands in ``Blocks``; all else is an input.
"""

import dataclasses
import functools
import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ffsm_drake.loop.blocks import usual_sizes
from ffsm_drake.plugins.compiled.parts import (
    STEPPING,
    Parts,
    at_start,
    cell_of,
    sizes_of,
    total,
)
from ffsm_drake.plugins.compiled.schemes import SCHEMES
from ffsm_drake.plugins.compiled.supervising import Watch
from ffsm_drake.plugins.equations.tree import Tree
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.controllers.controller import LAW_SIGNALS
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.sampled import Sampled, sized

# States that a sample changes, and the cells that have them then.
CARRIED = {
    "memory": "memory_after",
    "drift": "drift_after",
    "stored": "stored_after",
    "loaded": "loaded_after",
    "held_before": "held_after",
    "watched": "watched_after",
    "commanded": "commanded_after",
    "waiting": "waiting_after",
    "applied": "told",
    "requested": "requested_after",
    "corrected": "corrected_after",
}
# Single numbers of a run: of the sample and of the step in it; the sample that is a first one for
# the law; whether the run has left its bound, or has a number that is not finite; samples with an
# action of the law before that; and when it was seen last, s.
COUNTS = dict.fromkeys(("number", "j", "first_at", "lost", "acted_on", "seen_at"), 1)
# Signals of a record that a sample makes, and the cells that have them.
_SAMPLED = {
    "state": "known",
    "hidden_state": "hidden",
    "measurement": "measurement",
    "generalized_force": "generalized_force",
    "applied_force": "applied_force",
    "disturbance_force": "disturbance_force",
    "fault_detected": "detected",
    "external_hidden_force": "hidden_push",
}
_FORCES = ("generalized_force", "hidden_force")  # of a force, which are summed
# Inputs of the law and of a detector: the cells that have them at a call.
_READ = {"estimated_state": "measurement", "applied_force": "applied", "desired_frame": "frame"}
_LOOKED_AT = {"state": "measurement", "told_force": "applied", "gyroscopic_force": "gyroscopic"}
_DETECTED = {"estimated_state": "measurement", "fault_detected": "detected"}
_REQUEST = {"abort_request": "requested_after"}
_IS_NEW = {"measurement_is_new": "is_new"}

Places = dict[str, tuple[str, int, int]]  # name -> cell at a sample, first entry there, and size


class Placed(NamedTuple):
    """A sampled block of a loop."""

    kind: str
    name: str
    block: Sampled
    cell: str  # state with its memory
    first: int  # of the numbers there
    phases: slice  # in the row of a sample


@dataclasses.dataclass(frozen=True, kw_only=True)
class Structure:
    """What the code depends on in addition to the blocks."""

    tree: Tree  # of the spacecraft
    # entries of the plant's [q; v] that are known, and of hidden coordinates; of its v, known ones
    known: tuple[int, ...]
    hidden: tuple[int, ...]
    forced: tuple[int, ...]
    loose: tuple[int, ...]  # of its v, hidden ones
    coordinates: Coordinates
    recorded: tuple[str, ...]  # outputs of actuators, flows, and forces that do not step once
    num_numbers: int  # parameters of the parts
    noisy: bool
    num_drifts: int  # errors of the sensors that drift
    framed: bool  # the path of a frame is prescribed
    limited: bool
    quantized: bool  # the force
    waits: int  # samples from a force to its effect
    limp: bool  # a constant force acts on the joints, not the actuators'
    hands: bool  # more than one holds the target, in this phase or in a later one
    scheme: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Blocks(Structure):
    """The blocks of a loop, as far as the code depends on them."""

    law: ControlLaw
    num_parameters: int  # of the law
    num_planned: int  # numbers of the law that differ between samples, see ``rows_of``
    parts: Parts
    watch: Watch | None  # the block of the supervisor
    detector: Sampled | None  # a last stage of sensing that is called
    called: str = ""  # why the law is called at each sample; empty: it is traced

    @property
    def calls(self) -> bool:
        """Whether a sample calls the law or a detector."""
        return bool(self.called) or self.detector is not None

    @property
    def nq(self) -> int:
        """Number of known positions."""
        return len(self.coordinates.position_names)

    @property
    def nv(self) -> int:
        """Number of known velocities."""
        return len(self.coordinates.names)

    @functools.cached_property
    def memory(self) -> dict[str, np.ndarray]:
        """The law's memory at its start."""
        return {name: np.asarray(v, float) for name, v in self.law.initial_state().items()}

    @functools.cached_property
    def acted(self) -> dict[str, int]:
        """Outputs of actuators beside the force, by name: numbers in each."""
        sizes = [sized(each.outputs, {}, "actuation") for each in self.parts.actuation.values()]
        return {name: n for of in sizes for name, n in [*of.items()][1:]}

    @functools.cached_property
    def flown(self) -> dict[str, int]:
        """Outputs of the flows, likewise."""
        return {n: size for each in self.parts.flows.values() for n, size in each.outputs.items()}

    @functools.cached_property
    def shown_last(self) -> dict[str, int]:
        """Outputs of last forces beside the force, likewise."""
        found = {n: size for of in self.parts.last.values() for n, size in of.outputs.items()}
        return {n: size for n, size in found.items() if n not in _FORCES}

    @functools.cached_property
    def fast(self) -> dict[str, Sampled]:
        """The forces that step several times in a sample, or never."""
        return {name: each for name, each in self.parts.forces.items() if each.per_sample != 1}

    @functools.cached_property
    def touches(self) -> dict[str, dict[str, np.ndarray]]:
        """Their outputs, of zero."""
        return {name: outputs_of(each, self.coordinates) for name, each in self.fast.items()}

    @property
    def has_slow(self) -> bool:
        """Whether a force steps once in a sample."""
        return len(self.fast) < len(self.parts.forces)

    @property
    def per_sample(self) -> int:
        """Steps of forces in a sample."""
        return max((each.per_sample for each in self.fast.values()), default=1) or 1

    @property
    def late(self) -> frozenset[str]:
        """Signals of forces that step several times: at a sample as they were before it."""
        several = [each for each in self.fast.values() if each.per_sample]
        return frozenset(name for each in several for name in each.outputs) & {*self.recorded}

    @functools.cached_property
    def sampled(self) -> list[Placed]:
        """The sampled blocks."""
        found, phase, firsts = list[Placed](), 0, dict.fromkeys((*STEPPING.values(), "touched"), 0)
        for kind, blocks in self.parts.stepping.items():
            for name, block in blocks.items():
                cell = cell_of(kind, block)
                phases = slice(phase, phase + len(block.phase(0)))
                found.append(Placed(kind, name, block, cell, firsts[cell], phases))
                phase, firsts[cell] = phases.stop, firsts[cell] + total(at_start(block))
        return found

    @property
    def corrects(self) -> dict[str, int]:
        """The last forces with a correction, which a sample makes: numbers in each."""
        of = self.parts.last.items()
        sizes = {name: each.inputs.get("correction", 0) for name, each in of}
        return {name: size for name, size in sizes.items() if size}

    @property
    def held(self) -> dict[str, int]:
        """What acts from one sample to the next."""
        push = self.nv + len(self.loose) if self.has_slow else 0
        return {"applied_force": self.nv, "push": push, "acted": sum(self.acted.values())}

    @property
    def keeps(self) -> bool:
        """Whether a last force or a detector reads what was held before a sample."""
        return bool(self.parts.last or self.gyrates or self.hands)

    @property
    def pushes_hidden(self) -> bool:
        """Whether a force acts on hidden coordinates."""
        outputs = [each.outputs for each in self.parts.forces.values()]
        outputs += [each.outputs for each in self.parts.last.values()]
        return any("hidden_force" in names for names in outputs)

    @property
    def tells_new(self) -> bool:
        """Whether a stage of sensing tells which measurements are new."""
        return any("measurement_is_new" in of.outputs for of in self.parts.sensing.values())

    @property
    def gyrates(self) -> bool:
        """Whether the detector reads the force of flywheels."""
        return self.detector is not None and "gyroscopic_force" in self.detector.inputs

    @property
    def external(self) -> tuple[str, ...]:
        """Names of the forces beside the disturbance."""
        return (*self.parts.forces, *self.parts.last)

    def found(self, name: str) -> int:
        """Numbers in an output of the detector."""
        return self._detector_sizes.get(name, 0)

    @property
    def parameters(self) -> dict[str, int]:
        """Numbers that a leg begins with and keeps. At a grasp they change: ``own`` is read from a
        plant with another payload, blocks have ``with_payload``, and limp joints ``joint_force``.
        """
        nx, nv = self.nq + self.nv, self.nv
        return {
            "own": self.tree.num_parameters, "law": self.num_parameters,
            "parts": self.num_numbers, "deviation": nx, "limit": nv,
            "force_resolution": nv, "sines": 4 * nv, "share": self.num_drifts,
            "added": self.num_drifts, "sample_time": 1, "step": 1,
            "bound": 1, "joint_force": nv - NUM_BASE_VELOCITIES if self.limp else 0,
            "law_at_start": 0 if self.watch is None else total(self.memory),
        }  # fmt: skip

    @property
    def states(self) -> dict[str, int]:
        """Numbers that a run begins with and changes."""
        kept = dict.fromkeys((*STEPPING.values(), "touched"), 0)
        for each in self.sampled:
            kept[each.cell] = each.first + total(at_start(each.block))
        flowing = sum(total(at_start(each)) for each in self.parts.flows.values())
        watched = self.watch is not None
        return {
            "x": len(self.known) + len(self.hidden) + flowing,
            "memory": total(self.memory), "applied": self.nv, "drift": self.num_drifts,
            "waiting": self.waits * self.nv, **kept,
            "touch": sum(map(total, self.touches.values())),
            "held_before": sum(self.held.values()) if self.keeps else 0,
            "commanded": watched * self.nv, "requested": watched * self.found("abort_request"),
            "corrected": sum(self.corrects.values()),
        }  # fmt: skip

    @property
    def results(self) -> dict[str, int]:
        """What a sample makes, and room for a step of the integrator."""
        nx, nv, states = self.nq + self.nv, self.nv, self.states
        stages, forces = range(len(SCHEMES[self.scheme].times)), len(self.external)
        watching = (
            {}
            if self.watch is None
            else {"mode": 2, "asks": 1, "followed": sum(self.desired.values())}
        )
        watching |= {"given": nv} if watching else {}
        return {
            "is_new": nx if self.calls and self.tells_new else 0,
            "known": nx, "hidden": len(self.hidden), "measurement": nx, "generalized_force": nv,
            "applied_force": nv,
            "disturbance_force": nv, "each_force": (1 + forces) * nv if forces else 0,
            "detected": self.found("fault_detected"),
            "gyroscopic": self.nv if self.gyrates else 0,
            "push": self.held["push"], **watching, "shown_last": sum(self.shown_last.values()),
            "hidden_push": len(self.loose) if self.pushes_hidden else 0,
            "acted": sum(self.acted.values()), "flown": sum(self.flown.values()), "y": states["x"],
            **{cell: states[name] for name, cell in CARRIED.items()}, "is_first": 1,
            **{f"k{i}": states["x"] for i in stages}, **{f"t{i}": 1 for i in stages},
        }  # fmt: skip

    @property
    def row(self) -> dict[str, int]:
        """What a run reads at each sample."""
        return {
            "reference": self.nq + 2 * self.nv,
            "noise": self.nq + self.nv if self.noisy else 0,
            "drift_noise": self.num_drifts,
            "phases": max(each.phases.stop for each in self.sampled),
            "frame": FRAME_SIZE if self.framed else 0,
            "planned": self.num_planned,
            "request": 0 if self.watch is None else 1,
        }

    @property
    def desired(self) -> dict[str, int]:
        """Sizes of the outputs of a reference."""
        framed = {"desired_frame": FRAME_SIZE} if self.framed else {}
        return {"desired_state": self.nq + self.nv, "desired_acceleration": self.nv, **framed}

    @property
    def _detector_sizes(self) -> dict[str, int]:
        return {} if self.detector is None else sized(self.detector.outputs, {}, "detection")

    def _whole(self, cells: Mapping[str, str]) -> Places:
        """Places of cells that have numbers, by other names."""
        sizes = self.states | self.results | self.row
        return {name: (cell, 0, sizes[cell]) for name, cell in cells.items() if sizes.get(cell)}

    @property
    def detector_inputs(self) -> Places:
        """Cells that a detector reads. Raises NotTraceable: one of its inputs is not known."""
        if self.detector is None:
            return {}
        made = self._whole(_LOOKED_AT | _IS_NEW) | laid("acted", self.acted)
        made |= laid("shown_last", self.shown_last)
        if unknown := set(self.detector.inputs) - set(made):
            raise NotTraceable(f"{type(self.detector).__name__} with an input {min(unknown)}")
        return {name: made[name] for name in self.detector.inputs}

    @property
    def detector_outputs(self) -> Places:
        """Cells that a detector writes."""
        cells = self._whole(_DETECTED | _IS_NEW | ({} if self.watch is None else _REQUEST))
        return {name: place for name, place in cells.items() if name in self._detector_sizes}

    @property
    def law_inputs(self) -> Places:
        """Cells that a law reads after a call, or that is called."""
        made = laid("reference", self.desired) | self._whole(_READ | _IS_NEW)
        made |= {} if self.watch is None else laid("followed", self.desired)
        made |= laid("shown_last", self.shown_last)
        wanted = LawBlock(self.law, self.coordinates).inputs
        return {name: place for name, place in made.items() if name in wanted}

    @property
    def log(self) -> Places:
        """The signals of a record."""
        made = self._whole(_SAMPLED)
        kept = {signal.name: signal.held for signal in LAW_SIGNALS}
        kept |= dict.fromkeys(getattr(self.law, "logged", ()), True)
        for name, (cell, first, size) in laid("memory", sizes_of(self.memory)).items():
            if name in kept:
                made[name] = (f"{cell}_after" if kept[name] else cell, first, size)
        touch = {name: of.size for each in self.touches.values() for name, of in each.items()}
        shown = {"acted": self.acted, "flown": self.flown, "touch": touch}
        for cell, sizes in (shown | {"shown_last": self.shown_last}).items():
            places = laid(cell, sizes).items()
            made |= {name: place for name, place in places if name in self.recorded}
        if self.external:
            names = (f"force_{name}" for name in ("disturbance", *self.external))
            made |= laid("each_force", dict.fromkeys(names, self.nv))
        if self.watch is not None:
            made |= laid("mode", {"mode": 1, "mode_cause": 1})
            made |= laid("followed", self.desired) | laid("given", {"generalized_force": self.nv})
        return made


def laid(cell: str, sizes: Mapping[str, int]) -> Places:
    """The places of arrays one after the other in a cell."""
    firsts = itertools.accumulate(sizes.values(), initial=0)
    return {name: (cell, at, size) for (name, size), at in zip(sizes.items(), firsts, strict=False)}


def outputs_of(force: Sampled, coordinates: Coordinates) -> dict[str, np.ndarray]:
    """The outputs of a force, of zero."""
    sizes = sized(force.outputs, usual_sizes("forces", coordinates), "forces")
    return {name: np.zeros(size) for name, size in sizes.items()}
