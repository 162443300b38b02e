"""The contract of a part: a component of the closed loop and everything derived from it.

A part is a frozen dataclass of settings (``common.settings.setting``). It determines
the checks of ``blocks.<name>.settings``, the ports, the variables of the record, the panels of the
report, the figures in ``metrics.json`` and the tables, the columns of campaigns, and its
stand-in in the linearisation.
"""

import dataclasses
import functools
import itertools
import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
from pydrake.systems.framework import System

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import calling, is_user_supplied
from ffsm_drake.common.numbers import number, percent
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.limits import Limit
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.setup import BlockSetup

# Role of a signal in the balances. Of momentum: momentum that the part holds beside the bodies', in
# the world (3), N m s; the internal torque on the base, part of ``applied_force``. Of energy: the
# work of forces beside ``applied_force``, since the start, summed over the components, J; energy
# stored, or dissipated since the start, J. Of both: an external force (nv) beside
# ``applied_force``, held over a sample too.
STORED_MOMENTUM, INTERNAL_TORQUE = "stored_momentum", "internal_torque"
INTERNAL_WORK, STORED_ENERGY, HELD_FORCE = "internal_work", "stored_energy", "held_force"
ROLES = (STORED_MOMENTUM, INTERNAL_TORQUE, INTERNAL_WORK, STORED_ENERGY, HELD_FORCE)
# Units of the entries of coordinates, and of their forces.
UNIT, EFFORT = "rad (rotations) or m (translations)", "N m (rotations) or N (translations)"
# Drawing of a signal: a curve; steps from one sample to the next; a row for each component, with a
# box wherever it is on, from the share of each sample in the on state.
CURVE, STEPS, TIMELINE = "linear", "hv", "timeline"


class View(Protocol):
    """A run, as read by the metrics of a part."""

    @property
    def scenario(self) -> Scenario:
        """The scenario of the run."""

    @property
    def time(self) -> np.ndarray:
        """Control samples (n), s."""

    @property
    def coordinates(self) -> Coordinates:
        """Names of the generalized velocities."""

    @property
    def split(self) -> StateSplit:
        """The known and the other coordinates of the true plant."""

    @property
    def model(self) -> PlantModel:
        """The true plant, flexible parts included."""

    def __contains__(self, name: str) -> bool:
        """Whether a signal of that name exists."""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return a signal at the control samples: (n, components), or (n) without components.

        Available are the closed loop's signals (``state``, ``applied_force``, ...) and those of
        every part.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class Signal:
    """An output port of a part, which becomes a variable of the record and a panel of the report.

    Example:
      >>> from ffsm_drake import Signal
      >>> dipole = Signal(name="dipole", unit="A m^2", meaning="coils", components=("x", "y"))
      >>> dipole.dims, dipole.size
      (('time', 'dipole_component'), 2)
    """

    name: str  # name of the port and of the variable
    unit: str
    meaning: str
    components: tuple[str, ...] = ()  # names of the components; empty: a single number
    # dimension of the record for the components, or for those that the spacecraft gives; "": one of
    # its own
    dimension: str = ""
    held: bool = True  # constant from each control sample to the next
    # computes the signal from the run, without a port: (n, components) or (n); None: absent in this
    # run
    of: Callable[[View], np.ndarray | None] | None = None
    role: str = ""  # one of ROLES, or none
    # heading of its panels in the report; None: the part's title and its name, "": no panels
    heading: str | None = None
    chart: str = CURVE  # or STEPS, TIMELINE
    panels: Mapping[str, str] | None = None  # component -> unit of those with one; None: all
    panel: str = ""  # title of the panel of a timeline, or of a signal without components

    @property
    def size(self) -> int:
        """Size of the port."""
        return max(1, len(self.components))

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the variable."""
        along = self.dimension or f"{self.name}_component"
        return ("time", along) if self.components or self.dimension else ("time",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Constant:
    """Numbers, or words, along a dimension of the part's signals: a coordinate of the record."""

    name: str
    unit: str
    meaning: str
    dimension: str
    values: Sequence[float] | Sequence[str]


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Named:
    """The common fields of a metric and its figure."""

    # dotted key in ``metrics.json``; values by name merge with those of another metric of the same
    # key; "": not there
    key: str
    unit: str
    label: str  # label of the row in tables, or of the rows of values by name; "": no row
    column: str | None = None  # column of campaigns; None: from the key, "": no column
    # heading of that column on the campaign's page; None: from label and unit, "": not shown
    heading: str | None = None
    # Unit shown, such as g for kg with the factor 1000; "%" for a share.
    shown: str = ""
    factor: float = 1.0
    ranked: bool = False  # lower is better: comparisons of runs use it

    @property
    def column_name(self) -> str:
        """Name of the column in a campaign; "" without a column."""
        return self.key.replace(".", "_") if self.column is None else self.column

    @property
    def column_heading(self) -> str:
        """Heading of the column."""
        unit = "" if self.unit == "1" else f" [{self.unit}]"
        return f"{self.label.lower()}{unit}" if self.heading is None else self.heading

    @property
    def shown_unit(self) -> str:
        """Unit shown beside the value in tables; "" for a share."""
        unit = self.shown or self.unit
        return "" if unit in ("1", "%") else unit


