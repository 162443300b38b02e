"""A sampled closed loop, traced: its blocks run once on symbols.

The law is the very object of the scenario, with symbols in place of its numbers (``parameters``).
A law that is called instead (``called``) stands between two functions of a sample.
"""

import collections
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.loop.blocks import BESIDES, TOLD, usual_sizes
from ffsm_drake.plugins.compiled.blocks import CARRIED, Blocks, Placed, at_start
from ffsm_drake.plugins.compiled.models import traced_model
from ffsm_drake.plugins.compiled.parameters import with_symbols
from ffsm_drake.plugins.compiled.stepping import joined, parted, read, stepped, zeros
from ffsm_drake.plugins.equations import equations
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.tape.arrays import traced
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.disturbance import force_at
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sampled import NEXT, Now, sized

# Outputs of forces, and the entries of the plant's v that they are along.
_OF_FORCES = {"generalized_force": "forced", "hidden_force": "loose"}

Made = Mapping[str, Any]  # cell -> what a function writes there


class TracedLoop:
    """The blocks of a loop on symbols, at an instant."""

    def __init__(self, blocks: Blocks, cells: Any) -> None:
        self._blocks, self._cells = blocks, cells
        self._after: dict[str, list[Any]] = collections.defaultdict(list)  # memory, by state

    @functools.cached_property
    def _parts(self) -> Any:
        """The blocks with symbols, by kind and name."""
        return with_symbols(self._blocks.parts, self._cells.parts, traced([]), traced_model)

    def sample(self, *, is_first: bool) -> Made:
        """A sample, which is a first one for the law or not."""
        now = Now(self._cells.t0[0], is_first=is_first)
        signals, made = self._measured(now)
        force, memory = self._control(signals, now)
        made |= {"generalized_force": force, "memory_after": memory}
        return made | self._given(force, now, made["push"], made["watched_after"])

    def sensed(self) -> Made:
        """Of a sample, what comes before the call of the law."""
        signals, made = self._measured(Now(self._cells.t0[0]))
        if self._blocks.tells_new:
            made["is_new"] = signals["measurement_is_new"]
        if self._blocks.gyrates:
            held, _ = parted(self._cells.held_before, zeros(self._blocks.held))
            acted, _ = parted(held["acted"], zeros(self._blocks.acted))
            made["gyroscopic"] = self._flow(self._x, acted)[1]["gyroscopic_force"]
        return made

    def acted(self) -> Made:
        """Of a sample, what comes after the call of the law."""
        cells = self._cells
        force, now = cells.generalized_force, Now(cells.t0[0])
        return self._given(force, now, cells.push, cells.watched_after)

    def derivative(self) -> Made:
        """The rates of the plant's state, and of the flows'."""
        cells, of, state = self._cells, self._blocks, self._alive(self._cells.state)
        q, v = np.split(state[: self._plant], [of.tree.num_positions])
        time, held = cells.t[0], {name: getattr(cells, name) for name in of.held}
        force, rates = self._others(state, time, **held)
        for each in self._last(state, time, force):
            force[list(of.forced)] = force[list(of.forced)] + each["generalized_force"]
        return {"rates": [*equations.derivative(of.tree, q, v, force, cells.own), *joined(rates)]}

    def instants(self, times: Sequence[float]) -> Made:
        """The times of derivatives in a step, and whether a sample is a first one for the law.

        Args: times after the begin of the step, in steps.
        """
        cells, start = self._cells, self._time_of(self._cells.j)
        is_first = cells.number == cells.first_at
        if self._blocks.watch is not None:
            is_first = is_first | (self._remembered(cells.watched)["restart"] != 0.0)
        made = {f"t{i}": start + cells.step * each for i, each in enumerate(times)}
        return made | {"is_first": np.where(is_first, 1.0, 0.0)}

    def judged(self) -> Made:
        """What is known of a run after a sample."""
        cells, places = self._cells, self._blocks.log.values()
        logged = joined(getattr(cells, cell)[first : first + size] for cell, first, size in places)
        is_sound = self._is_bounded(cells.x) & np.isfinite(logged).all()
        acted = np.where(self._is_lost, 0.0, 1.0)
        return {"acted_on": cells.acted_on + acted, **self._seen(cells.t0, is_sound)}

    def carried(self) -> Made:
        """The states after a sample."""
        after = {name: getattr(self._cells, cell) for name, cell in CARRIED.items()}
        return self._unless_lost(after)

    def point(self, weights: Sequence[float]) -> Made:
        """A point of the integrator's step."""
        step = self._cells.step[0]
        parts = [step * w * getattr(self._cells, f"k{i}") for i, w in enumerate(weights)]
        return {"y": self._cells.x + functools.reduce(np.add, parts)}

    def arrived(self, weights: Sequence[float], steps: int) -> Made:
        """The end of a step, of so many in a sample."""
        cells, made = self._cells, self._unless_lost({"x": self.point(weights)["y"]})
        following = cells.j + 1.0
        # Drake looks after every step; the next sample after the last one
        is_last = following >= steps
        is_sound = self._is_bounded(made["x"]) | is_last
        return {
            **made,
            **self._seen(self._time_of(following), is_sound),
            "j": np.where(is_last, 0.0, following),
            "number": cells.number + np.where(is_last, 1.0, 0.0),
        }

    def _time_of(self, step: Any) -> Any:
        """The begin of a step in the present sample (1), s."""
        cells = self._cells
        return cells.number * cells.sample_time + step * cells.step

    @property
    def _is_lost(self) -> Any:
        return self._cells.lost != 0.0

    def _is_bounded(self, x: Any) -> Any:
        velocities = x[list(self._blocks.known[self._blocks.nq :])]
        return (np.abs(velocities) <= self._cells.bound).all()

    def _seen(self, time: Any, is_sound: Any) -> dict[str, Any]:
        """What is known of a run that is sound at a time, or not."""
        return {
            "lost": np.where(self._is_lost | ~is_sound, 1.0, 0.0),
            "seen_at": np.where(self._is_lost, self._cells.seen_at, time),
        }

    def _unless_lost(self, after: Made) -> dict[str, Any]:
        """What becomes of states; those of a lost run stay."""
        return {
            name: np.where(self._is_lost, getattr(self._cells, name), values)
            for name, values in after.items()
        }

    def _alive(self, x: Any) -> Any:
        """A state, which is no number in a lost run, so that it asks for no loops."""
        first = np.where(self._is_lost, np.nan, x[:1])
        return np.concatenate([first, x[1:]])

    @property
    def _x(self) -> Any:
        return self._alive(self._cells.x)

    def touching(self) -> Made:
        """What becomes of forces that step several times, at an instant at which they step."""
        signals, touches, made = self._states(self._x), self._touches, list[Any]()
        for placed, block in self._sampled("forces"):
            if placed.cell != "touched":
                continue
            if block.per_sample:
                outputs = self._step(placed, block, signals, Now(self._cells.t0[0]))
            else:
                outputs = touches[placed.name]
                self._after["touched"] += self._memory(placed).values()
            made += [outputs[port] for port in self._blocks.touches[placed.name]]
        return self._unless_lost({"touch": joined(made), "touched": self._kept("touched")})

    def _sampled(self, kind: str) -> Iterator[tuple[Placed, Any]]:
        """The sampled blocks of a kind, with symbols."""
        for placed in self._blocks.sampled:
            if placed.kind == kind:
                yield placed, self._parts[kind][placed.name]

    def _memory(self, placed: Placed) -> dict[str, Any]:
        values = getattr(self._cells, placed.cell)[placed.first :]
        return parted(values, at_start(placed.block))[0]

    def _step(
        self, placed: Placed, block: Any, signals: Mapping[str, Any], now: Now
    ) -> dict[str, Any]:
        """The outputs of a sampled block; its memory is noted."""
        usual = usual_sizes(placed.kind, self._blocks.coordinates)
        if placed.phases.stop > placed.phases.start:
            now = now._replace(phase=self._cells.phases[placed.phases])
        memory, own = self._memory(placed), placed.block
        outputs, after = stepped(
            block, sized(own.outputs, usual, placed.kind), read(own, signals), memory, now
        )
        self._after[placed.cell] += [after[name] for name in memory]
        return outputs

    def _kept(self, state: str) -> Any:
        """The memory of the blocks after they have stepped."""
        return joined(self._after[state])

    @property
    def _plant(self) -> int:
        return len(self._blocks.known) + len(self._blocks.hidden)

    def _states(self, x: Any) -> dict[str, Any]:
        return {"state": x[list(self._blocks.known)], "hidden_state": x[list(self._blocks.hidden)]}

    def _measured(self, now: Now) -> tuple[dict[str, Any], dict[str, Any]]:
        """The signals that the law can read, and results of the sample."""
        of, cells, nx = self._blocks, self._cells, self._blocks.nq + self._blocks.nv
        known, hidden = self._states(self._x).values()
        signals = {"state": known, "true_state": known, "drift": cells.drift}
        if of.noisy:
            signals["white"] = cells.deviation * cells.noise
        for placed, stage in self._sampled("sensing"):
            outputs = self._step(placed, stage, signals, now)
            signals |= outputs | {"state": outputs["estimated_state"]}
        plan = cells.reference[:nx], cells.reference[nx:]
        if of.watch is not None:
            plan = of.watch.follow(self._remembered(cells.watched), *plan)
        signals["desired_state"], signals["desired_acceleration"] = plan
        return signals, {
            "known": known,
            "hidden": hidden,
            "measurement": signals["estimated_state"],
            "drift_after": cells.share * cells.drift + cells.added * cells.drift_noise,
            **self._pushed(now, signals),
            **self._watched(signals, now),
            "stored_after": self._kept("stored"),
        }

    def _given(self, force: Any, now: Now, push: Any, watched: Any) -> dict[str, Any]:
        """What becomes of the law's force."""
        of, cells, commanded = self._blocks, self._cells, force
        if of.watch is not None:
            force = of.watch.give(self._remembered(watched), force)
        given = force
        if of.limited:
            force = np.minimum(np.maximum(force, -cells.limit), cells.limit)
        if of.quantized:
            force = quantize(force, cells.force_resolution)
        waiting = np.concatenate([force, cells.waiting])  # newest first
        _, flown = self._flow(self._x, {})
        signals = {**self._states(self._x), **flown}
        signals["isolated"] = np.zeros(of.found("isolated"))  # a call ends the run before
        force = waiting[-of.nv :]
        for placed, block in self._sampled("actuation"):
            command, applied = next(iter(block.inputs)), next(iter(block.outputs))
            signals |= self._step(placed, block, signals | {command: force}, now)
            force = signals[applied]
        if of.limp:
            force = np.concatenate([force[:NUM_BASE_VELOCITIES], cells.joint_force])
        acted = [signals[name] for name in of.acted]
        holds = of.states["held_before"] > 0  # for the last forces and the detector
        return {
            "applied_force": force,
            "told": signals.get(TOLD, force),  # to the law at the next sample
            "acted": joined(acted),
            "flown": joined(flown[name] for name in of.flown),
            "waiting_after": waiting[: -of.nv],
            "loaded_after": self._kept("loaded"),
            "held_after": joined([force, push, *acted] if holds else ()),
            **({} if of.watch is None else {"commanded_after": commanded, "given": given}),
        }

    def _watched(self, signals: Mapping[str, Any], now: Now) -> dict[str, Any]:
        """What the supervisor does."""
        cells, of = self._cells, self._blocks
        if of.watch is None:
            return {"watched_after": traced([])}
        request = np.concatenate([cells.request, cells.requested]).sum(keepdims=True)
        given = {"generalized_force": cells.commanded, "abort_request": request}
        ((placed, watch),) = self._sampled("supervisor")
        found = self._step(placed, watch, {**signals, **given}, now)
        after, asks = self._kept("watched"), found["asks"]
        if of.num_planned:  # of a plan that follows from what is measured now
            goes_on = self._remembered(after)["restart"] != 0.0
            goes_on = goes_on & (self._remembered(cells.watched)["answer"] == 0.0)
            asks = np.where((asks == 0.0) & goes_on, 2.0, asks)
        return {
            "mode": joined([found["mode"], found["mode_cause"]]), "asks": asks,
            "followed": joined([signals["desired_state"], signals["desired_acceleration"]]),
            "watched_after": after,
            # the call of a detector writes it
            **({} if of.detector is None else {"requested_after": cells.requested}),
        }  # fmt: skip

    def _remembered(self, watched: Any) -> dict[str, Any]:
        """The memory of the supervisor, by name."""
        return parted(watched, at_start(self._blocks.watch))[0]

    def _pushed(self, now: Now, measured: dict[str, Any]) -> dict[str, Any]:
        """The forces of a sample: those of this instant and those that are held. What they show is
        noted among the signals.
        """
        of, cells = self._blocks, self._cells
        each = [traced(force_at(now.time, cells.sines.reshape(4, -1)))]
        held = traced(np.zeros(of.nv + len(of.loose)))
        on_hidden = traced(np.zeros(len(of.loose)))
        signals, touches = self._states(self._x), self._touches
        for placed, block in self._sampled("forces"):
            if (found := touches.get(placed.name, {})) == {}:
                found = self._step(placed, block, signals, now)
                if unknown := {name.removeprefix(NEXT) for name in found} - _OF_FORCES.keys():
                    raise NotTraceable(f"{type(block).__name__} with an output {min(unknown)}")
                held = self._along(held, found)
            each.append(_at_instant(found, "generalized_force"))
            if "hidden_force" in found:
                on_hidden = on_hidden + _at_instant(found, "hidden_force")
        if of.parts["last"]:
            before, _ = parted(cells.held_before, zeros(of.held))
            others = self._others(self._x, now.time, **before)[0]
            for outputs in self._last(self._x, now.time, others):
                each.append(outputs["generalized_force"])
                measured |= {name: outputs[name] for name in of.shown_last if name in outputs}
        return {
            "shown_last": joined(measured[name] for name in of.shown_last),
            "corrected_after": joined(self._corrections()),
            "disturbance_force": functools.reduce(np.add, each),
            "each_force": joined(each if of.external else ()),
            "push": held if of.has_slow else traced([]),
            "hidden_push": on_hidden if of.pushes_hidden else traced([]),
        }

    def _along(self, force: Any, outputs: Mapping[str, Any]) -> Any:
        """A force on the plant with the outputs of another one."""
        for name in _OF_FORCES.keys() & outputs.keys():
            entries = list(getattr(self._blocks, _OF_FORCES[name]))
            force[entries] = force[entries] + outputs[name]
        return force

    @functools.cached_property
    def _touches(self) -> dict[str, dict[str, Any]]:
        """The held outputs of forces that do not step once."""
        found = dict[str, dict[str, Any]]()
        if self._blocks.touches:
            values = self._cells.touch
            for name, outputs in self._blocks.touches.items():
                found[name], values = parted(values, outputs)
        return found

    def _flow(self, x: Any, held: Mapping[str, Any]) -> tuple[list[Any], dict[str, Any]]:
        """The rates of the flows' states at an instant, and their outputs.

        Args: the plant's state and theirs; held outputs of actuators, none at a sample.
        """
        rates, found = list[Any](), dict[str, Any]()
        signals, values = self._states(x) | {**held}, x[self._plant :]
        for name, flow in self._blocks.parts["flows"].items():
            own, values = parted(values, at_start(flow))
            given = read(flow, zeros(flow.inputs) | signals)
            outputs, changes = self._parts["flows"][name].flow(given, own)
            found |= {name: traced(value) for name, value in outputs.items()}
            rates += [traced(changes[name]) for name in own]
        return rates, found

    def _control(self, signals: Mapping[str, Any], now: Now) -> tuple[Any, Any]:
        """The force and the law's memory after a sample."""
        of, cells = self._blocks, self._cells
        law = with_symbols(of.law, cells.law, cells.planned, traced_model)
        block = LawBlock(law, of.coordinates, errors=tracking_errors)
        signals = {**signals, "applied_force": cells.applied}
        if of.framed:
            signals["desired_frame"] = cells.frame
        inputs = {name: signals[name] for name in block.inputs if signals.get(name) is not None}
        memory, _ = parted(cells.memory, of.memory)
        if of.watch is not None and now.is_first:
            afresh = self._remembered(cells.watched)["restart"].item() != 0.0
            at_begin, _ = parted(cells.law_at_start, of.memory)
            memory = {name: np.where(afresh, at_begin[name], memory[name]) for name in memory}
        outputs, after = stepped(block, block.outputs, inputs, memory, now)
        return outputs["generalized_force"], joined(after[name] for name in memory)

    def _others(
        self, x: Any, time: Any, *, applied_force: Any, push: Any, acted: Any
    ) -> tuple[Any, list[Any]]:
        """All forces on the plant but the last ones, at an instant, and the rates of the flows."""
        parts, _ = parted(acted, zeros(self._blocks.acted))
        rates, flown = self._flow(x, parts)
        disturbance = force_at(time, self._cells.sines.reshape(4, -1))
        force = traced(np.zeros(self._blocks.tree.num_velocities))
        force[list(self._blocks.forced)] = applied_force + disturbance
        if self._blocks.has_slow:
            force = force + push
        for outputs in self._touches.values():
            force = self._along(force, outputs)
        for name in filter(flown.__contains__, BESIDES):
            force = self._along(force, {"generalized_force": flown[name]})
        return force, rates

    def _last(self, x: Any, time: Any, others: Any) -> list[dict[str, Any]]:
        """Outputs of the last forces."""
        if not self._blocks.parts["last"]:
            return []
        force = others[list(self._blocks.forced)]
        signals = self._states(x) | {"other_force": force, "time": traced([time])}
        corrections, _ = parted(self._cells.corrected, zeros(self._blocks.corrects))
        found = list[dict[str, Any]]()
        for name, block in self._parts["last"].items():
            inputs = signals | {"correction": corrections.get(name)}
            outputs, _ = block.flow(read(block, inputs), {})
            found.append({each: traced(values) for each, values in outputs.items()})
        return found

    def _corrections(self) -> list[Any]:
        """What the last forces correct from a sample on."""
        signals = self._states(self._x)
        return [self._parts["last"][name].correct(signals) for name in self._blocks.corrects]


def _at_instant(outputs: Mapping[str, Any], name: str) -> Any:
    """A force at a sample, for the record."""
    return outputs.get(NEXT + name, outputs[name])
