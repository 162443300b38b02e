"""The metrics of a part, and their values in a run: figures."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.numbers import number, percent


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Named:
    """The common fields of a metric and its figure."""

    # dotted key in ``metrics.json``; values by name merge with those of another metric of the same
    # key; "": not there
    key: str
    unit: str
    label: str = ""  # label of the row in tables, or of the rows of values by name; "": no row
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

    def value_in(self, run: Any) -> Values:
        """Return the value in a run. Raises TypeError or ValueError if it is not a number."""
        return _plain(self.of(run))

    def figure(self, value: Values, part: str) -> "Figure":
        """Return the figure of a value in a run, for a part of that title."""
        shared = {each.name: getattr(self, each.name) for each in dataclasses.fields(_Named)}
        return Figure(**shared, part=part, value=value)


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


def by_key(figures: Sequence[Figure]) -> dict[str, Any]:
    """Return the values of figures by key, or by column without one; NaN for values that are not
    finite.
    """

    def known(value: Values) -> Any:
        if isinstance(value, Mapping):
            return {name: known(each) for name, each in value.items()}
        return math.nan if value is None else value

    return {figure.key or figure.column_name: known(figure.value) for figure in figures}
