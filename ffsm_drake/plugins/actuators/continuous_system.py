"""The Drake system of a block that acts at every instant and has a state.

It evaluates the functions of the block once on Drake's symbolic expressions, so that no Python runs
at the stages of the integrator.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydrake.symbolic import MakeVectorVariable
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Demultiplexer, SymbolicVectorSystem

from ffsm_drake.systems.continuous import Continuous
from ffsm_drake.systems.selection import make_selector
from ffsm_drake.systems.setup import CompositeBlock


class ContinuousSystem(CompositeBlock):
    """The Drake system of a ``Continuous`` block."""

    def __init__(self, block: Continuous, *, name: str) -> None:
        """Args: the block; name of the system with the state."""
        start = block.start()
        read = {each: block.entries.get(each, range(n)) for each, n in block.inputs.items()}
        given = {each: MakeVectorVariable(len(of), each) for each, of in read.items()}
        states = {each: MakeVectorVariable(value.size, each) for each, value in start.items()}
        with np.errstate(all="ignore"):  # Drake's expressions may leave flags behind
            outputs, rates = block.flow(given, states)
        own = SymbolicVectorSystem(
            input=_joined(given, read),
            state=_joined(states, states),
            dynamics=_joined(rates, states),
            output=_joined(outputs, block.outputs),
        )
        places = [(index, entry) for index, of in enumerate(read.values()) for entry in of]
        parts = {f"y{index}": each for index, each in enumerate(block.outputs)}
        super().__init__(
            name,
            {
                "inputs": make_selector(block.inputs, {"read": places}),
                name: own,
                "outputs": Demultiplexer(list(block.outputs.values())),
            },
            inputs=block.inputs,
            outputs=block.outputs,
            signals={name: {"u0": "read", "y0": "result"}, "outputs": {"u0": "result", **parts}},
        )
        self._block, self._own = block, own

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The spacecraft is at ``state`` [q; v]."""
        own = self.GetMutableSubsystemContext(self._own, context)
        own.SetContinuousState(np.concatenate([*self._block.start(state).values()]))


def _joined(values: Mapping[str, Any], names: Iterable[str]) -> Any:
    return np.concatenate([np.zeros(0), *(values[name] for name in names)])