Values = float | int | None | Mapping[str, float | int | None]  # None: not a finite number


@dataclasses.dataclass(frozen=True, kw_only=True)
class Metric(_Named):
    """A metric of a run: an entry of ``metrics.json``, a row of tables, a column of campaigns.

    Its function ``of`` returns a number, or numbers by name. Numbers by name have no column.

    Example:
      >>> import numpy as np
      >>> from ffsm_drake import Metric
      >>> size = lambda run: np.abs(run["force"]).max()
      >>> force = Metric(key="coils.force", unit="N", label="Force", of=size)
      >>> force.column_name
      'coils_force'
    """

    of: Callable[[Any], Any]  # reads a View; the core's own read labelled time series


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figure(_Named):
    """The value of a metric in a run."""

    part: str  # the title of the part
    value: Values

    def text(self, name: str = "", *, digits: int = 4) -> str:
        """Return the value, or the value of one name, as displayed, without its unit."""
        value = self.value.get(name) if isinstance(self.value, Mapping) else self.value
        if self.shown == "%":
            return percent(value)
        if isinstance(value, int):
            return str(value)
        return number(None if value is None else self.factor * value, digits)

    @property
    def size(self) -> float:
        """The value in the displayed unit; NaN if it is not a finite number."""
        known = isinstance(self.value, (int, float))
        return self.factor * float(self.value) if known else math.nan  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawing:
    """How the report draws a variable of the record."""

    signal: str
    heading: str
    chart: str
    title: str  # title of a timeline's panel
    panels: Mapping[str, str]  # component -> unit; of a variable without components its title


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solid:
    """A solid on the base, shown in Meshcat. Lengths without a unit are shares of the base's
    longest edge.
    """

    group: str  # group of solids of one kind
    name: str
    shape: Literal["cone", "disc"]  # a cone has its point at its place, and opens along the axis
    axis: np.ndarray  # (3,) in the base's axes, of any length
    position: np.ndarray  # (3,) m, in the base
    offset: float = 0.0  # distance from there along the axis
    length: float
    radius: float
    color: tuple[float, float, float, float]  # red, green, blue, opacity
    through: bool = False  # seen through the base
    # signal whose component of this solid's name shows it while above zero; "": always shown
    shown_by: str = ""
    legend: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartRecord:
    """Data of a part in a record, beside its variables: the report needs no part."""

    title: str
    section: str  # section of the report
    about: str  # text of that section; "": the sentences of its parts
    sentence: str
    table: tuple[tuple[str | float | None, ...], ...]  # None: not a finite number
    figures: tuple[Figure, ...]
    drawings: tuple[Drawing, ...]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PartRecord":
        """Build from ``dataclasses.asdict``, through JSON. Raises TypeError for other data."""
        made = {
            "table": tuple(map(tuple, data["table"])),
            "figures": tuple(Figure(**each) for each in data["figures"]),
            "drawings": tuple(Drawing(**each) for each in data["drawings"]),
        }
        return cls(**{**data, **made})


