"""A sampled closed loop, traced: its blocks run once on symbols.

The law is the very object of the scenario, with symbols in place of its numbers (``parameters``).
A law that is called instead (``called``) stands between two functions of a sample.
Everything that the code depends on stands in ``Blocks``; all else is an input.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.loop.blocks import BESIDES, TOLD, usual_sizes
from ffsm_drake.plugins.compiled.code import of_lanes
from ffsm_drake.plugins.compiled.models import traced_model
from ffsm_drake.plugins.compiled.parameters import with_symbols
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations import equations
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.equations.tree import Tree
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES, Coordinates
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.controllers.sampled import SIGNALS
from ffsm_drake.systems.disturbance import force_at
from ffsm_drake.systems.frame_path import FRAME_SIZE
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sampled import NEXT, Now, Sampled, memory_of, sized
from ffsm_drake.systems.sampled import phases_of as phases_at
from ffsm_drake.tape.arrays import inputs, traced
from ffsm_drake.tape.numbers import NotTraceable, Tape, none_caught, number
from ffsm_drake.tape.tangents import tangents


class Scheme(NamedTuple):
    """A Runge-Kutta scheme with the derivatives k0 (at the step's begin), k1, ..."""

    times: tuple[float, ...]  # of the derivatives, in steps
    # weights of the derivatives: for the point of each further derivative, and for the step's end
    points: tuple[tuple[float, ...], ...]


SCHEMES = {
    "explicit_euler": Scheme((0.0,), ((1.0,),)),
    "runge_kutta2": Scheme((0.0, 1.0), ((1.0,), (0.5, 0.5))),
    "runge_kutta3": Scheme(
        (0.0, 0.5, 1.0), ((0.5,), (-1.0, 2.0), (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0))
    ),
    "runge_kutta5": Scheme(  # of Dormand and Prince
        (0.0, 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0, 1.0),
        (
            (1.0 / 5.0,),
            (3.0 / 40.0, 9.0 / 40.0),
            (44.0 / 45.0, -56.0 / 15.0, 32.0 / 9.0),
            (19372.0 / 6561.0, -25360.0 / 2187.0, 64448.0 / 6561.0, -212.0 / 729.0),
            (9017.0 / 3168.0, -355.0 / 33.0, 46732.0 / 5247.0, 49.0 / 176.0, -5103.0 / 18656.0),
            (35.0 / 384.0, 0.0, 500.0 / 1113.0, 125.0 / 192.0, -2187.0 / 6784.0, 11.0 / 84.0),
        ),
    ),
}
# Signals of a record that a sample makes, and the cells that have them.
_SAMPLED = {
    "state": "known",
    "hidden_state": "hidden",
    "measurement": "measurement",
    "generalized_force": "generalized_force",
    "applied_force": "applied_force",
    "disturbance_force": "disturbance_force",
}
# States that a sample changes, and the cells that have them then.
CARRIED = {
    "memory": "memory_after",
    "drift": "drift_after",
    "stored": "stored_after",
    "loaded": "loaded_after",
    "pushed": "pushed_after",
    "held_before": "held_after",
    "watched": "watched_after",
    "commanded": "commanded_after",
    "waiting": "waiting_after",
    "applied": "told",
    "requested": "requested_after",
    "corrected": "corrected_after",
}
# Likewise of an instant at which forces step that step several times in a sample.
TOUCHED = {"touched": "touched_after", "touch": "touch_after"}
# What the functions of a sample and of the derivative read.
_SAMPLE = (
    "x", "t0", "law", "sensors", "actuators", "forces", "last_forces", "deviation", "drift",
    "share", "added", "reference", "noise", "drift_noise", "phases", "frame", "planned", "stored",
    "loaded", "pushed", "touch", "held_before", "watch", "watched", "commanded", "memory",
    "applied", "waiting", "limit", "force_resolution", "sines", "joint_force", "law_at_start",
    "request", "requested", "corrected",
)  # fmt: skip
# What has no derivative: a run's parameters and what follows from time.
_FIXED = {
    "t0", "law", "sensors", "actuators", "forces", "last_forces", "deviation", "share", "added",
    "reference", "phases", "frame", "planned", "limit", "force_resolution", "sines", "t", "own",
    "step", "watch", "joint_force", "law_at_start", "request",
}  # fmt: skip
_DERIVATIVE = (
    "state", "applied_force", "corrected", "push", "touch", "acted", "t", "actuators",
    "last_forces", "sines", "own",
)  # fmt: skip
_ACTED = (
    "generalized_force", "waiting", "limit", "force_resolution", "x", "t0", "actuators", "loaded",
    "phases", "push", "joint_force", "watch", "watched_after",
)  # fmt: skip
_TOUCH = "x", "t0", "forces", "touched", "touch"


# Outputs of forces, and the entries of the plant's v that they are along.
_OF_FORCES = {"generalized_force": "forced", "hidden_force": "loose"}


class Function(NamedTuple):
    """A traced function."""

    text: str  # in LLVM's language
    arrays: tuple[str, ...]  # what it reads, and then what it writes


@dataclasses.dataclass(frozen=True, kw_only=True)
class Blocks:
    """The blocks of a loop, as far as the code depends on them."""

    law: Any
    num_parameters: int  # of the law
    num_planned: int  # numbers of the law that differ between samples, see ``rows_of``
    nq: int  # of the known coordinates
    nv: int
    tree: Tree  # of the spacecraft
    # entries of the plant's [q; v] that are known, and of hidden coordinates; of its v, known ones
    known: tuple[int, ...]
    hidden: tuple[int, ...]
    forced: tuple[int, ...]
    loose: tuple[int, ...]  # of its v, hidden ones
    coordinates: Coordinates
    sensors: tuple[Sampled, ...]  # stages in a row
    actuators: tuple[Sampled, ...]  # in a row, after limits, quantisation and delay
    flows: tuple[Continuous, ...]  # beside them
    forces: Mapping[str, Sampled]  # by name, held over a sample
    last: Mapping[str, Continuous]  # forces that read the sum of all others
    watch: Any  # the supervisor's block, or None
    detector: Sampled | None  # a last stage of sensing that is called, as the law is then
    recorded: tuple[str, ...]  # outputs of actuators, flows, and forces that do not step once
    num_errors: int  # parameters of the sensors
    num_actuators: int  # parameters of actuators and flows
    num_forces: int  # parameters of the forces
    num_last: int  # parameters of the last forces
    num_watch: int  # parameters of the watch
    noisy: bool
    num_drifts: int  # errors of the sensors that drift
    framed: bool  # the path of a frame is prescribed
    limited: bool
    quantized: bool  # the force
    waits: int  # samples from a force to its effect
    limp: bool  # a constant force acts on the joints, not the actuators'
    scheme: str
    called: str = ""  # why the law is called at each sample; empty: it is traced

    @functools.cached_property
    def memory(self) -> dict[str, np.ndarray]:
        """The law's memory at its start."""
        return {name: np.asarray(v, float) for name, v in self.law.initial_state().items()}

    @functools.cached_property
    def flowing(self) -> dict[str, np.ndarray]:
        """The states of the flows at their start, which follow the plant's."""
        return {name: value for each in self.flows for name, value in _at_start(each).items()}

    @functools.cached_property
    def acted(self) -> dict[str, int]:
        """Outputs of actuators beside the force, by name: numbers in each."""
        sizes = [sized(each.outputs, {}, "actuation") for each in self.actuators]
        return {name: n for of in sizes for name, n in [*of.items()][1:]}

    @functools.cached_property
    def flown(self) -> dict[str, int]:
        """Outputs of the flows, likewise."""
        return {name: n for each in self.flows for name, n in each.outputs.items()}

    @functools.cached_property
    def slow(self) -> dict[str, Sampled]:
        """The forces that step once in a sample."""
        return {name: each for name, each in self.forces.items() if each.per_sample == 1}

    @functools.cached_property
    def fast(self) -> dict[str, Sampled]:
        """The others: they step several times, or never."""
        return {name: each for name, each in self.forces.items() if each.per_sample != 1}

    @property
    def per_sample(self) -> int:
        """Steps of forces in a sample."""
        return max((each.per_sample for each in self.fast.values()), default=1) or 1

    @property
    def late(self) -> frozenset[str]:
        """Signals of forces that step several times: at a sample as they were before it."""
        several = [each for each in self.fast.values() if each.per_sample]
        return frozenset(name for each in several for name in each.outputs) & {*self.recorded}

    @property
    def parameters(self) -> dict[str, int]:
        """Numbers that a leg begins with and keeps. At a grasp they change: ``own`` is read from a
        plant with another payload, blocks have ``with_payload``, and limp joints ``joint_force``.
        """
        nx, nv = self.nq + self.nv, self.nv
        return {
            "own": self.tree.num_parameters, "law": self.num_parameters,
            "sensors": self.num_errors, "actuators": self.num_actuators,
            "forces": self.num_forces, "last_forces": self.num_last, "deviation": nx, "limit": nv,
            "force_resolution": nv, "sines": 4 * nv, "share": self.num_drifts,
            "added": self.num_drifts, "sample_time": 1, "step": 1, "watch": self.num_watch,
            "bound": 1, "joint_force": nv - NUM_BASE_VELOCITIES if self.limp else 0,
            "law_at_start": 0 if self.watch is None else _total(self.memory),
        }  # fmt: skip

    @property
    def states(self) -> dict[str, int]:
        """Numbers that a run begins with and changes."""
        return {
            "x": len(self.known) + len(self.hidden) + _total(self.flowing),
            "memory": _total(self.memory), "applied": self.nv, "drift": self.num_drifts,
            "waiting": self.waits * self.nv, "stored": _size(self.sensors),
            "loaded": _size(self.actuators),
            "pushed": _size(self.slow.values()),
            "touched": _size(self.fast.values()),
            "touch": sum(_total(self._outputs(each)) for each in self.fast.values()),
            "held_before": sum(self._held.values()) if self.last or self._gyrates else 0,
            "watched": 0 if self.watch is None else _size([self.watch]),
            "commanded": 0 if self.watch is None else self.nv,
            "requested": 0 if self.watch is None else self._found("abort_request"),
            "corrected": sum(each.num_corrections for each in self._corrects.values()),
        }  # fmt: skip

    @property
    def results(self) -> dict[str, int]:
        """What a sample makes, and room for a step of the integrator."""
        nx, nv, states = self.nq + self.nv, self.nv, self.states
        stages, forces = range(len(SCHEMES[self.scheme].times)), len(self._named)
        watching = {} if self.watch is None else {"mode": 2, "asks": 1, "followed": nx + nv}
        watching |= {"given": nv} if watching else {}
        return {
            "is_new": nx if self.called and self._tells_new else 0,
            "known": nx, "hidden": len(self.hidden), "measurement": nx, "generalized_force": nv,
            "applied_force": nv,
            "disturbance_force": nv, "each_force": (1 + forces) * nv if forces else 0,
            "detected": self._found("fault_detected"),
            "gyroscopic": self.nv if self._gyrates else 0,
            "push": self._held["push"], **watching, "shown_last": sum(self._shown_last.values()),
            "hidden_push": len(self.loose) if self._push_hidden else 0,
            "acted": sum(self.acted.values()), "flown": sum(self.flown.values()), "y": states["x"],
            **{cell: states[name] for name, cell in (CARRIED | TOUCHED).items()},
            **{f"k{i}": states["x"] for i in stages}, **{f"t{i}": 1 for i in stages},
        }  # fmt: skip

    @property
    def timed(self) -> tuple[Sampled, ...]:
        """The blocks with phases."""
        watch = () if self.watch is None else (self.watch,)
        return *self.sensors, *self.actuators, *self.forces.values(), *watch

    @property
    def _corrects(self) -> dict[str, Any]:
        """The last forces with a correction, which a sample makes."""
        return {name: each for name, each in self.last.items() if hasattr(each, "correct")}

    @property
    def _places_last(self) -> dict[str, tuple[str, int, int]]:
        """As ``log``, of the last forces' other outputs."""
        ends = np.cumsum([0, *self._shown_last.values()]).tolist()
        places = zip(self._shown_last.items(), ends, strict=False)
        return {name: ("shown_last", first, size) for (name, size), first in places}

    @property
    def _shown_last(self) -> dict[str, int]:
        """Outputs of last forces beside the force, by name: numbers in each."""
        found = {name: n for each in self.last.values() for name, n in each.outputs.items()}
        return {name: n for name, n in found.items() if name != "generalized_force"}

    @property
    def _named(self) -> tuple[str, ...]:
        """Forces beside the disturbance."""
        return (*self.forces, *self.last)

    @property
    def _held(self) -> dict[str, int]:
        """What acts from one sample to the next."""
        push = self.nv + len(self.loose) if self.slow else 0
        return {"applied_force": self.nv, "push": push, "acted": sum(self.acted.values())}

    @property
    def _push_hidden(self) -> bool:
        return any("hidden_force" in force.outputs for force in self.forces.values())

    @property
    def _tells_new(self) -> bool:
        return any("measurement_is_new" in stage.outputs for stage in self.sensors)

    def _found(self, name: str) -> int:
        ports = {} if self.detector is None else sized(self.detector.outputs, {}, "detection")
        return ports.get(name, 0)

    @property
    def _gyrates(self) -> bool:
        return self.detector is not None and "gyroscopic_force" in self.detector.inputs

    @property
    def detector_inputs(self) -> dict[str, tuple[str, int, int]]:
        """As ``law_inputs``, of the detector. Raises NotTraceable: one of them is not known."""
        if self.detector is None:
            return {}
        nx, nv, first = self.nq + self.nv, self.nv, 0
        made = {
            "state": ("measurement", 0, nx), "told_force": ("applied", 0, nv),
            "measurement_is_new": ("is_new", 0, nx), "gyroscopic_force": ("gyroscopic", 0, nv),
        }  # fmt: skip
        for name, size in self.acted.items():
            made[name], first = ("acted", first, size), first + size
        if unknown := set(self.detector.inputs) - set(made):
            raise NotTraceable(f"{type(self.detector).__name__} with an input {min(unknown)}")
        return {name: made[name] for name in self.detector.inputs}

    @property
    def detector_outputs(self) -> dict[str, tuple[str, int, int]]:
        """Output of the detector -> cell that it is written to, first entry there, and size."""
        if self.detector is None:
            return {}
        cells = {
            "estimated_state": "measurement", "measurement_is_new": "is_new",
            "fault_detected": "detected", "abort_request": "requested_after",
        }  # fmt: skip
        sizes = sized(self.detector.outputs, {}, "detection")
        if self.watch is None:
            del cells["abort_request"]
        return {name: (cell, 0, sizes[name]) for name, cell in cells.items() if name in sizes}

    @property
    def law_inputs(self) -> dict[str, tuple[str, int, int]]:
        """Input of a law that is called -> its cell at a sample, first entry there, and size."""
        nx, nv, sizes = self.nq + self.nv, self.nv, self.results | self.row
        plan = "reference" if self.watch is None else "followed"
        made = {
            "estimated_state": ("measurement", 0, nx), "desired_state": (plan, 0, nx),
            "desired_acceleration": (plan, nx, nv), "applied_force": ("applied", 0, nv),
            "measurement_is_new": ("is_new", 0, sizes["is_new"]),
            "desired_frame": ("frame", 0, sizes["frame"]),
            **self._places_last,
        }  # fmt: skip
        wanted = LawBlock(self.law, self.coordinates).inputs
        return {name: place for name, place in made.items() if name in wanted and place[2]}

    @property
    def row(self) -> dict[str, int]:
        """What a run reads at each sample."""
        noise = self.nq + self.nv if self.noisy else 0
        phases = phases_of(self.timed, 1).size
        return {
            "reference": self.nq + 2 * self.nv, "noise": noise,
            "drift_noise": self.num_drifts, "phases": phases,
            "frame": FRAME_SIZE if self.framed else 0, "planned": self.num_planned,
            "request": 0 if self.watch is None else 1,
        }  # fmt: skip

    @property
    def log(self) -> dict[str, tuple[str, int, int]]:
        """Signal of a record -> its cell at a sample, first entry there, and size."""
        sizes = self.results | self.states
        made = {name: (cell, 0, sizes[cell]) for name, cell in _SAMPLED.items() if sizes[cell]}
        held = {signal.name: signal.held for signal in SIGNALS}
        held |= dict.fromkeys(getattr(self.law, "logged", ()), True)
        first = 0
        for name, value in self.memory.items():
            if name in held:
                made[name] = ("memory_after" if held[name] else "memory", first, value.size)
            first += value.size
        for cell, of in (("acted", self.acted), ("flown", self.flown)):
            ends = np.cumsum([0, *of.values()]).tolist()
            made |= {
                name: (cell, at, n)
                for (name, n), at in zip(of.items(), ends, strict=False)
                if name in self.recorded
            }
        first = 0
        for each in self.fast.values():
            for name, n in self._outputs(each).items():
                if name in self.recorded:
                    made[name] = ("touch", first, n.size)
                first += n.size
        if self._named:
            made |= {
                f"force_{name}": ("each_force", at * self.nv, self.nv)
                for at, name in enumerate(("disturbance", *self._named))
            }
        if self.watch is not None:
            made |= {name: ("mode", at, 1) for at, name in enumerate(("mode", "mode_cause"))}
            nx = self.nq + self.nv
            made["desired_state"] = "followed", 0, nx
            made["desired_acceleration"] = "followed", nx, self.nv
            made["generalized_force"] = "given", 0, self.nv
        if self.detector is not None:
            made["fault_detected"] = ("detected", 0, sizes["detected"])
        shown = self._places_last.items()
        made |= {name: place for name, place in shown if name in self.recorded}
        if sizes["hidden_push"]:
            made["external_hidden_force"] = ("hidden_push", 0, sizes["hidden_push"])
        return made

    def functions(self, registers: Registers, *, begins: bool, slopes: bool) -> dict[str, Function]:
        """The functions of a sample and of the integrator: with ``begins`` also a run's first
        sample, with ``slopes`` also derivatives along a direction (cells ``d_...``). Raises
        NotTraceable, or what the law raises on symbols.
        """
        first = functools.partial(self._sample, is_first=True)
        sample = functools.partial(self._sample, is_first=False)
        given: dict[str, tuple[Sequence[str], Callable[[Any], Mapping[str, Any]]]] = {
            "first": (_SAMPLE, first),
            "sample": (_SAMPLE, sample),
            "derivative": (_DERIVATIVE, self._derivative),
        }
        if self.per_sample > 1:
            given["touching"] = _TOUCH, self._touching
        for i, weights in enumerate(SCHEMES[self.scheme].points):
            name, reads = f"point{i}", ("x", "step", *(f"k{j}" for j in range(len(weights))))
            given[name] = (reads, functools.partial(self._point, weights))
        if self.called:
            del given["sample"]
            given["sensed"] = _SAMPLE, self._sensed
            given["acted"] = _ACTED, self._acted
        if self.called or not begins:
            del given["first"]
        return {
            name: self._function(registers, name, reads, made, slopes=slopes)
            for name, (reads, made) in given.items()
        }

    def _function(
        self,
        registers: Registers,
        name: str,
        reads: Sequence[str],
        made: Callable[[Any], Mapping[str, Any]],
        *,
        slopes: bool,
    ) -> Function:
        """Trace a function of cells: ``made`` takes an object with an array of symbols for each."""
        sizes = self.parameters | self.states | self.results | self.row
        sizes |= {"t": 1, "state": sizes["x"], "rates": sizes["x"]}
        tape, given = Tape(), {each: sizes[each] for each in reads}
        cells = SimpleNamespace()
        for each, size in given.items():
            array = inputs(tape, each, (size,))
            array.setflags(write=False)
            setattr(cells, each, array)
        results = {
            each: [number(one) for one in np.asarray(values, dtype=object).ravel()]
            for each, values in made(cells).items()
        }
        for each, values in results.items():
            if len(values) != sizes[each]:
                raise NotTraceable(f"size {len(values)} of {each} instead of {sizes[each]}")
            for one in values:
                tape.place_of(one)
        if slopes:
            seeds = dict[int, Any]()
            for each in [each for each in reads if each not in _FIXED]:
                given[f"d_{each}"] = sizes[each]
                direction = tape.inputs(f"d_{each}", sizes[each])
                symbols = [symbol.index for symbol in getattr(cells, each).ravel()]
                seeds |= dict(zip(symbols, direction, strict=True))
            flat = [value for values in results.values() for value in values]
            slope = iter(tangents(tape, flat, seeds))
            results |= {
                f"d_{each}": [next(slope) for _ in range(len(values))]
                for each, values in results.items()
            }
        return Function(of_lanes(registers, name, tape, given, results), (*given, *results))

    def _sample(self, cells: Any, *, is_first: bool) -> dict[str, Any]:
        now = Now(cells.t0[0], is_first=is_first)
        signals, made = self._measured(cells, now)
        force, memory = self._control(cells, signals, now)
        made |= {"generalized_force": force, "memory_after": memory}
        cells.push, cells.watched_after = made["push"], made["watched_after"]
        return made | self._given(cells, force, now)

    def _sensed(self, cells: Any) -> dict[str, Any]:
        """Of a sample, what comes before the call of the law."""
        signals, made = self._measured(cells, Now(cells.t0[0]))
        if self._tells_new:
            made["is_new"] = signals["measurement_is_new"]
        if self._gyrates:
            held, _ = _parts(cells.held_before, _zeros(self._held))
            acted, _ = _parts(held["acted"], _zeros(self.acted))
            made["gyroscopic"] = self._flow(cells, cells.x, acted)[1]["gyroscopic_force"]
        return made

    def _acted(self, cells: Any) -> dict[str, Any]:
        """Of a sample, what comes after the call of the law."""
        return self._given(cells, cells.generalized_force, Now(cells.t0[0]))

    def _measured(self, cells: Any, now: Now) -> tuple[dict[str, Any], dict[str, Any]]:
        """The signals that the law can read, and results of the sample."""
        known = cells.x[list(self.known)]
        signals = {"state": known, "true_state": known, "drift": cells.drift}
        if self.noisy:
            signals["white"] = cells.deviation * cells.noise
        kept = self._measure(cells, signals, now)
        nx = self.nq + self.nv
        plan = cells.reference[:nx], cells.reference[nx:]
        if self.watch is not None:
            plan = self.watch.follow(self._remembered(cells.watched), *plan)
        signals["desired_state"], signals["desired_acceleration"] = plan
        return signals, {
            "known": known,
            "hidden": cells.x[list(self.hidden)],
            "measurement": signals["estimated_state"],
            "drift_after": cells.share * cells.drift + cells.added * cells.drift_noise,
            "stored_after": kept,
            **self._pushed(cells, now),
            **self._watched(cells, signals, now),
        }

    def _given(self, cells: Any, force: Any, now: Now) -> dict[str, Any]:
        """What becomes of the law's force."""
        commanded = force
        if self.watch is not None:
            force = self.watch.give(self._remembered(cells.watched_after), force)
        given = force
        if self.limited:
            force = np.minimum(np.maximum(force, -cells.limit), cells.limit)
        if self.quantized:
            force = quantize(force, cells.force_resolution)
        waiting = np.concatenate([force, cells.waiting])  # newest first
        _, flown = self._flow(cells, cells.x, {})
        signals = {"force": waiting[-self.nv :], "state": cells.x[list(self.known)], **flown}
        signals["isolated"] = np.zeros(self._found("isolated"))  # a call ends the run before
        loaded = self._act(cells, signals, now)
        if self.limp:
            own = signals["force"][:NUM_BASE_VELOCITIES]
            signals["force"] = np.concatenate([own, cells.joint_force])
        return {
            "applied_force": signals["force"],
            "told": signals.get(TOLD, signals["force"]),  # to the law at the next sample
            "acted": _row(signals[name] for name in self.acted),
            "flown": _row(flown[name] for name in self.flown),
            "waiting_after": waiting[: -self.nv],
            "loaded_after": loaded,
            "held_after": self._holds(cells, signals),
            **({} if self.watch is None else {"commanded_after": commanded, "given": given}),
        }

    def _holds(self, cells: Any, signals: Mapping[str, Any]) -> Any:
        """What is held, for the last forces and the detector at the next sample."""
        if not (self.last or self._gyrates):
            return traced([])
        return _row([signals["force"], cells.push, *(signals[name] for name in self.acted)])

    def _measure(self, cells: Any, signals: dict[str, Any], now: Now) -> Any:
        """Add what the sensors show to the signals; return their memory after the sample."""
        after = list[Any]()
        stages = with_symbols(self.sensors, cells.sensors, traced([]), traced_model)
        stored = _stored(self.sensors, cells.stored, cells.phases)
        for stage, (memory, phase) in zip(stages, stored, strict=True):
            inputs = _read(stage, stage.inputs, signals)
            ports = sized(stage.outputs, usual_sizes("sensing", self.coordinates), "sensing")
            outputs, own = _stepped(stage, ports, inputs, memory, now._replace(phase=phase))
            signals |= outputs | {"state": outputs["estimated_state"]}
            after += [own[name] for name in memory]
        return _row(after)

    def _act(self, cells: Any, signals: dict[str, Any], now: Now) -> Any:
        """Add what the actuators make of the force to the signals; return their memory after the
        sample.
        """
        after = list[Any]()
        blocks, _ = self._with_symbols(cells)
        phases = cells.phases[phases_of(self.sensors, 1).size :]
        stored = _stored(self.actuators, cells.loaded, phases)
        for block, (memory, phase) in zip(blocks, stored, strict=True):
            ports = sized(block.inputs, {}, "actuation")
            inputs = _read(block, ports, {**signals, next(iter(ports)): signals["force"]})
            outputs, own = _stepped(
                block, dict(block.outputs), inputs, memory, now._replace(phase=phase)
            )
            signals |= outputs | {"force": next(iter(outputs.values()))}
            after += [own[name] for name in memory]
        return _row(after)

    def _watched(self, cells: Any, signals: Mapping[str, Any], now: Now) -> dict[str, Any]:
        """What the supervisor does."""
        if self.watch is None:
            return {"watched_after": traced([])}
        watch = with_symbols(self.watch, cells.watch, traced([]), traced_model)
        inputs = {
            "estimated_state": signals["estimated_state"], "generalized_force": cells.commanded,
            "desired_state": signals["desired_state"],
            "abort_request": np.concatenate([cells.request, cells.requested]).sum(keepdims=True),
        }  # fmt: skip
        phase = cells.phases[-phases_of((self.watch,), 1).size :]
        memory, ports = self._remembered(cells.watched), watch.outputs
        found, after = _stepped(watch, ports, inputs, memory, now._replace(phase=phase))
        asks = found["asks"]
        if self.num_planned:  # of a plan that follows from what is measured now
            goes_on = (after["restart"] != 0.0) & (memory["answer"] == 0.0)
            asks = np.where((asks == 0.0) & goes_on, 2.0, asks)
        return {
            "mode": _row([found["mode"], found["mode_cause"]]), "asks": asks,
            "followed": _row([signals["desired_state"], signals["desired_acceleration"]]),
            "watched_after": _row(after.values()),
            # the call of a detector writes it
            **({} if self.detector is None else {"requested_after": cells.requested}),
        }  # fmt: skip

    def _remembered(self, watched: Any) -> dict[str, Any]:
        """The memory of the supervisor, by name."""
        return _parts(watched, _at_start(self.watch))[0]

    def _pushed(self, cells: Any, now: Now) -> dict[str, Any]:
        """The forces of a sample: those of this instant and those that are held."""
        each, after = [traced(force_at(now.time, cells.sines.reshape(4, -1)))], list[Any]()
        held = traced(np.zeros(self.nv + len(self.loose)))
        on_hidden = traced(np.zeros(len(self.loose)))
        signals = {"state": cells.x[list(self.known)], "hidden_state": cells.x[list(self.hidden)]}
        usual, touches = usual_sizes("forces", self.coordinates), self._touches(cells)
        blocks = self._forces(cells)
        phases = cells.phases[phases_of((*self.sensors, *self.actuators), 1).size :]
        stored = _stored(self.slow.values(), cells.pushed, phases)
        for name, block in blocks.items():
            if name in touches:
                each.append(touches[name]["generalized_force"])
                on_hidden = on_hidden + touches[name].get("hidden_force", 0.0)
                continue
            memory, phase = next(stored)
            ports, inputs = sized(block.outputs, usual, "forces"), sized(block.inputs, usual, "")
            found, kept = _stepped(
                block, ports, _read(block, inputs, signals), memory, now._replace(phase=phase)
            )
            if unknown := {name.removeprefix(NEXT) for name in found} - _OF_FORCES.keys():
                raise NotTraceable(f"{type(block).__name__} with an output {min(unknown)}")
            for name in set(found) & _OF_FORCES.keys():
                entries = list(getattr(self, _OF_FORCES[name]))
                held[entries] = held[entries] + found[name]
            each.append(_at_instant(found, "generalized_force"))
            if "hidden_force" in found:
                on_hidden = on_hidden + _at_instant(found, "hidden_force")
            after += [kept[name] for name in memory]
        shown = dict[str, Any]()
        if self.last:
            before, _ = _parts(cells.held_before, _zeros(self._held))
            others = self._others(cells, cells.x, now.time, **before)[0]
            for outputs in self._last(cells, cells.x, now.time, others):
                each.append(outputs["generalized_force"])
                shown |= outputs
        return {
            "shown_last": _row(shown[name] for name in self._shown_last),
            "corrected_after": _row(self._corrections(cells)),
            "disturbance_force": functools.reduce(np.add, each),
            "each_force": _row(each if self._named else ()),
            "push": held if self.slow else traced([]),
            "hidden_push": on_hidden if self._push_hidden else traced([]),
            "pushed_after": _row(after),
        }

    def _outputs(self, force: Sampled) -> dict[str, np.ndarray]:
        return outputs_of(force, self.coordinates)

    def _forces(self, cells: Any) -> dict[str, Any]:
        """The sampled forces with symbols, by name."""
        own = tuple(self.forces.values())
        made = with_symbols(own, cells.forces, traced([]), traced_model)
        return dict(zip(self.forces, made, strict=True))

    def _touches(self, cells: Any) -> dict[str, dict[str, Any]]:
        """The held outputs of forces that do not step once."""
        found, values = dict[str, dict[str, Any]](), cells.touch
        for name, each in self.fast.items():
            found[name], values = _parts(values, self._outputs(each))
        return found

    def _touching(self, cells: Any) -> dict[str, Any]:
        """What becomes of these forces at an instant at which they step."""
        signals = {"state": cells.x[list(self.known)], "hidden_state": cells.x[list(self.hidden)]}
        made, after, values = list[Any](), list[Any](), cells.touched
        touches, blocks = self._touches(cells), self._forces(cells)
        for name, each in self.fast.items():
            memory, values = _parts(values, _at_start(each))
            outputs = touches[name]
            if each.per_sample:
                ports = {port: value.size for port, value in self._outputs(each).items()}
                wanted = sized(each.inputs, usual_sizes("forces", self.coordinates), "forces")
                inputs = _read(each, wanted, signals)
                outputs, memory = _stepped(blocks[name], ports, inputs, memory, Now(cells.t0[0]))
            made += [outputs[port] for port in each.outputs]
            after += [memory[own] for own in _at_start(each)]
        return {"touch_after": _row(made), "touched_after": _row(after)}

    def _flow(
        self, cells: Any, x: Any, held: Mapping[str, Any]
    ) -> tuple[list[Any], dict[str, Any]]:
        """The rates of the flows' states at an instant, and their outputs.

        Args: the plant's state and theirs; held outputs of actuators, none at a sample.
        """
        rates, found = list[Any](), dict[str, Any]()
        signals = {"state": x[list(self.known)], **held}
        values = x[len(self.known) + len(self.hidden) :]
        _, flows = self._with_symbols(cells)
        for flow, at_start in zip(flows, map(_at_start, self.flows), strict=True):
            own, values = _parts(values, at_start)
            outputs, changes = flow.flow(
                _read(flow, flow.inputs, _zeros(flow.inputs) | signals), own
            )
            found |= {name: traced(value) for name, value in outputs.items()}
            rates += [traced(changes[name]) for name in own]
        return rates, found

    def _with_symbols(self, cells: Any) -> tuple[Any, Any]:
        both = self.actuators, self.flows
        made: tuple[Any, Any] = with_symbols(both, cells.actuators, traced([]), traced_model)
        return made

    def _control(self, cells: Any, signals: dict[str, Any], now: Now) -> tuple[Any, Any]:
        """The force and the law's memory after a sample."""
        law = with_symbols(self.law, cells.law, cells.planned, traced_model)
        block = LawBlock(law, self.coordinates, errors=tracking_errors)
        signals = signals | {
            "applied_force": cells.applied,
            "desired_frame": cells.frame if self.framed else None,
        }
        inputs = {name: signals[name] for name in block.inputs if signals.get(name) is not None}
        memory, _ = _parts(cells.memory, self.memory)
        if self.watch is not None and now.is_first:
            afresh = self._remembered(cells.watched)["restart"].item() != 0.0
            at_start, _ = _parts(cells.law_at_start, self.memory)
            memory = {name: np.where(afresh, at_start[name], memory[name]) for name in memory}
        outputs, after = _stepped(block, block.outputs, inputs, memory, now)
        return outputs["generalized_force"], _row(after[name] for name in memory)

    def _derivative(self, cells: Any) -> dict[str, Any]:
        plant = len(self.known) + len(self.hidden)
        q, v = np.split(cells.state[:plant], [self.tree.num_positions])
        time, held = cells.t[0], {name: getattr(cells, name) for name in self._held}
        force, rates = self._others(cells, cells.state, time, **held)
        for each in self._last(cells, cells.state, time, force):
            force[list(self.forced)] = force[list(self.forced)] + each["generalized_force"]
        return {"rates": [*equations.derivative(self.tree, q, v, force, cells.own), *_row(rates)]}

    def _others(
        self, cells: Any, x: Any, time: Any, *, applied_force: Any, push: Any, acted: Any
    ) -> tuple[Any, list[Any]]:
        """All forces on the plant but the last ones, at an instant, and the rates of the flows."""
        parts, _ = _parts(acted, _zeros(self.acted))
        rates, flown = self._flow(cells, x, parts)
        disturbance = force_at(time, cells.sines.reshape(4, -1))
        force = traced(np.zeros(self.tree.num_velocities))
        force[list(self.forced)] = applied_force + disturbance
        if self.slow:
            force = force + push
        for outputs in self._touches(cells).values():
            for name in _OF_FORCES.keys() & outputs.keys():
                entries = list(getattr(self, _OF_FORCES[name]))
                force[entries] = force[entries] + outputs[name]
        for name in filter(flown.__contains__, BESIDES):
            force[list(self.forced)] = force[list(self.forced)] + flown[name]
        return force, rates

    def _last(self, cells: Any, x: Any, time: Any, others: Any) -> list[dict[str, Any]]:
        """Outputs of the last forces."""
        signals = {
            "state": x[list(self.known)], "hidden_state": x[list(self.hidden)],
            "other_force": others[list(self.forced)], "time": traced([time]),
        }  # fmt: skip
        sizes = {name: np.zeros(each.num_corrections) for name, each in self._corrects.items()}
        corrections, _ = _parts(cells.corrected, sizes)
        found = list[dict[str, Any]]()
        for name, block in self._last_blocks(cells).items():
            inputs = signals | {"correction": corrections.get(name)}
            outputs, _ = block.flow(_read(block, block.inputs, inputs), {})
            found.append({each: traced(values) for each, values in outputs.items()})
        return found

    def _corrections(self, cells: Any) -> list[Any]:
        """What the last forces correct from a sample on."""
        blocks, inputs = self._last_blocks(cells), {"state": cells.x[list(self.known)]}
        return [blocks[name].correct(inputs) for name in self._corrects]

    def _last_blocks(self, cells: Any) -> dict[str, Any]:
        own = tuple(self.last.values())
        made = with_symbols(own, cells.last_forces, traced([]), traced_model)
        return dict(zip(self.last, made, strict=True))

    def _point(self, weights: Sequence[float], cells: Any) -> dict[str, Any]:
        step = cells.step[0]
        parts = [step * w * getattr(cells, f"k{i}") for i, w in enumerate(weights)]
        return {"y": cells.x + functools.reduce(np.add, parts)}


def _at_instant(outputs: Mapping[str, Any], name: str) -> Any:
    """A force at a sample, for the record."""
    return outputs.get(NEXT + name, outputs[name])


def _zeros(sizes: Mapping[str, int]) -> dict[str, np.ndarray]:
    return {name: np.zeros(size) for name, size in sizes.items()}


def _parts(values: Any, shapes: Mapping[str, np.ndarray]) -> tuple[dict[str, Any], Any]:
    """The first of some numbers by name, in the shapes of others, and the rest."""
    found = dict[str, Any]()
    for name, like in shapes.items():
        found[name], values = values[: like.size].reshape(like.shape), values[like.size :]
    return found, values


def _stored(
    blocks: Iterable[Sampled], values: Any, phases: Any
) -> Iterator[tuple[dict[str, Any], Any]]:
    """Memory and phase of each of some blocks."""
    for block in blocks:
        own, values = _parts(values, _at_start(block))
        count = len(block.phase(0))
        yield own, phases[:count]
        phases = phases[count:]


def _size(blocks: Iterable[Sampled]) -> int:
    """Numbers in the memory of blocks."""
    return sum(_total(_at_start(each)) for each in blocks)


def _row(values: Iterable[Any]) -> Any:
    """Arrays one after the other."""
    return np.concatenate([traced([]), *(traced(each).ravel() for each in values)])


def _total(values: Mapping[str, np.ndarray]) -> int:
    return sum(each.size for each in values.values())


def outputs_of(force: Sampled, coordinates: Coordinates) -> dict[str, np.ndarray]:
    """The outputs of a force, of zero."""
    return _zeros(sized(force.outputs, usual_sizes("forces", coordinates), "forces"))


def _at_start(block: Sampled | Continuous) -> dict[str, np.ndarray]:
    return {name: np.asarray(value, float) for name, value in block.start().items()}


def _read(
    block: Sampled | Continuous, ports: Iterable[str], signals: Mapping[str, Any]
) -> dict[str, Any]:
    """The inputs of a block. Raises NotTraceable: one of its ports is not known."""
    optional = getattr(block, "optional", ())
    ports = [name for name in ports if name in signals or name not in optional]
    if unknown := set(ports) - set(signals):
        raise NotTraceable(f"{type(block).__name__} with an input {min(unknown)}")
    found = {name: traced(signals[name]) for name in ports}
    return found | {name: found[name][list(own)] for name, own in block.entries.items()}


def _stepped(
    block: Sampled, ports: Mapping[str, int], inputs: Any, memory: Any, now: Now
) -> tuple[Any, Any]:
    """What a block's step returns on symbols, with numbers in its output ports by name. Raises
    NotTraceable: other names or shapes.
    """
    for each in (*inputs.values(), *memory.values()):
        each.setflags(write=False)
    with none_caught():
        outputs, after = block.step(inputs, memory, now)
    shapes = {name: value.shape for name, value in memory.items()}
    sizes = {name: (size,) for name, size in ports.items()}
    for found, wanted in ((outputs, sizes), (after, shapes)):
        if {name: np.shape(value) for name, value in found.items()} != wanted:
            kind = "law" if isinstance(block, LawBlock) else type(block).__name__
            raise NotTraceable(f"the {kind} returns other names or shapes than it should")
    return {name: traced(value) for name, value in outputs.items()}, after


def phases_of(sensors: Sequence[Sampled], samples: int) -> np.ndarray:
    """The phases of sensors at each of so many samples (samples, n)."""
    found = [phases_at(each, samples, place=type(each).__name__) for each in sensors]
    return np.concatenate([np.zeros((samples, 0)), *found], axis=1)


def kept_at(blocks: Iterable[Sampled | Continuous], state: np.ndarray) -> np.ndarray:
    """The memory, or own state, of blocks of a spacecraft that was at a state before (n)."""
    kept = [
        memory_of(each, state, place=type(each).__name__)
        if isinstance(each, Sampled)
        else each.start(state)
        for each in blocks
    ]
    return np.concatenate([np.zeros(0), *(np.ravel(each) for of in kept for each in of.values())])


def forces_at(
    forces: Iterable[Sampled], state: np.ndarray, coordinates: Coordinates
) -> dict[str, np.ndarray]:
    """The states of forces of a spacecraft that was at a state before (n), by name."""
    own = tuple(forces)
    fast = [each for each in own if each.per_sample != 1]
    return {
        "pushed": kept_at([each for each in own if each.per_sample == 1], state),
        "touched": kept_at(fast, state),
        "touch": np.zeros(sum(_total(outputs_of(each, coordinates)) for each in fast)),
    }


def steps_of(sample_time: float, longest: float, per_sample: int = 1) -> int:
    """Steps of the integrator in a control sample; 0: they do not divide it.

    Args: the sample and a step at most, s; the number of parts of a sample that have equal steps.
    """
    if per_sample > 1:
        return per_sample * steps_of(sample_time / per_sample, longest)
    steps = max(1, math.ceil(sample_time / longest - 1e-9))
    return steps if steps == 1 or abs(steps * longest / sample_time - 1.0) < 1e-9 else 0
