"""A block that acts at every instant, as pure functions on arrays, and the Drake system around it.

The plug-in ``compiled`` evaluates the functions on its own symbols.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.systems.sampled import Arrays, BlockSystem, DividedSystem

_CORRECTION = "correction"


class Continuous:
    """A block with a continuous state. A subclass is a frozen dataclass; see ``Sampled``."""

    @property
    def inputs(self) -> Mapping[str, int]:
        """Its input ports, by name: numbers in each."""
        return {}

    @property
    def outputs(self) -> Mapping[str, int]:
        """Its output ports, likewise."""
        return {}

    @property
    def entries(self) -> Mapping[str, Sequence[int]]:
        """Entries of an input that ``flow`` reads, if not all."""
        return {}

    def start(self, state: np.ndarray | None = None) -> Arrays:
        """Its own state at the start, by name: vectors.

        Args: [q; v] (nq + nv) of the spacecraft then, if it is known.
        """
        return {}

    def flow(self, inputs: Arrays, state: Arrays) -> tuple[Arrays, Arrays]:
        """Return the outputs at an instant, and the rates of its own state."""
        raise NotImplementedError(f"{type(self).__name__} has no flow")

    def correct(self, inputs: Arrays) -> Any:
        """Return the input ``correction``, which is no port, from a control sample on."""
        raise NotImplementedError(f"{type(self).__name__} has no correction")


class InstantSystem(DividedSystem):
    """The Drake system of a ``Continuous`` block without a state of its own, which is called at the
    stages of the integrator. Its input ``time`` is no port.

    A block that depends on the true payload has a method ``with_payload``, see ``Sampled``.
    """

    def __init__(self, block: Continuous, *, name: str, sample_time: float = 0.0) -> None:
        """Args: the block; name of the system; control period of a correction, s."""
        own = _Flowing(block, sample_time)
        own.set_name(f"{name}_at_instants")
        super().__init__(name, own, list(block.outputs.values()), list(block.outputs))

    def exchange(self, block: Continuous) -> None:
        """Put another block with the same ports in its place."""
        self._own.exchange(block)

    def block_at(self, context: Context) -> Any:
        """Return the block with the payload of a context."""
        return self._own.block_at(self.GetSubsystemContext(self._own, context))


class _Flowing(BlockSystem):
    """The function of ``InstantSystem``; one output with the block's outputs."""

    def __init__(self, block: Continuous, sample_time: float) -> None:
        super().__init__(block)
        self._ports = {
            each: self.DeclareVectorInputPort(each, size)
            for each, size in block.inputs.items()
            if each not in ("time", _CORRECTION)
        }
        reads = {self.input_port_ticket(port.get_index()) for port in self._ports.values()}
        self._reads_time = "time" in block.inputs
        if self._reads_time:
            reads.add(self.time_ticket())
        if self._loaded:
            reads.add(self.all_parameters_ticket())
        self._corrects = _CORRECTION in block.inputs
        if self._corrects:
            reads.add(self.xd_ticket())
            self.DeclareDiscreteState(block.inputs[_CORRECTION])
            self.DeclarePeriodicDiscreteUpdateEvent(sample_time, 0.0, weak_callback(self._correct))
        self._names = tuple(block.outputs)
        size = sum(block.outputs.values())
        self.DeclareVectorOutputPort("result", size, weak_callback(self._calc), reads)
        untie(self)

    def _inputs(self, context: Context) -> Arrays:
        inputs = {each: port.Eval(context) for each, port in self._ports.items()}
        if self._reads_time:
            inputs["time"] = np.array([context.get_time()])
        if self._corrects:
            inputs[_CORRECTION] = context.get_discrete_state_vector().value()
        return inputs

    def _calc(self, context: Context, output: BasicVector) -> None:
        found, _ = self.block_at(context).flow(self._inputs(context), {})
        output.SetFromVector(np.concatenate([found[name] for name in self._names]))

    def _correct(self, context: Context, values: DiscreteValues) -> None:
        values.set_value(self.block_at(context).correct(self._inputs(context)))
