"""The loop of a phase at an instant of a run, as kinds of phases see it."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, Protocol

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.sampled import Arrays


class Stage(Protocol):
    """A loop at an instant: its state, and what a phase can change where it begins."""

    @property
    def coordinates(self) -> Coordinates:
        """Of the known state."""

    @property
    def blocks(self) -> Mapping[str, Any]:
        """The blocks by name."""

    @property
    def state(self) -> np.ndarray:
        """The plant's own [q; v]."""

    @property
    def measured(self) -> np.ndarray:
        """The state [q; v] that the servicer measures."""

    @property
    def desired(self) -> np.ndarray:
        """The state [q_d; v_d] of the reference."""

    def model(self) -> PlantModel:
        """Return the true plant of the scenario, in a context of its own."""

    def context(self, block: str) -> Context:
        """Return the context of a block that is a Drake system."""

    def block(self, name: str) -> Any:
        """Return a ``Sampled`` block."""

    def memory(self, block: str) -> Arrays:
        """Return the memory of a ``Sampled`` block."""

    def remember(self, block: str, memory: Arrays) -> None:
        """Set the memory of a ``Sampled`` block, with held outputs of zero."""

    def place(self, state: np.ndarray) -> None:
        """Put the plant to its own [q; v], and reset the blocks to it."""

    def carry(self, payload: MassProperties) -> None:
        """Set the payload's true mass properties."""

    def resume(
        self,
        before: Any,
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """Continue with the states of the blocks of the last phase's stage ``before``; other
        arguments as of ``ClosedLoop.resume``.
        """


@dataclasses.dataclass(frozen=True)
class DrakeStage:
    """A ``Stage`` on Drake."""

    loop: ClosedLoop
    root: Context  # of the loop's diagram

    @property
    def coordinates(self) -> Coordinates:
        """See Stage."""
        return self.loop.coordinates

    @property
    def blocks(self) -> Mapping[str, Any]:
        """See Stage."""
        return self.loop.blocks

    @property
    def state(self) -> np.ndarray:
        """See Stage."""
        return self.loop.whole_state(self.root)

    @property
    def measured(self) -> np.ndarray:
        """See Stage."""
        return self._output("estimated_state")

    @property
    def desired(self) -> np.ndarray:
        """See Stage."""
        return self._output("desired_state")

    def model(self) -> PlantModel:
        """See Stage."""
        return self.loop.true_model(self.loop.scenario)

    def context(self, block: str) -> Context:
        """See Stage."""
        return self.loop.blocks[block].GetMyMutableContextFromRoot(self.root)

    def block(self, name: str) -> Any:
        """See Stage."""
        return self.loop.blocks[name].block

    def memory(self, block: str) -> Arrays:
        """See Stage."""
        found: Arrays = self.loop.blocks[block].memory(self.context(block))
        return found

    def remember(self, block: str, memory: Arrays) -> None:
        """See Stage."""
        self.loop.blocks[block].remember(self.context(block), memory)

    def place(self, state: np.ndarray) -> None:
        """See Stage."""
        self.loop.set_whole_state(self.root, state)

    def carry(self, payload: MassProperties) -> None:
        """See Stage."""
        self.loop.set_payload(self.root, payload)

    def resume(
        self,
        before: "DrakeStage",
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """See Stage."""
        self.loop.resume(self.root, before.loop, before.root, reference, afresh=afresh)

    def _output(self, name: str) -> np.ndarray:
        found: np.ndarray = self.loop.diagram.GetOutputPort(name).Eval(self.root)
        return found
