"""Settings: fields of a dataclass that a user sets, each with its unit, meaning and range.

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Drag:
        area: float = setting(1.0, "m^2", "frontal area", above=0)
        axis: list[float] = setting([1.0, 0.0, 0.0], "", "of any length", size=(3, 3), nonzero=True)
        regime: str = setting("free", "", "of the flow", one_of=("free", "slip"))

Loading, checks and their errors, the JSON Schema and the scenario reference are derived from them.
Conditions on several settings go into a method ``check(key, scenario)`` of the dataclass; it yields
``(key, problem)`` pairs.
"""

import copy
import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator
from typing import Any

from pydrake.systems.analysis import GetIntegrationSchemes, SimulatorConfig

from ffsm_drake.common.errors import ScenarioError, choices

Problems = Iterator[tuple[str, str]]  # key and problem
_HUGE = 1e300
_PLAIN = (str, float, int, bool, type(None))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """Allowed values of a field. Limits apply to a number, and to each of a list or mapping."""

    unit: str = ""
    meaning: str = ""
    above: float = -math.inf  # values are > this,
    least: float = -math.inf  # >= this,
    below: float = math.inf  # < this,
    most: float = math.inf  # <= this
    one_of: tuple[str, ...] = ()
    size: tuple[float, float] = (0, math.inf)  # smallest and largest, of a list or mapping
    nonzero: bool = False  # a vector that must not be zero

    @property
    def range(self) -> str:
        """The limits of a number in words, such as ``> 0`` or ``from 0 to below 1``."""
        upper = f"below {self.below:.10g}" * (self.below < math.inf)
        most = f"{self.most:.10g}" * (self.most < math.inf)
        if self.least > self.above:
            least = f"{self.least:.10g}"
            return f"from {least} to {upper or most}" if upper or most else f">= {least}"
        lower = f"> {self.above:.10g}" * (self.above > -math.inf)
        return ", ".join(filter(None, (lower, upper or (most and f"at most {most}"))))

    def problems(self, value: Any, key: str) -> Problems:
        """Key (the value's, or an entry's) and problem of everything that is wrong with a value."""
        if isinstance(value, dict):
            entries = {f"{key}.{name}": item for name, item in value.items()}
        elif isinstance(value, (list, tuple)):
            entries = {f"{key}[{index}]": item for index, item in enumerate(value)}
        else:
            yield from self._entry_problems(value, key)
            return
        low, high = self.size
        if not low <= len(entries) <= high:
            words = f"{low}" if low == high else f"{low} to {high}" if low else f"at most {high}"
            yield key, f"must hold {words} values, not {len(entries)}"
        elif self.nonzero and all(abs(item) <= 1e-9 for item in entries.values()):
            yield key, "must not be zero"
        for place, item in entries.items():
            yield from self.problems(item, place)

    def _entry_problems(self, value: Any, key: str) -> Problems:
        if isinstance(value, str) and self.one_of and value not in self.one_of:
            yield key, unknown(value, self.one_of)
        if isinstance(value, (int, float)) and not (
            self.above < value <= self.most
            and self.least <= value
            and (value < self.below or self.below == math.inf)
        ):
            # a unit that depends on the coordinate, or a bare 1/s, would obscure the range
            plain = " or " not in self.unit and self.unit[:1] != "1"
            is_float = isinstance(value, float) or abs(value) < _HUGE  # or can be made one
            given = f"{value:.10g}" if is_float else f"a number beyond {_HUGE:g}"
            yield key, f"must be {self.range} {self.unit * plain}".strip() + f", not {given}"


def setting(default: Any, unit: str = "", meaning: str = "", **limits: Any) -> Any:
    """Declare a setting, as a field of a dataclass.

    Instances do not share a mutable default.

    Args:
      default: default value.
      unit: unit, such as "N m or N"; empty for a text, or for a number without unit.
      meaning: one phrase for the documentation, which begins with the quantity.
      limits: other fields of ``Setting``, such as ``above`` or ``one_of``; ``size`` may be one
        number for an exact size.

    Returns: the field, for the body of a dataclass.

    Example:
      >>> from dataclasses import dataclass
      >>> from ffsm_drake import Part, setting
      >>> @dataclass(frozen=True, kw_only=True)
      ... class Camera(Part):
      ...     period: float = setting(0.1, "s", "time between images", above=0)
      >>> Camera().period
      0.1
    """
    if isinstance(size := limits.get("size"), int):
        limits["size"] = (size, size)
    metadata = {"setting": Setting(unit=unit, meaning=meaning, **limits)}
    if default is None or isinstance(default, (str, int, float)):
        return dataclasses.field(default=default, metadata=metadata)
    return dataclasses.field(default_factory=lambda: fresh(default), metadata=metadata)