class Signals(Protocol):
    """Values of signals by name."""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of a signal."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Advice:
    """Changes of a scenario against saturation."""

    changes: Mapping[str, Any]  # by dotted key
    reason: str

    def __str__(self) -> str:
        """As options of the command line, and why."""
        given = (f"{key}={_as_yaml(value)}" for key, value in self.changes.items())
        return f"{' '.join(f'--set {shlex.quote(each)}' for each in given)} ({self.reason})"


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupLoad:
    """Requirements of a mission and its loop on a group's actuators, and the actuators' limits."""

    limit: float  # N m or N; in any direction
    inertia: float  # kg m^2 or kg; the largest about or along an axis, all else free to react
    noise: float  # rad or m; largest standard deviation of a measured position
    motion: float  # N m or N; peak of the planned motion; with a capture, after its first seconds


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """Possible remedies for saturated base actuators of any kind."""

    groups: Mapping[str, GroupLoad]  # by group, of those with a limit
    slower: Advice | None  # a longer motion, if it takes less of the limit
    softer: Mapping[str, Advice]  # by group: smaller gains, if they are too large
    other_law: Advice | None  # a law without an integral, if the law has one

    def advice(self, *groups: str) -> Iterator[Advice]:
        """The remedies for actuators of some groups."""
        if self.slower is not None:
            yield self.slower
        yield from (self.softer[group] for group in groups if group in self.softer)
        if self.other_law is not None:
            yield self.other_law


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
    # True: runs with other noise sequences check the limits of this actuator.
    rehearsed: ClassVar[bool] = False
    logged: tuple[str, ...] = ()  # held outputs that are in the log of a run, not in its record

    @property
    def is_helped(self) -> bool:
        """For an actuator of the base: whether actuators before it supply the torque beyond its
        limit.
        """
        return False

    @classmethod
    def of(cls, scenario: Scenario) -> "Part | None":
        """Return the part for a scenario's own section; None without that section."""
        return cls()

    def held_by(self, grip: Grip) -> "Part | None":
        """Return the part in a phase in which ``grip`` holds the target; None: it is absent."""
        return self

    @classmethod
    def known_faults(
        cls, scenario: Scenario, coordinates: Coordinates
    ) -> Mapping[str, Sequence[str]]:
        """Possible faults: "<part>.<unit>" -> kinds."""
        return {}

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

    def most(self, scenario: Scenario, directions: np.ndarray) -> Mapping[str, np.ndarray] | None:
        """For an actuator of the base: the largest ``torque`` (N m) and ``force`` (N) along each of
        the directions (n, 3; base's axes), for the kinds that it provides; None for other parts.
        """
        return None

    def reach(self, scenario: Scenario) -> Mapping[str, np.ndarray]:
        """For an actuator with ``most``: for each kind a matrix (3, n; base's axes). Its columns
        are the largest outputs of its units, or of combinations without any other output.
        """
        return {}

    def saturated(self, signals: "Signals") -> np.ndarray:
        """Whether an actuator gives less than was wanted: (n,) from its signals (n, components), or
        a single truth value from those of one sample (components).
        """
        return np.zeros((), dtype=bool)

    def given_up(self, signals: "Signals") -> str:
        """Final action of a run with these signals in place of its plan; empty: none."""
        return ""

    def advice(self, scenario: Scenario, load: Load) -> Iterator[Advice]:
        """The remedies for saturation of an actuator of the base."""
        yield from ()

    def storage(self, scenario: Scenario) -> Any:
        """Return the part's storage of angular momentum in the base, as the wheels have it; None if
        it has none.
        """
        return None

    def limits(self, coordinates: Coordinates) -> Sequence[Limit]:
        """Limits of the coordinates' rates, forces or positions, or of the part's own signals, for
        checks of plans, runs and campaigns.
        """
        return ()

    def locked(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the part's rotating masses fixed to their body, for gravity."""
        return scenario

    def linear(self) -> "Part":
        """Return the part's stand-in in the linearisation: without limits, which have no
        derivative.
        """
        return self


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
        for problem in _problems(signal, len(setup.coordinates.names)):
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


def components_of(role: str, coordinates: int) -> int | None:
    """Return the number of components of a signal with a role; None: any, also a single number."""
    return {STORED_MOMENTUM: 3, INTERNAL_TORQUE: 3, HELD_FORCE: coordinates}.get(role)


def _problems(signal: Signal, coordinates: int) -> Iterator[str]:
    """What keeps a signal out of a record of so many coordinates."""
    name, components = signal.name, signal.components
    panels = {} if signal.panels is None else signal.panels
    texts = (name, signal.unit, signal.meaning, signal.dimension, signal.panel, *panels.values())
    if not all(isinstance(each, str) for each in (*texts, *components)):
        yield f"signal {name!r:.40}: its texts and the names of its components must be text"
    if not name.isidentifier():
        yield f"a signal's name must be an identifier, not {name!r}"
    if signal.role not in ("", *ROLES) or signal.chart not in (CURVE, STEPS, TIMELINE):
        yield (
            f"signal '{name}': role must be one of {', '.join(ROLES)}, and "
            f"chart one of {', '.join((CURVE, STEPS, TIMELINE))}"
        )
    number = components_of(signal.role, coordinates)
    if number not in (None, len(components)):
        yield f"signal '{name}' must have {number} components for its role"
    if "" in components or len({*components}) < len(components):
        yield f"signal '{name}': the names of its components must differ, and none be empty"
    if components and not {*components} >= panels.keys():
        yield f"signal '{name}' has panels of other components than its own"


def figures_of(placed: PlacedPart, view: View) -> Iterator[Figure]:
    """The figures of merit of a part in a run.

    Raises BlockError: a metric fails or does not give a number.
    """
    for metric in placed.part.metrics():
        place = f"blocks.{placed.name} '{type(placed.part).__name__}': metric '{metric.key}'"
        value = calling(place, lambda metric=metric: _plain(metric.of(view)))
        if isinstance(value, Mapping) and metric.column_name:
            raise BlockError(f'{place} gives values by name, which no column holds: say column=""')
        shared = {each.name: getattr(metric, each.name) for each in dataclasses.fields(_Named)}
        yield Figure(**shared, part=placed.title, value=value)


def _plain(value: Any) -> Values:
    """Return a number, or numbers by name, in the form of JSON. Raises TypeError or ValueError."""
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}  # type: ignore[misc]
    if value is None:
        return None
    if isinstance(value, (int, np.integer)):
        return int(value)
    return float(value) if math.isfinite(float(value)) else None


