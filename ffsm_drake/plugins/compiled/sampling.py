"""A control sample of a loop on symbols: sensing, the law, the supervisor, and actuation.

The law is the very object of the scenario, with symbols in place of its numbers (``parameters``).
A law or detector that is called instead (``called``) stands between two functions of a sample.
"""

import numpy as np

from ffsm_drake.loop.blocks import TOLD
from ffsm_drake.plugins.compiled.forces import Forces
from ffsm_drake.plugins.compiled.instant import Made
from ffsm_drake.plugins.compiled.models import traced_model
from ffsm_drake.plugins.compiled.parameters import with_symbols
from ffsm_drake.plugins.compiled.stepping import joined, parted, stepped, zeros
from ffsm_drake.plugins.equations.errors import tracking_errors
from ffsm_drake.plugins.tape.arrays import traced
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.systems.controllers.law_block import LawBlock
from ffsm_drake.systems.quantization import quantize
from ffsm_drake.systems.sampled import Arrays, Now


class Sampling(Forces):
    """A control sample of a loop."""

    def sample(self, *, is_first: bool) -> Made:
        """A sample, which is a first one for the law or not."""
        now = Now(self.cells.t0[0], is_first=is_first)
        signals, made = self._measured(now)
        force, memory = self._control(signals, now)
        made |= {"generalized_force": force, "memory_after": memory}
        return made | self._given(force, now, made["push"], made["watched_after"])

    def sensed(self) -> Made:
        """Of a sample, what comes before the call of the law or detector."""
        signals, made = self._measured(Now(self.cells.t0[0]))
        if self.blocks.tells_new:
            made["is_new"] = signals["measurement_is_new"]
        if self.blocks.gyrates:
            held, _ = parted(self.cells.held_before, zeros(self.blocks.held))
            acted, _ = parted(held["acted"], zeros(self.blocks.acted))
            made["gyroscopic"] = self.flow(self.x, acted)[1]["gyroscopic_force"]
        return made

    def acted(self) -> Made:
        """Of a sample, what comes after the call of the law."""
        cells = self.cells
        force, now = cells.generalized_force, Now(cells.t0[0])
        return self._given(force, now, cells.push, cells.watched_after)

    def decided(self, *, is_first: bool) -> Made:
        """Of a sample, what comes after the call of the detector, with the law."""
        cells, now = self.cells, Now(self.cells.t0[0], is_first=is_first)
        signals = {
            name: getattr(cells, cell)[first : first + size]
            for name, (cell, first, size) in self.blocks.law_inputs.items()
        }
        force, memory = self._control(signals, now)
        made = {"generalized_force": force, "memory_after": memory}
        return made | self._given(force, now, cells.push, cells.watched_after)

    def _measured(self, now: Now) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """The signals that the law can read, and results of the sample."""
        of, cells, nx = self.blocks, self.cells, self.blocks.nq + self.blocks.nv
        known, hidden = self.states(self.x).values()
        signals = {"state": known, "true_state": known, "drift": cells.drift}
        if of.noisy:
            signals["white"] = cells.deviation * cells.noise
        for placed, stage in self.sampled("sensing"):
            outputs = self.step(placed, stage, signals, now)
            signals |= outputs | {"state": outputs["estimated_state"]}
        plan = {
            "desired_state": cells.reference[:nx], "desired_acceleration": cells.reference[nx:],
            **({"desired_frame": cells.frame} if of.framed else {}),
        }  # fmt: skip
        signals |= (
            plan if of.watch is None else of.watch.follow(self.remembered(cells.watched), plan)
        )
        return signals, {
            "known": known,
            "hidden": hidden,
            "measurement": signals["estimated_state"],
            "drift_after": cells.share * cells.drift + cells.added * cells.drift_noise,
            **self.at_sample(now, signals),
            **self._watched(signals, now),
            "stored_after": self.kept("stored"),
        }

    def _control(self, signals: Arrays, now: Now) -> tuple[np.ndarray, np.ndarray]:
        """The force and the law's memory after a sample."""
        of, cells = self.blocks, self.cells
        law = with_symbols(of.law, cells.law, cells.planned, traced_model)
        block = LawBlock(law, of.coordinates, errors=tracking_errors)
        signals = {**signals, "applied_force": cells.applied}
        inputs = {name: signals[name] for name in block.inputs if signals.get(name) is not None}
        memory, _ = parted(cells.memory, of.memory)
        if of.watch is not None and now.is_first:
            afresh = self.remembered(cells.watched)["restart"].item() != 0.0
            at_begin, _ = parted(cells.law_at_start, of.memory)
            memory = {name: np.where(afresh, at_begin[name], memory[name]) for name in memory}
        outputs, after = stepped(block, block.outputs, inputs, memory, now)
        return outputs["generalized_force"], joined(after[name] for name in memory)

    def _given(
        self, force: np.ndarray, now: Now, push: np.ndarray, watched: np.ndarray
    ) -> dict[str, np.ndarray]:
        """What becomes of the law's force."""
        of, cells, commanded = self.blocks, self.cells, force
        if of.watch is not None:
            force = of.watch.give(self.remembered(watched), force)
        given = force
        if of.limited:
            force = np.minimum(np.maximum(force, -cells.limit), cells.limit)
        if of.quantized:
            force = quantize(force, cells.force_resolution)
        waiting = np.concatenate([force, cells.waiting])  # newest first
        _, flown = self.flow(self.x, {})
        signals = {**self.states(self.x), **flown}
        signals["isolated"] = np.zeros(of.found("isolated"))  # a call ends the run before
        force = waiting[-of.nv :]
        for placed, block in self.sampled("actuation"):
            command, applied = next(iter(block.inputs)), next(iter(block.outputs))
            signals |= self.step(placed, block, signals | {command: force}, now)
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
            "loaded_after": self.kept("loaded"),
            "held_after": joined([force, push, *acted] if holds else ()),
            **({} if of.watch is None else {"commanded_after": commanded, "given": given}),
        }

    def _watched(self, signals: Arrays, now: Now) -> dict[str, np.ndarray]:
        """What the supervisor does."""
        cells, of = self.cells, self.blocks
        if of.watch is None:
            return {"watched_after": traced([])}
        request = np.concatenate([cells.request, cells.requested]).sum(keepdims=True)
        given = {"generalized_force": cells.commanded, "abort_request": request}
        ((placed, watch),) = self.sampled("supervisor")
        found = self.step(placed, watch, {**signals, **given}, now)
        after, asks = self.kept("watched"), found["asks"]
        if of.num_planned:  # of a plan that follows from what is measured now
            goes_on = self.remembered(after)["restart"] != 0.0
            goes_on = goes_on & (self.remembered(cells.watched)["answer"] == 0.0)
            asks = np.where((asks == 0.0) & goes_on, 2.0, asks)
        return {
            "mode": joined([found["mode"], found["mode_cause"]]), "asks": asks,
            "followed": joined([signals[name] for name in of.desired]),
            "watched_after": after,
            # the call of a detector writes it
            **({} if of.detector is None else {"requested_after": cells.requested}),
        }  # fmt: skip
