"""A block that acts at every instant, as pure functions on arrays, and the Drake system around it.

``ContinuousSystem`` evaluates the functions once on Drake's symbolic expressions, so that no Python
runs at the stages of the integrator. The plug-in ``compiled`` evaluates them on its own symbols.
"""

import functools
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.symbolic import MakeVectorVariable
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Demultiplexer, SymbolicVectorSystem

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import MassProperties
from ffsm_drake.systems.sampled import Arrays
from ffsm_drake.systems.selection import make_selector


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


class InstantSystem(LeafSystem):
    """The Drake system of a ``Continuous`` block without a state of its own, which is called at the
    stages of the integrator. Its input ``time`` is no port.

    A block that depends on the true payload has a method ``with_payload``, see ``Sampled``.
    """

    def __init__(self, block: Continuous, *, name: str) -> None:
        """Args: the block, and the name of the system."""
        super().__init__()
        self._block: Any = block
        self._ports = {
            each: self.DeclareVectorInputPort(each, size)
            for each, size in block.inputs.items()
            if each != "time"
        }
        calc = weak_callback(self._calc)
        for each, size in block.outputs.items():
            self.DeclareVectorOutputPort(each, size, functools.partial(calc, each))
        untie(self)
        self.set_name(name)

    def set_payload(self, context: Context, properties: MassProperties) -> None:
        """Give the payload other mass properties."""
        if hasattr(self._block, "with_payload"):
            self._block = self._block.with_payload(properties)

    def _calc(self, name: str, context: Context, output: BasicVector) -> None:
        inputs = {each: port.Eval(context) for each, port in self._ports.items()}
        found, _ = self._block.flow({**inputs, "time": np.array([context.get_time()])}, {})
        output.SetFromVector(found[name])


class ContinuousSystem(Diagram):
    """The Drake system of a ``Continuous`` block for each of several copies of the spacecraft;
    ports hold copy after copy.
    """

    def __init__(self, block: Continuous, *, name: str, copies: int = 1) -> None:
        """Args: the block; name of the system with the state; number of copies."""
        super().__init__()
        self._block, start = block, block.start()
        read = {each: block.entries.get(each, range(n)) for each, n in block.inputs.items()}
        given = {each: _variables(len(of), copies, each) for each, of in read.items()}
        states = {each: _variables(value.size, copies, each) for each, value in start.items()}
        outputs, rates = dict[str, list[Any]](), dict[str, list[Any]]()
        for copy in range(copies):
            symbols = [
                {each: values[copy] for each, values in of.items()} for of in (given, states)
            ]
            with np.errstate(all="ignore"):  # Drake's expressions may leave flags behind
                found, changes = block.flow(*symbols)
            for to, values in ((outputs, found), (rates, changes)):
                for each, own in values.items():
                    to.setdefault(each, []).extend(own)
        self._own = SymbolicVectorSystem(
            input=_joined(given),
            state=_joined(states),
            dynamics=[*itertools.chain(*(rates[each] for each in states))],
            output=[*itertools.chain(*(outputs[each] for each in block.outputs))],
        )
        builder = DiagramBuilder()
        sizes = {each: copies * n for each, n in block.inputs.items()}
        places = [
            (index, copy * block.inputs[each] + entry)
            for index, (each, of) in enumerate(read.items())
            for copy in range(copies)
            for entry in of
        ]
        inputs = builder.AddNamedSystem("inputs", make_selector(sizes, {"read": places}))
        builder.AddNamedSystem(name, self._own)
        widths = [copies * n for n in block.outputs.values()]
        parts = builder.AddNamedSystem("outputs", Demultiplexer(widths))
        builder.Connect(inputs.get_output_port(), self._own.get_input_port())
        builder.Connect(self._own.get_output_port(), parts.get_input_port())
        for index, each in enumerate(block.inputs):
            builder.ExportInput(inputs.get_input_port(index), each)
        for index, each in enumerate(block.outputs):
            builder.ExportOutput(parts.get_output_port(index), each)
        builder.BuildInto(self)

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The spacecraft is at ``state`` [q; v]; of several copies, rows."""
        made = [self._block.start(row) for row in np.atleast_2d(state)]
        values = [of[name] for name in made[0] for of in made]
        own = self.GetMutableSubsystemContext(self._own, context)
        own.SetContinuousState(np.concatenate(values))


def _variables(size: int, copies: int, name: str) -> Any:
    return MakeVectorVariable(size * copies, name).reshape(copies, size)


def _joined(values: Mapping[str, Any]) -> Any:
    return np.concatenate([np.zeros(0), *(each.ravel() for each in values.values())])
