"""The signals of a part: output ports and series that a record keeps, and constants beside them."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.nominal import PlantModel

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


class Signals(Protocol):
    """Values of signals by name."""

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the values of a signal."""


def components_of(role: str, coordinates: int) -> int | None:
    """Return the number of components of a signal with a role; None: any, also a single number."""
    return {STORED_MOMENTUM: 3, INTERNAL_TORQUE: 3, HELD_FORCE: coordinates}.get(role)


def problems_of(signal: Signal, coordinates: int) -> Iterator[str]:
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


def values_of(signal: Signal, view: View) -> np.ndarray | None:
    """Return a signal over a run in the form of its variable; None if the run lacks it."""
    values = view[signal.name] if signal.of is None else signal.of(view)
    if values is None:
        return None
    return np.asarray(values, dtype=float).reshape(
        len(view.time), *(() if not signal.components else (signal.size,))
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


def pulses_of(opened: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pulses of a valve from its open share (n) of each sample; it opens at the sample's
    start.

    Returns: the samples in which pulses start, and their lengths, s.
    """
    goes_on = np.r_[False, opened[:-1] == 1.0]  # open up to the sample's start
    starts = np.flatnonzero((opened > 0.0) & ~goes_on)
    return starts, np.add.reduceat(opened, starts) * period if starts.size else np.zeros(0)
