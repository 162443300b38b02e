"""Distributions of a dispersed value: maps from the unit interval to a value."""

import dataclasses
import math
from collections.abc import Mapping
from statistics import NormalDist
from typing import Any, Protocol

from ffsm_drake.campaign.errors import CampaignError


class Distribution(Protocol):
    """The distribution of a parameter or factor."""

    uses_point: bool  # whether it uses a dimension of the sampling

    def value(self, u: float, case: int) -> Any:
        """The value of case number ``case`` at the quantile u in (0, 1)."""
        ...


@dataclasses.dataclass(frozen=True)
class Uniform:
    low: float
    high: float
    uses_point = True

    def value(self, u: float, case: int) -> float:
        return min(max(self.low + u * (self.high - self.low), self.low), self.high)


@dataclasses.dataclass(frozen=True)
class LogUniform:
    """Uniform in the logarithm: every decade is equally likely."""

    low: float
    high: float
    uses_point = True

    def value(self, u: float, case: int) -> float:
        exponent = math.log(self.low) + u * (math.log(self.high) - math.log(self.low))
        return min(max(math.exp(exponent), self.low), self.high)


@dataclasses.dataclass(frozen=True)
class Normal:
    mean: float
    deviation: float
    uses_point = True

    def value(self, u: float, case: int) -> float:
        return NormalDist(self.mean, self.deviation).inv_cdf(u)


@dataclasses.dataclass(frozen=True)
class Choice:
    """One of the values, each equally likely."""

    values: tuple[Any, ...]
    uses_point = True

    def value(self, u: float, case: int) -> Any:
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]


@dataclasses.dataclass(frozen=True)
class Listed:
    """The values in turn, by the case's number, repeated from the start."""

    values: tuple[Any, ...]
    uses_point = False

    def value(self, u: float, case: int) -> Any:
        return self.values[case % len(self.values)]


_FIELDS = {
    "uniform": ("low", "high"),
    "log_uniform": ("low", "high"),
    "normal": ("mean", "deviation"),
    "choice": ("values",),
    "list": ("values",),
}


def parse_distribution(data: Any, *, place: str) -> Distribution:
    """The distribution that one entry of the specification describes; ``place`` names it in errors.

    Raises:
      CampaignError: an unknown distribution or field, a missing one, or numbers out of range.
    """
    if not isinstance(data, Mapping):
        raise CampaignError(f"{place}: must be a mapping such as {{distribution: uniform, low: 0, high: 1}}")
    kind = data.get("distribution")
    if kind not in _FIELDS:
        raise CampaignError(f"{place}: distribution '{kind}' is unknown; choose one of {', '.join(_FIELDS)}")
    fields = _FIELDS[kind]
    check_keys(data, ("distribution", *fields), place=place)
    if missing := [name for name in fields if name not in data]:
        raise CampaignError(f"{place}: {kind} needs {' and '.join(missing)}")
    if fields == ("values",):
        values = data["values"]
        if not isinstance(values, list) or not values:
            raise CampaignError(f"{place}.values: must be a list of at least one value")
        listed = tuple(_tidy(value, place=f"{place}.values[{i}]") for i, value in enumerate(values))
        return Choice(listed) if kind == "choice" else Listed(listed)
    first, second = (number(data[name], place=f"{place}.{name}") for name in fields)
    if kind == "normal":
        if second <= 0.0:
            raise CampaignError(f"{place}.deviation: must be > 0, not {second:g}")
        return Normal(first, second)
    if first >= second:
        raise CampaignError(f"{place}: low must be below high, not {first:g} and {second:g}")
    if kind == "uniform":
        return Uniform(first, second)
    if first <= 0.0:
        raise CampaignError(f"{place}.low: must be > 0 for log_uniform, not {first:g}")
    return LogUniform(first, second)


def number(data: Any, *, place: str) -> float:
    """A finite number, also from text such as 1e-7, which YAML reads as a string."""
    try:
        if isinstance(data, bool) or not isinstance(data, (int, float, str)):
            raise ValueError
        value = float(data)
    except ValueError:
        raise CampaignError(f"{place}: must be a number, not {data!r}") from None
    if not math.isfinite(value):
        raise CampaignError(f"{place}: must be finite, not {value}")
    return value


def check_keys(data: Mapping[str, Any], valid: tuple[str, ...], *, place: str) -> None:
    """Raise CampaignError for a key that is not valid."""
    for key in data:
        if key not in valid:
            raise CampaignError(f"{place}.{key}: unknown key; valid here: {', '.join(valid)}")


def _tidy(value: Any, *, place: str) -> Any:
    """A value for the scenario; numbers must be finite, also within lists and where YAML reads them as text."""
    if isinstance(value, list):
        return [_tidy(item, place=place) for item in value]
    if value is None or isinstance(value, (bool, int)):
        return value
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return value
    return number(value, place=place)
