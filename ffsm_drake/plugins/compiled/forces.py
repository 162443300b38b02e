"""The forces on the plant on symbols: at a sample, and at an instant of the integrator."""

import functools

import numpy as np

from ffsm_drake.loop.blocks import ADDED_FORCES
from ffsm_drake.plugins.compiled.instant import Instant, Made
from ffsm_drake.plugins.compiled.parts import at_start
from ffsm_drake.plugins.compiled.stepping import joined, parted, read, zeros
from ffsm_drake.plugins.equations import equations
from ffsm_drake.plugins.tape.arrays import traced
from ffsm_drake.plugins.tape.numbers import NotTraceable
from ffsm_drake.systems.disturbance import force_at
from ffsm_drake.systems.sampled import NEXT, Arrays, Now

# Outputs of forces, and the entries of the plant's v that they are along.
_OF_FORCES = {"generalized_force": "forced", "hidden_force": "loose"}


class Forces(Instant):
    """The forces of a loop at an instant."""

    def derivative(self) -> Made:
        """The rates of the plant's state, and of the flows'."""
        cells, of, state = self.cells, self.blocks, self.alive(self.cells.state)
        q, v = np.split(state[: self.num_plant], [of.tree.num_positions])
        time, held = cells.t[0], {name: getattr(cells, name) for name in of.held}
        force, rates = self._others(state, time, **held)
        for each in self._last(state, time, force):
            force = self._along(force, each)
        of_plant = traced(equations.derivative(of.tree, q, v, force, cells.own))
        return {"rates": joined([of_plant, *rates])}

    def touching(self) -> Made:
        """What becomes of forces that step several times, at an instant at which they step."""
        signals, touches, made = self.states(self.x), self._touches, list[np.ndarray]()
        for placed, block in self.sampled("forces"):
            if placed.cell != "touched":
                continue
            if block.per_sample:
                outputs = self.step(placed, block, signals, Now(self.cells.t0[0]))
            else:
                outputs = touches[placed.name]
                self.keep(placed)
            made += [outputs[port] for port in self.blocks.touches[placed.name]]
        return self.unless_lost({"touch": joined(made), "touched": self.kept("touched")})

    def at_sample(self, now: Now, measured: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The forces of a sample: those of this instant and those that are held. What they show is
        noted among the signals.
        """
        of, cells = self.blocks, self.cells
        each = [traced(force_at(now.time, cells.sines.reshape(4, -1)))]
        held = traced(np.zeros(of.nv + len(of.loose)))
        on_hidden = traced(np.zeros(len(of.loose)))
        signals, touches = self.states(self.x), self._touches
        for placed, block in self.sampled("forces"):
            if (found := touches.get(placed.name, {})) == {}:
                found = self.step(placed, block, signals, now)
                if unknown := {name.removeprefix(NEXT) for name in found} - _OF_FORCES.keys():
                    raise NotTraceable(f"{type(block).__name__} with an output {min(unknown)}")
                held = self._along(held, found)
            each.append(_at_instant(found, "generalized_force"))
            if "hidden_force" in found:
                on_hidden = on_hidden + _at_instant(found, "hidden_force")
        if of.parts.last:
            before, _ = parted(cells.held_before, zeros(of.held))
            others = self._others(self.x, now.time, **before)[0]
            for outputs in self._last(self.x, now.time, others):
                each.append(outputs["generalized_force"])
                if "hidden_force" in outputs:
                    on_hidden = on_hidden + outputs["hidden_force"]
                measured |= {name: outputs[name] for name in of.shown_last if name in outputs}
        return {
            "shown_last": joined(measured[name] for name in of.shown_last),
            "corrected_after": joined(self._corrections()),
            "disturbance_force": functools.reduce(np.add, each),
            "each_force": joined(each if of.external else ()),
            "push": held if of.has_slow else traced([]),
            "hidden_push": on_hidden if of.pushes_hidden else traced([]),
        }

    def _along(self, force: np.ndarray, outputs: Arrays) -> np.ndarray:
        """A force on the plant with the outputs of another one."""
        for name in _OF_FORCES.keys() & outputs.keys():
            entries = list(getattr(self.blocks, _OF_FORCES[name]))
            force[entries] = force[entries] + outputs[name]
        return force

    @functools.cached_property
    def _touches(self) -> dict[str, dict[str, np.ndarray]]:
        """The held outputs of forces that do not step once."""
        found = dict[str, dict[str, np.ndarray]]()
        if self.blocks.touches:
            values = self.cells.touch
            for name, outputs in self.blocks.touches.items():
                found[name], values = parted(values, outputs)
        return found

    def flow(self, x: np.ndarray, held: Arrays) -> tuple[list[np.ndarray], dict[str, np.ndarray]]:
        """The rates of the flows' states at an instant, and their outputs.

        Args: the plant's state and theirs; held outputs of actuators, none at a sample.
        """
        rates, found = list[np.ndarray](), dict[str, np.ndarray]()
        signals, values = self.states(x) | {**held}, x[self.num_plant :]
        for name, flow in self.blocks.parts.flows.items():
            own, values = parted(values, at_start(flow))
            given = read(flow, zeros(flow.inputs) | signals)
            outputs, changes = self.parts.flows[name].flow(given, own)
            found |= {name: traced(value) for name, value in outputs.items()}
            rates += [traced(changes[name]) for name in own]
        return rates, found

    def _others(
        self,
        x: np.ndarray,
        time: np.ndarray,
        *,
        applied_force: np.ndarray,
        push: np.ndarray,
        acted: np.ndarray,
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """All forces on the plant but the last ones, at an instant, and the rates of the flows."""
        parts, _ = parted(acted, zeros(self.blocks.acted))
        rates, flown = self.flow(x, parts)
        disturbance = force_at(time, self.cells.sines.reshape(4, -1))
        force = traced(np.zeros(self.blocks.tree.num_velocities))
        force[list(self.blocks.forced)] = applied_force + disturbance
        if self.blocks.has_slow:
            force = force + push
        for outputs in self._touches.values():
            force = self._along(force, outputs)
        for name in filter(flown.__contains__, ADDED_FORCES):
            force = self._along(force, {"generalized_force": flown[name]})
        return force, rates

    def _last(
        self, x: np.ndarray, time: np.ndarray, others: np.ndarray
    ) -> list[dict[str, np.ndarray]]:
        """Outputs of the last forces."""
        if not self.blocks.parts.last:
            return []
        signals = self.states(x) | {"time": traced([time])}
        corrections, _ = parted(self.cells.corrected, zeros(self.blocks.corrects))
        last, found = self.parts.last, dict[str, dict[str, np.ndarray]]()
        for name in sorted(last, key=lambda name: "other_force" in last[name].inputs):
            inputs = signals | {"other_force": others, "correction": corrections.get(name)}
            outputs, _ = last[name].flow(read(last[name], inputs), {})
            found[name] = {each: traced(values) for each, values in outputs.items()}
            signals |= found[name]
            if "other_force" not in last[name].inputs:
                others = self._along(others.copy(), found[name])
        return [found[name] for name in last]

    def _corrections(self) -> list[np.ndarray]:
        """What the last forces correct from a sample on."""
        signals = self.states(self.x)
        return [self.parts.last[name].correct(signals) for name in self.blocks.corrects]


def _at_instant(outputs: Arrays, name: str) -> np.ndarray:
    """A force at a sample, for the record."""
    return outputs.get(NEXT + name, outputs[name])
