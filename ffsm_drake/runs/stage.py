"""The loop of a phase at an instant of a run, as kinds of phases see it."""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.sampled import Arrays


class Stage:
    """The loop of a phase at an instant: its state, and what a phase can change at its begin.

    This class is for Drake. Another engine derives its own.
    """

    def __init__(self, loop: ClosedLoop, root: Context) -> None:
        """Args: a loop on Drake, and a context of its diagram."""
        self.loop, self.root = loop, root

    @property
    def coordinates(self) -> Coordinates:
        """Of the known state."""
        return self.loop.coordinates

    @property
    def blocks(self) -> Mapping[str, Any]:
        """The blocks by name."""
        return self.loop.blocks

    @property
    def state(self) -> np.ndarray:
        """The plant's own [q; v]."""
        return self.loop.whole_state(self.root)

    @property
    def measured(self) -> np.ndarray:
        """The state [q; v] that the servicer measures."""
        return self._output("estimated_state")

    @property
    def desired(self) -> np.ndarray:
        """The state [q_d; v_d] of the reference."""
        return self._output("desired_state")

    def model(self) -> PlantModel:
        """Return the true plant of the scenario, in a context of its own."""
        return self.loop.mission.craft.flexible(self.loop.grip)

    def context(self, block: str) -> Context:
        """Return the context of a block that is a Drake system."""
        return self.loop.blocks[block].GetMyMutableContextFromRoot(self.root)

    def block(self, name: str) -> Any:
        """Return a ``Sampled`` block, or the contacts."""
        return self.loop.blocks[name].block

    def exchange(self, name: str, block: Any) -> None:
        """Put contacts with the same ports in their place, before ``place``."""
        self.loop.blocks[name].exchange(block)

    def memory(self, block: str) -> Arrays:
        """Return the memory of a ``Sampled`` block."""
        return self.loop.blocks[block].memory(self.context(block))

    def remember(self, block: str, memory: Arrays) -> None:
        """Set the memory of a ``Sampled`` block."""
        self.loop.blocks[block].remember(self.context(block), memory)

    def place(self, state: np.ndarray) -> None:
        """Set the plant's own [q; v], and reset the blocks to this state."""
        self.loop.set_whole_state(self.root, state)

    def carry(self, payload: MassProperties) -> None:
        """Set the payload's true mass properties."""
        self.loop.set_payload(self.root, payload)

    def resume(
        self,
        before: Any,
        reference: np.ndarray | None = None,
        *,
        afresh: Collection[str] = (),
    ) -> None:
        """Continue with the states of the blocks of ``before``, the stage of the last phase at its
        end. Other arguments: see ``ClosedLoop.resume``.
        """
        self.loop.resume(self.root, before.loop, before.root, reference, afresh=afresh)

    def _output(self, name: str) -> np.ndarray:
        return self.loop.diagram.GetOutputPort(name).Eval(self.root)
