"""The loop of a phase in a compiled run, as kinds of phases see it."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from ffsm_drake.plugins.compiled.called import parts
from ffsm_drake.plugins.compiled.kernel import LaneEnd, LaneState
from ffsm_drake.plugins.compiled.parts import at_start, row, sizes_of, total
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.runs.stage import Stage
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.sampled import Arrays, Sampled


class LaneStage(Stage):
    """A ``Stage`` of a compiled run."""

    def __init__(self, run: Run, begin: LaneState) -> None:
        """Args: the run of a phase, and where it begins."""
        self.run, self.begin = run, begin
        self._measured = np.zeros(0)  # at its end
        own = run.case.made.reference
        # memory of the reference at the begin and at the end of the phase
        self.followed = self._followed_then = None if own is None else own.block.start()
        self.looked: Arrays | None = None  # what a detector remembers; None: its start

    @property
    def detectors(self) -> list[tuple[Sampled, Arrays]]:
        """The detector, with its memory; none without it."""
        detector = self.run.case.made.detector
        if detector is None:
            return []
        known = self.begin.cells["x"][list(self.run.blocks.known)]
        return [(detector, self.looked or detector.start(known))]

    @property
    def coordinates(self) -> Coordinates:
        """See Stage."""
        return self.run.coordinates

    @property
    def blocks(self) -> Mapping[str, Any]:
        """See Stage."""
        of = self.run.case.parts
        return {f"forces.{name}": block for name, block in {**of.forces, **of.last}.items()}

    @property
    def state(self) -> np.ndarray:
        """See Stage."""
        return self.begin.cells["x"][: self._plant]

    @property
    def measured(self) -> np.ndarray:
        """See Stage."""
        return self._measured

    @property
    def desired(self) -> np.ndarray:
        """See Stage."""
        row: np.ndarray = self.run.case.planned["reference"][self.begin.sample]
        if (made := self.run.case.made.supervisor) is not None:
            plan, period = self.memory("supervisor")["plan"], made.block.sample_time
            if plan[1] > 0.0:
                row = made.motions(plan)[0].row(
                    (self.begin.sample - round(plan[0] / period)) * period
                )
        return row[: -len(self.coordinates.names)]

    @property
    def _plant(self) -> int:
        return int(self.run.case.true.plant.num_multibody_states())

    def model(self) -> PlantModel:
        """See Stage."""
        return self.run.mission.craft.flexible(self.run.case.nominal.grip)

    def block(self, name: str) -> Any:
        """See Stage."""
        if name == "reference" and (own := self.run.case.made.reference) is not None:
            return own.block
        return self.run.case.made.supervisor if name == "supervisor" else self.blocks[name]

    def exchange(self, name: str, block: Continuous) -> None:
        """See Stage."""
        self.run = self.run.on(self.run.case.exchanging(name.removeprefix("forces."), block))

    def memory(self, block: str) -> Arrays:
        """See Stage."""
        if block == "reference" and self.followed is not None:
            return self.followed
        cell, places = self._places(block)
        return {name: self.begin.cells[cell][place] for name, place in places.items()}

    def remember(self, block: str, memory: Arrays) -> None:
        """See Stage."""
        if block == "reference":
            self.followed = memory
            return
        cell, places = self._places(block)
        values = self.begin.cells[cell].copy()
        for name, place in places.items():
            values[place] = memory[name]
        self._set({**self.begin.cells, cell: values})

    def _places(self, block: str) -> tuple[str, dict[str, slice]]:
        """The cell of a block, and the places of its memory there."""
        for each in self.run.blocks.sampled:
            if block in (f"{each.kind}.{each.name}", each.kind):
                return each.cell, parts(sizes_of(at_start(each.block)), each.first)
        return "touched", {}

    def place(self, state: np.ndarray) -> None:
        """See Stage."""
        memory = row(self.run.law.initial_state().values())
        self._set(self.run.case.states_at(state) | {"memory": memory})

    def carry(self, payload: MassProperties) -> None:
        """See Stage."""
        self.run = self.run.carrying(payload)

    def resume(
        self,
        before: "LaneStage",
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """See Stage."""
        own, plant = self.begin.cells, self._plant
        cells = dict(before.begin.cells)
        cells["x"] = np.concatenate([own["x"][:plant], cells["x"][plant:]])
        cells.pop("touch")  # zero: the gripper of the phase before has no effect
        self.looked = before.looked
        cells |= self._remembered(before, afresh)
        kept = {
            name: cells["corrected"][place]
            for name, place in parts(before.run.blocks.corrects).items()
            if f"forces.{name}" not in afresh
        }
        corrects = self.run.blocks.corrects
        cells["corrected"] = row(kept.get(name, np.zeros(n)) for name, n in corrects.items())
        first_at = before.begin.first_at
        if "controller" in afresh:
            first_at, cells["memory"] = self.begin.sample, own["memory"]
        elif reference is not None:
            first_at = self.begin.sample
            law, like = before.run.law, before.run.blocks.memory
            memory = {
                name: cells["memory"][place].reshape(like[name].shape)
                for name, place in parts(sizes_of(like)).items()
            }
            cells["memory"] = row(self.run.controller.resumed(memory, law, reference).values())
        if "reference" not in afresh and self.followed is not None:
            self.followed = before.followed or self.followed
        if (held := self.run.parameters["joint_force"]).size:  # the law reads what acts now
            cells["applied"] = np.concatenate([cells["applied"][: -held.size], held])
        self.begin = LaneState(cells, self.begin.sample, first_at)

    def _remembered(self, before: "LaneStage", afresh: Collection[str]) -> dict[str, np.ndarray]:
        """The memory of the sampled blocks by cell: from the phase before, or at the start; and
        what acted there.
        """
        found, then = dict[str, list[np.ndarray]](), before.begin.cells
        others = {(each.kind, each.name): each for each in before.run.blocks.sampled}
        for each in self.run.blocks.sampled:
            cells, first, size = self.begin.cells, each.first, total(at_start(each.block))
            other = others.get((each.kind, each.name))
            names = {each.kind, f"{each.kind}.{each.name}"}
            if other is not None and not names & {*afresh}:
                cells, first = then, other.first
            found.setdefault(each.cell, []).append(cells[each.cell][first : first + size])
        acted = parts(before.run.blocks.held) if then["held_before"].size else {}
        if self.run.blocks.keeps:
            found["held_before"] = [
                then["held_before"][acted[name]]
                if before.run.blocks.held.get(name) == size and name in acted
                else np.zeros(size)
                for name, size in self.run.blocks.held.items()
            ]
        return {name: row(values) for name, values in found.items()}

    def follow(self) -> None:
        """Compute the reference over the phase."""
        if self.followed is not None:
            self._followed_then = self.run.case.follow(self.followed)

    def leave(self, end: LaneEnd) -> None:
        """Put the stage where its phase ends."""
        self.begin, self._measured = end.state, end.measured
        self.followed = self._followed_then

    def _set(self, cells: Mapping[str, np.ndarray]) -> None:
        self.begin = self.begin._replace(cells=cells)