def nested(figures: Sequence[Figure]) -> dict[str, Any]:
    """Nest figures by the parts of their keys, as in ``metrics.json``."""
    found: dict[str, Any] = {}
    for figure in figures:
        *parents, last = figure.key.split(".")
        place = found
        for parent in parents:
            place = place.setdefault(parent, {})
        value, before = figure.value, place.get(last)
        if isinstance(value, Mapping):
            value = value if any(each is not None for each in value.values()) else None
            if isinstance(before, Mapping):
                value = {**before, **(value or {})}
        if last:
            place[last] = value
    return found


def values_of(signal: Signal, view: View) -> np.ndarray | None:
    """Return a signal over a run in the form of its variable; None if the run lacks it."""
    values = view[signal.name] if signal.of is None else signal.of(view)
    if values is None:
        return None
    return np.asarray(values, dtype=float).reshape(
        len(view.time), *(() if not signal.components else (signal.size,))
    )


def recorded(placed: PlacedPart, figures: Sequence[Figure]) -> PartRecord:
    """Return the data of a part for the record of a run, with its figures."""
    part, sentence = placed.part, placed.part.sentence(figures)
    table = tuple(map(tuple, part.table(figures)))
    place = f"blocks.{placed.name} '{type(part).__name__}'"
    if not isinstance(sentence, str | None):
        raise BlockError(f"{place}: sentence must be text or None, not {type(sentence).__name__}")
    for entry in itertools.chain(*table):
        if not isinstance(entry, str | int | float):
            raise BlockError(f"{place}: table must hold texts and numbers, not {entry!r:.40}")
    return PartRecord(
        title=placed.title,
        section=part.section,
        about=part.about,
        sentence=_listed(placed.title, figures) if sentence is None else sentence,
        table=table,
        figures=tuple(figures),
        drawings=tuple(
            _drawing(signal, placed.title) for signal in placed.signals if signal.heading != ""
        ),
    )


