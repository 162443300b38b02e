"""A part in its block, with its signals checked against the block's ports; its figures in a run."""

import dataclasses
from collections.abc import Iterator, Mapping

from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import calling
from ffsm_drake.systems.parts.metrics import Figure
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Constant, Signal, View, problems_of
from ffsm_drake.systems.setup import BlockSetup


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedPart:
    """A part in its block."""

    name: str  # name of the part: its block's, or that of a scenario's section
    block: str  # block with the ports of its signals
    part: Part
    signals: tuple[Signal, ...]
    constants: tuple[Constant, ...] = ()

    @property
    def title(self) -> str:
        """Heading of its rows and panels. Raises BlockError if it is not text."""
        title: object = self.part.title
        kind = type(self.part).__name__
        if not isinstance(title, str):
            problem = f"title must be text, not {type(title).__name__}"
            raise BlockError(f"blocks.{self.name} '{kind}': {problem}")
        return title or kind


Parts = Mapping[str, PlacedPart]  # by name


def place_part(
    part: Part,
    setup: BlockSetup,
    system: System | None,
    *,
    name: str,
    block: str,
) -> PlacedPart:
    """Place a part with its signals, checked against the system in its block. Raises
    BlockError.
    """
    place = f"blocks.{name} '{type(part).__name__}'"
    signals = tuple(part.signals(setup))
    if block.startswith("sensing"):  # recorded as the controller reads it, at its samples
        signals = tuple(dataclasses.replace(signal, held=True) for signal in signals)
    for signal in signals:
        for problem in problems_of(signal, setup.coordinates.num_velocities):
            raise BlockError(f"{place}: {problem}")
        if signal.of is not None:
            continue
        if system is None or not system.HasOutputPort(signal.name):
            raise BlockError(f"{place}: signal '{signal.name}' needs an output port of that name")
        size = system.GetOutputPort(signal.name).size()
        if size != signal.size:
            raise BlockError(
                f"{place}: output port '{signal.name}' must have size {signal.size}, as its signal "
                f"has components, not {size}"
            )
    constants = tuple(part.constants(setup))
    return PlacedPart(name=name, block=block, part=part, signals=signals, constants=constants)


def with_role(parts: Parts, role: str) -> list[str]:
    """Return names of the signals that have a role."""
    return [signal.name for signal in signals_of(parts) if signal.role == role]


def signals_of(parts: Parts) -> Iterator[Signal]:
    """Signals of all parts."""
    for placed in parts.values():
        yield from placed.signals


def figures_of(placed: PlacedPart, view: View) -> Iterator[Figure]:
    """The figures of merit of a part in a run.

    Raises BlockError: a metric fails or does not give a number.
    """
    for metric in placed.part.metrics():
        place = f"blocks.{placed.name} '{type(placed.part).__name__}': metric '{metric.key}'"
        value = calling(place, lambda metric=metric: metric.value_in(view))
        if isinstance(value, Mapping) and metric.column_name:
            raise BlockError(f'{place} gives values by name, which no column holds: say column=""')
        yield metric.figure(value, placed.title)
