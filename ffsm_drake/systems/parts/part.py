"""The contract of a part: a component of the closed loop and everything derived from it.

A part is a frozen dataclass of settings (``common.settings.setting``). It determines
the checks of ``blocks.<name>.settings``, the ports, the variables of the record, the panels of the
report, the figures in ``metrics.json`` and the tables, the columns of campaigns, and its
stand-in in the linearisation.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ClassVar

from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import is_user_supplied
from ffsm_drake.scenario import FaultKind, Grip, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.parts.metrics import Figure, Metric
from ffsm_drake.systems.parts.signals import Constant, Signal, Signals
from ffsm_drake.systems.parts.solid import Solid
from ffsm_drake.systems.setup import BlockSetup


def _is_pair(value: Any) -> bool:
    return isinstance(value, tuple) and [*map(type, value)] == [str, str]


# Method of a part with several results -> check of one result, and description of a valid one.
_ITEMS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "check": (_is_pair, "pairs of texts, key and problem"),
    "signals": (lambda value: isinstance(value, Signal), "Signal"),
    "constants": (lambda value: isinstance(value, Constant), "Constant"),
    "metrics": (lambda value: isinstance(value, Metric), "Metric"),
    "limits": (lambda value: isinstance(value, Limit), "Limit"),
}


def _checked_items(part: type, name: str) -> Callable[..., tuple[Any, ...]]:
    """Wrap a user-supplied part's method: it returns valid results or raises BlockError."""
    own, (is_right, wanted) = part.__dict__[name], _ITEMS[name]

    @functools.wraps(own)
    def checked(*arguments: Any, **more: Any) -> tuple[Any, ...]:
        given = own(*arguments, **more)
        items = tuple(given) if isinstance(given, Iterable) else (given,)
        for item in items:
            if not is_right(item):
                problem = f"{name} must give {wanted}, not {type(item).__name__}"
                raise BlockError(f"user-supplied '{part.__name__}': {problem}")
        return items

    return checked


class Part:
    """Base class of the contents of a block. A part is a frozen, keyword-only dataclass.

    Its fields are settings of the block, and ``build`` returns its Drake system. Override
    ``signals`` and ``metrics`` to extend records, tables and reports.

    Example:
      >>> from dataclasses import dataclass
      >>> from pydrake.systems.framework import DiagramBuilder
      >>> from pydrake.systems.primitives import ConstantVectorSource
      >>> from ffsm_drake import Part, load_scenario, setting, simulate
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Push(Part):
      ...     force: float = setting(0.1, "N", "force on the base along x", above=0)
      ...     def build(self, setup):
      ...         force = {"base_position_x": self.force}
      ...         push = setup.coordinates.vector(force, key="force", default=0.0)
      ...         builder = DiagramBuilder()
      ...         source = builder.AddSystem(ConstantVectorSource(push))
      ...         builder.ExportOutput(source.get_output_port(), "generalized_force")
      ...         return builder.Build()
      >>> scenario = load_scenario("postcapture", ["duration=0.1"])
      >>> blocks = {"forces.push": Push(force=0.2)}
      >>> record = simulate(scenario, blocks=blocks, check_stability=False)
      >>> record.outcome.status
      'completed'
    """

    def __init_subclass__(cls) -> None:
        """Wrap a user-supplied part's methods to check their results."""
        super().__init_subclass__()
        if is_user_supplied(cls):
            for name in _ITEMS:
                if name in cls.__dict__:
                    setattr(cls, name, _checked_items(cls, name))

    title: ClassVar[str] = ""  # heading of its rows and panels; "": the class's name
    section: ClassVar[str] = "Parts"  # section of the report for its panels
    about: ClassVar[str] = "Signals of the user-supplied parts."  # "": the text of ``sentence``
    fails_as: ClassVar[str] = ""  # the part in a unit of ``faults``, such as "thrusters"
    fault_kinds: ClassVar[Sequence[FaultKind]] = ()
    logged: tuple[str, ...] = ()  # held outputs that are in the log of a run, not in its record

    @classmethod
    def of(cls, scenario: Scenario) -> "Part | None":
        """Return the part for a scenario's own section; None without that section."""
        return cls()

    def held_by(self, grip: Grip) -> "Part | None":
        """Return the part in a phase in which ``grip`` holds the target; None: it is absent."""
        return self

    @classmethod
    def failing_units(cls, scenario: Scenario, coordinates: Coordinates) -> Iterable[str]:
        """Names of the units that can fail, each in all ``fault_kinds``."""
        return ()

    def check(self, key: str, scenario: Scenario) -> Iterator[tuple[str, str]]:
        """Problems with combinations of settings: key and problem."""
        yield from ()

    def check_plant(self, scenario: Scenario, model: PlantModel) -> None:
        """Raise ScenarioError for problems that depend on the true plant's masses, before a run."""

    def build(self, setup: BlockSetup) -> System:
        """Build the system with the block's ports and one output port for each signal with a port.

        Parts of the scenario's own sections do not define it: their block is built from the
        section.
        """
        raise NotImplementedError(f"{type(self).__name__} needs a method build(setup)")

    def __call__(self, setup: BlockSetup) -> System:
        """Same as ``build``: a part is the factory of its block."""
        return self.build(setup)

    def signals(self, setup: BlockSetup) -> Sequence[Signal]:
        """Signals of the part beyond the block's own ports."""
        return ()

    def constants(self, setup: BlockSetup) -> Sequence[Constant]:
        """Constants of the components of its signals."""
        return ()

    def metrics(self) -> Sequence[Metric]:
        """Return figures of merit."""
        return ()

    def sentence(self, figures: Sequence[Figure]) -> str | None:
        """Return text below the table of a run; "": none, None: the figures with a row, one by
        one.
        """
        return None

    def table(self, figures: Sequence[Figure]) -> Sequence[Sequence[str | float]]:
        """Headings and rows of a table in the report, for example one row for each unit."""
        return ()

    def solids(self) -> Iterable[Solid]:
        """Its solids on the base, for Meshcat."""
        return ()

    def given_up(self, signals: Signals) -> str:
        """Final action of a run with these signals in place of its plan; empty: none."""
        return ""

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """Limits of the coordinates' rates, forces or positions, or of the part's own signals, for
        checks of plans, runs and campaigns.
        """
        return ()

    def linear(self) -> "Part":
        """Return the part's stand-in in the linearisation: without limits, which have no
        derivative.
        """
        return self
