"""Blocks of several copies of the spacecraft as one block; its ports hold copy after copy.

A loop of B copies (``add_closed_loop`` with B scenarios) has the wiring of one, with every port B
times as wide. A factory supports such a block by a method

    build_wide(setups) -> system, or None if these cannot be joined

with the setups of all copies; their ``settings`` are equal. Its system has the block's ports,
each ``len(setups)`` times as wide, the values of copy after copy, and gives every copy the same
bits as the factory's system for its setup alone. Optional methods of a block change accordingly:
``set_initial_state(context, states)`` gets a row for each copy, ``set_payload(context,
properties)`` a sequence; ``set_random(context, generators)`` of a random block gets each copy's
generator and draws like the system alone; ``park(context, copy)`` of a block with unstable memory
resets a copy's memory. All that a run changes is in its context, the source for the leg after a
grasp. The system around control laws is as wide as the laws (``ControlLaw.wide``).

Any other block, a user's Drake system among them, stands there once for each copy, between
cut and joined ports: ``SideBySide``.
"""

import functools
import itertools
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem,
    System,
)

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import MassProperties


class NotAlike(BlockError):
    """Blocks of several copies cannot stand side by side: their ports differ."""


class SideBySide(Diagram):
    """Systems with the same ports, one for each copy, as one system with ports for all copies."""

    def __init__(self, systems: Sequence[System], inputs: Collection[str]) -> None:
        """Args:
          systems: the systems.
          inputs: names of the input ports connected in the loop.

        Raises NotAlike: the ports of the systems differ.
        """
        super().__init__()
        self.systems = tuple(systems)
        if len({tuple(_sizes(system)) for system in systems}) > 1:
            raise NotAlike(f"{systems[0].get_name()}: the ports of the copies differ")
        builder, name = DiagramBuilder(), systems[0].get_name()
        for copy, system in enumerate(systems):
            system.set_name(f"{name}_{copy}")
            builder.AddSystem(system)
        for kind, port, size in _sizes(systems[0]):
            if kind == "input" and port in inputs:
                parts = builder.AddNamedSystem(
                    f"{port}_of_each", _Rearranged([size * len(systems)], [size] * len(systems))
                )
                builder.ExportInput(parts.get_input_port(), port)
                for copy, system in enumerate(systems):
                    builder.Connect(parts.get_output_port(copy), system.GetInputPort(port))
            elif kind == "output":
                whole = builder.AddNamedSystem(
                    f"{port}_of_all", _Rearranged([size] * len(systems), [size * len(systems)])
                )
                builder.ExportOutput(whole.get_output_port(), port)
                for copy, system in enumerate(systems):
                    builder.Connect(system.GetOutputPort(port), whole.get_input_port(copy))
        builder.BuildInto(self)
        self.set_name(name)

    def set_initial_state(self, context: Context, states: np.ndarray) -> None:
        """Each copy's spacecraft was at its row [q; v] before the start."""
        for system, state in zip(self.systems, states, strict=True):
            if hasattr(system, "set_initial_state"):
                system.set_initial_state(self._of(system, context), state)

    def set_payload(self, context: Context, properties: Sequence[MassProperties]) -> None:
        """Each copy's true payload."""
        for system, own in zip(self.systems, properties, strict=True):
            if hasattr(system, "set_payload"):
                system.set_payload(self._of(system, context), own)

    def set_random(self, context: Context, generators: Sequence[RandomGenerator]) -> None:
        """Draw each copy's random state and parameters."""
        for system, generator in zip(self.systems, generators, strict=True):
            system.SetRandomContext(self._of(system, context), generator)

    def park(self, context: Context, copy: int) -> None:
        """Put a copy's memory to its defaults."""
        system = self.systems[copy]
        own = self._of(system, context)
        own.SetStateAndParametersFrom(self._at_start[copy])

    @functools.cached_property
    def _at_start(self) -> list[Context]:
        return [system.CreateDefaultContext() for system in self.systems]

    def each(self, context: Context) -> list[tuple[System, Context]]:
        """Return the systems, each with its own context."""
        return [(system, self._of(system, context)) for system in self.systems]

    def _of(self, system: System, context: Context) -> Context:
        return self.GetMutableSubsystemContext(system, context)


class _Rearranged(LeafSystem):
    """Vectors cut or joined: as outputs, the entries of the inputs in turn. What is held stays so
    within a step, while Drake's own depend on time and would compute actuators again at its stages.
    """

    def __init__(self, inputs: Sequence[int], outputs: Sequence[int]) -> None:
        super().__init__()
        self._inputs = [self.DeclareVectorInputPort(f"u{i}", n) for i, n in enumerate(inputs)]
        read = {self.input_port_ticket(port.get_index()) for port in self._inputs}
        ends = np.cumsum([0, *outputs]).tolist()
        for index, ends_of in enumerate(itertools.pairwise(ends)):
            calc = functools.partial(weak_callback(self._calc), slice(*ends_of))
            self.DeclareVectorOutputPort(f"y{index}", outputs[index], calc, read)
        untie(self)

    def _calc(self, within: slice, context: Context, output: BasicVector) -> None:
        parts = [port.Eval(context) for port in self._inputs]
        whole = np.concatenate(parts) if len(parts) > 1 else parts[0]
        output.SetFromVector(whole[within])


def _sizes(system: Any) -> list[tuple[str, str, int]]:
    """Return every port of a system: input or output, name, size."""
    return [
        (kind, port.get_name(), port.size())
        for kind, count, at in (
            ("input", system.num_input_ports(), system.get_input_port),
            ("output", system.num_output_ports(), system.get_output_port),
        )
        for port in map(at, range(count))
    ]