def fresh(value: Any) -> Any:
    """Return a copy of plain data, and of dataclasses of it, which shares nothing that can
    change.
    """
    kind: Any = type(value)
    if kind in _PLAIN:
        return value
    if kind is dict:
        return {key: item if type(item) in _PLAIN else fresh(item) for key, item in value.items()}
    if kind is list:
        return [fresh(item) for item in value]
    if not dataclasses.is_dataclass(kind):
        return copy.deepcopy(value)
    result = object.__new__(type(value))
    for field in dataclasses.fields(kind):
        object.__setattr__(result, field.name, fresh(getattr(value, field.name)))
    return result


@functools.cache  # called for every part whenever a scenario is loaded
def settings_of(kind: Any) -> dict[str, Setting]:
    """Return name -> setting, of a dataclass or Drake's ``SimulatorConfig``; empty for anything
    else.
    """
    if kind is SimulatorConfig:
        return {field.name: _SIMULATOR.get(field.name, Setting()) for field in kind.__fields__}
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return {
        field.name: field.metadata["setting"] for field in fields if "setting" in field.metadata
    }


def problems(value: Any, key: str = "", scenario: Any = None) -> Problems:
    """All problems of a dataclass of settings and those nested in it.

    Those of single settings come first; then, with a scenario, those that each ``check`` yields.
    """
    parts = list(_parts(value, key))
    for place, part in parts:
        for name, declared in settings_of(part.__class__).items():
            yield from declared.problems(getattr(part, name), join(place, name))
    for place, part in parts:
        if scenario is not None and hasattr(part, "check"):
            yield from part.check(place, scenario)


def require_valid(value: Any, key: str = "", scenario: Any = None) -> None:
    """Raise ScenarioError for the first of ``problems``."""
    for place, problem in problems(value, key, scenario):
        raise ScenarioError(place, problem)


def unknown(name: str, valid: Iterable[str]) -> str:
    """Return the problem with a name that is not valid."""
    return f"'{name}' is unknown; choose one of {choices(name, valid)}"


def join(path: str, key: Any) -> str:
    """Return a dotted key."""
    return f"{path}.{key}" if path else str(key)


def _parts(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Key and object of everything with settings in a value, outermost first."""
    if value.__class__ in _PLAIN:
        return
    names = settings_of(value.__class__)
    if names or hasattr(value, "check"):
        yield key, value
        value = {name: getattr(value, name) for name in names}
    for name, item in value.items() if isinstance(value, dict) else ():
        yield from _parts(item, join(key, name))


# Drake's struct has no units and meanings. Its "cenic" needs the plant at the top level of the
# diagram.
_SIMULATOR = {
    "integration_scheme": Setting(
        meaning="integrator, by Drake's name; the paper uses explicit_euler with max_step_size "
        "equal "
        "to sample_time",
        one_of=tuple(name for name in GetIntegrationSchemes() if name != "cenic"),
    ),
    "max_step_size": Setting(
        unit="s",
        meaning="step of an integrator with fixed steps; largest step of an integrator with error "
        "control",
        above=0,
    ),
    "accuracy": Setting(meaning="relative accuracy of an integrator with error control", above=0),
    "use_error_control": Setting(meaning="true: the integrator chooses its steps"),
    "start_time": Setting(unit="s", meaning="start time of the run; it must be 0"),
    "target_realtime_rate": Setting(
        meaning="speed of the run compared with real time; 1: real time; 0: as fast as possible",
        least=0,
    ),
    "publish_every_time_step": Setting(
        meaning="true: Drake publishes at every step; this is not needed here"
    ),
}
