"""The contract of a part: what fills a block of the closed loop says of itself what everything else
is derived from.

A part is a frozen dataclass whose fields are settings (``common.settings.setting``). From it come
the checks of ``blocks.<name>.settings``, the ports, the variables of the record, the panels of the
report, the figures in ``metrics.json`` and the tables, the columns of campaigns, and what the
linearisation wires in its place.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Protocol

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.setup import BlockSetup


class View(Protocol):
    """A run, as the figures of a part see it."""

    @property
    def scenario(self) -> Scenario: ...

    @property
    def time(self) -> np.ndarray:
        """Control samples (n,), s."""

    def __getitem__(self, name: str) -> np.ndarray:
        """A signal at the control samples: (n, its components), or (n) of one without components.

        Those of the closed loop (``state``, ``applied_force``, ...) and of every part.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signal:
    """An output port of a part: a variable of the record, and a panel of the report."""

    name: str  # of the port and of the variable
    unit: str
    meaning: str
    components: tuple[str, ...] = ()  # their names; none: a single number
    # the dimension of the record along which the components stand; "": one of its own
    dimension: str = ""
    held: bool = True  # constant from each control sample to the next
    # computed from the run in place of a port: (n, components) or (n)
    of: Callable[[View], np.ndarray] | None = None

    @property
    def size(self) -> int:
        """Of the port."""
        return max(1, len(self.components))

    @property
    def dims(self) -> tuple[str, ...]:
        """Of the variable."""
        along = self.dimension or f"{self.name}_component"
        return ("time", along) if self.components else ("time",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric:
    """A figure of merit: an entry of ``metrics.json``, a row of tables, a column of campaigns."""

    key: str  # dotted: where it stands in ``metrics.json``
    unit: str
    label: str
    of: Callable[[View], float]

    @property
    def column(self) -> str:
        """As ``Figure.column``."""
        return self.key.replace(".", "_")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figure:
    """What a metric came to in a run."""

    part: str  # the block that the part fills
    key: str
    unit: str
    label: str
    value: float | None  # None: not a finite number

    @property
    def column(self) -> str:
        """Its name in a campaign."""
        return self.key.replace(".", "_")


class Part:
    """What fills a block; derive a frozen, keyword-only dataclass from it."""

    title: ClassVar[str] = ""  # heading of its rows and panels; "": the class's name

    def check(self, key: str, scenario: Scenario) -> Iterator[tuple[str, str]]:
        """What is wrong with the settings that no single one can say: key and problem."""
        yield from ()

    def build(self, setup: BlockSetup) -> System:
        """The system with the block's ports, and one output port for each signal that has one."""
        raise NotImplementedError

    def __call__(self, setup: BlockSetup) -> System:
        """As ``build``: a part is the factory of its block."""
        return self.build(setup)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """What it gives besides the block's own ports."""
        return ()

    def metrics(self) -> Sequence[Metric]:
        """Figures of merit."""
        return ()

    def linear(self) -> "Part":
        """What the linearisation wires in its place: without limits, which have no derivative."""
        return self


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlacedPart:
    """A part in its block."""

    name: str  # of the block
    part: Part
    signals: tuple[Signal, ...]

    @property
    def title(self) -> str:
        """Heading of its rows and panels."""
        return self.part.title or type(self.part).__name__


Parts = Mapping[str, PlacedPart]  # by block


def place_part(part: Part, setup: BlockSetup, system: System, *, block: str) -> PlacedPart:
    """A part with its signals, checked against the system that it built. Raises BlockError."""
    place = f"blocks.{block} '{type(part).__name__}'"
    signals = tuple(part.signals(setup))
    if block.startswith("sensing"):  # recorded as the controller reads it, at its samples
        signals = tuple(dataclasses.replace(signal, held=True) for signal in signals)
    for signal in signals:
        if not signal.name.isidentifier():
            raise BlockError(f"{place}: a signal's name must be an identifier, not {signal.name!r}")
        if signal.of is not None:
            continue
        if not system.HasOutputPort(signal.name):
            raise BlockError(f"{place}: signal '{signal.name}' needs an output port of that name")
        size = system.GetOutputPort(signal.name).size()
        if size != signal.size:
            raise BlockError(
                f"{place}: output port '{signal.name}' must have size {signal.size}, as its signal "
                f"has components, not {size}"
            )
    return PlacedPart(name=block, part=part, signals=signals)


def figures_of(placed: PlacedPart, view: View) -> Iterator[Figure]:
    """The figures of merit of a part in a run.

    Raises BlockError: a metric fails, or gives no number.
    """
    for metric in placed.part.metrics():
        try:
            value = float(metric.of(view))
        except FfsmError:
            raise
        except Exception as error:  # a user's function may raise anything
            raise BlockError(
                f"blocks.{placed.name} '{type(placed.part).__name__}': metric '{metric.key}' "
                f"failed: {type(error).__name__}: {one_line(error)}"
            ) from error
        yield Figure(
            part=placed.title,
            key=metric.key,
            unit=metric.unit,
            label=metric.label,
            value=value if math.isfinite(value) else None,
        )


def nested(figures: Sequence[Figure]) -> dict[str, Any]:
    """Figures as ``metrics.json`` holds them, by the parts of their keys."""
    found: dict[str, Any] = {}
    for figure in figures:
        *parents, last = figure.key.split(".")
        place = found
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = math.nan if figure.value is None else figure.value
    return found


def values_of(signal: Signal, view: View) -> np.ndarray:
    """A signal over a run, as its variable holds it."""
    values = view[signal.name] if signal.of is None else np.asarray(signal.of(view), dtype=float)
    return values.reshape(len(view.time), *(() if not signal.components else (signal.size,)))


def signals_of(parts: Parts) -> Iterator[Signal]:
    """Those of all parts."""
    for placed in parts.values():
        yield from placed.signals