def by_key(figures: Sequence[Figure]) -> dict[str, Any]:
    """Return the values of figures by key, or by column without one; NaN for values that are not
    finite.
    """

    def known(value: Values) -> Any:
        if isinstance(value, Mapping):
            return {name: known(each) for name, each in value.items()}
        return math.nan if value is None else value

    return {figure.key or figure.column_name: known(figure.value) for figure in figures}


def _as_yaml(value: Any) -> str:
    """Return a number, text, or numbers by name, in the form of an override."""
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{name}: {_as_yaml(each)}' for name, each in value.items())}}}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _listed(title: str, figures: Sequence[Figure]) -> str:
    """Return the figures with a row, in one line."""
    texts = []
    for figure in figures:
        name = f"{figure.label[:1].lower()}{figure.label[1:]}"
        values = figure.value if isinstance(figure.value, Mapping) else {"": None}
        for each in values if figure.label else ():
            text = f"{figure.text(each)} {figure.shown_unit}".rstrip()
            texts.append(" ".join(filter(None, (name, each, text))))
    return f"{title}: {', '.join(texts)}" if texts else ""


def _drawing(signal: Signal, title: str) -> Drawing:
    """Return the drawing of a signal in the report, for a part of that title."""
    panels = signal.panels
    if panels is None:
        titles = signal.components or (signal.panel or signal.name,)
        panels = dict.fromkeys(titles, "" if signal.unit == "1" else signal.unit)
    heading = signal.heading
    if heading is None:
        heading = f"{title}: {signal.name.replace('_', ' ')}"
    return Drawing(
        signal=signal.name,
        heading=heading,
        chart=signal.chart,
        title=signal.panel or heading,
        panels=dict(panels),
    )


def state_signals(
    port: str, prefix: str, q: str, v: str, quaternion: str = "1 (quaternion)"
) -> tuple[Signal, Signal]:
    """Position and velocity of a port [q; v] of a block: names with a prefix, and meanings."""

    def part(run: View, which: int) -> np.ndarray:
        return np.split(run[port], [len(run.coordinates.position_names)], axis=1)[which]

    return (
        Signal(
            name=f"{prefix}position", unit=f"{quaternion}, {UNIT}", meaning=q,
            dimension="position_name", of=lambda run: part(run, 0),
        ),
        Signal(
            name=f"{prefix}velocity", unit=f"{UNIT} per s", meaning=v, dimension="coordinate",
            of=lambda run: part(run, 1),
        ),
    )  # fmt: skip


def with_role(parts: Parts, role: str) -> list[str]:
    """Return names of the signals that have a role."""
    return [signal.name for signal in signals_of(parts) if signal.role == role]


def signals_of(parts: Parts) -> Iterator[Signal]:
    """Signals of all parts."""
    for placed in parts.values():
        yield from placed.signals


def pulses_of(opened: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pulses of a valve from its open share (n) of each sample; it opens at the sample's
    start.

    Returns: the samples in which pulses start, and their lengths, s.
    """
    goes_on = np.r_[False, opened[:-1] == 1.0]  # open up to the sample's start
    starts = np.flatnonzero((opened > 0.0) & ~goes_on)
    return starts, np.add.reduceat(opened, starts) * period if starts.size else np.zeros(0)
