"""Distributions of a campaign's values, their sampling points, and rules for derived values.

A rule computes a value from others of the same case:

- scale: of (one name or several) multiplied with each other and with by (a number or a list;
  default 1)
- sum: of (several names), added up; lists of the same length element by element
- relative: of * (1 + error)
- direction: of * (sqrt(1 - h^2) cos a, sqrt(1 - h^2) sin a, h), with height h and azimuth a (rad);
  with h uniform in -1 to 1 and a in 0 to 2 pi all directions are equally likely
- solid_cube: inertia of a homogeneous cube, mass side^2 / 6 about each axis
- solid_sphere: inertia of a homogeneous sphere, 2/5 mass radius^2 about each axis

A name is a factor, a parameter, a value derived before, or any other key of the scenario.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from statistics import NormalDist
from typing import Any

import numpy as np

from ffsm_drake.common.errors import CampaignError
from ffsm_drake.scenario import shown

SAMPLINGS = ("latin_hypercube", "sobol", "random", "grid")
# Keeps quantiles of unbounded distributions finite: SciPy's points may touch zero.
_INSIDE = 2.0**-40

Value = float | list[float]


def unit_points(sampling: str, *, cases: int, dimensions: int, seed: int) -> np.ndarray:
    """Return points (cases, dimensions) in the open unit cube."""
    if dimensions == 0:
        return np.empty((cases, 0))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    if sampling == "random":
        points = generator.random((cases, dimensions))
    else:
        # here: slow to load, and workers, which are given their cases, do not need it
        from scipy.stats import qmc

        kind = qmc.LatinHypercube if sampling == "latin_hypercube" else qmc.Sobol
        points = kind(dimensions, seed=generator).random(cases)
    return np.clip(points, _INSIDE, 1.0 - _INSIDE)


def case_seed(seed: int, case: int) -> int:
    """``random_seed`` of a case: 31 bits of NumPy's SeedSequence(seed, spawn_key=(1, case))."""
    return int(np.random.SeedSequence(seed, spawn_key=(1, case)).generate_state(1)[0]) >> 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Distribution:
    """The distribution of a parameter or factor."""

    value: Callable[[float, int], Any]  # (quantile u in (0, 1), case number) -> value
    uses_point: bool = True  # whether it uses a dimension of the sampling
    is_logarithmic: bool = False
    levels: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # levels of a list, by name


_DISTRIBUTIONS = {
    "uniform": ("low", "high"),
    "log_uniform": ("low", "high"),
    "normal": ("mean", "deviation"),
    "choice": ("values",),
    "list": ("values",),
}


def parse_distribution(data: Any, *, place: str) -> Distribution:
    """Return the distribution that one entry of the specification describes; ``place`` names it in
    errors.

    Raises:
      CampaignError: an unknown distribution or field, a missing one, or numbers out of range.
    """
    example = "distribution: uniform, low: 0, high: 1"
    kind = _kind_of(data, "distribution", _DISTRIBUTIONS, place=place, example=example)
    if kind in ("choice", "list"):
        levels = _levels(data["values"], place=f"{place}.values")
        values = list(levels.values())
        if kind == "list":
            return Distribution(
                value=lambda u, case: values[case % len(values)], uses_point=False, levels=levels
            )
        return Distribution(value=lambda u, case: values[int(u * len(values))])
    first, second = (number(data[name], place=f"{place}.{name}") for name in _DISTRIBUTIONS[kind])
    if kind == "normal":
        if second <= 0.0:
            raise CampaignError(f"{place}.deviation: must be > 0, not {second:g}")
        return Distribution(value=lambda u, case: NormalDist(first, second).inv_cdf(u))
    if first >= second:
        raise CampaignError(f"{place}: low must be below high, not {first:g} and {second:g}")
    if kind == "uniform":
        if not math.isfinite(second - first):
            raise CampaignError(
                f"{place}: low and high are too far apart: {first:g} and {second:g}"
            )
        return Distribution(
            value=lambda u, case: min(max(first + u * (second - first), first), second)
        )
    if first <= 0.0:
        raise CampaignError(f"{place}.low: must be > 0 for log_uniform, not {first:g}")

    def log_uniform(u: float, case: int) -> float:
        exponent = math.log(first) + u * (math.log(second) - math.log(first))
        return min(max(math.exp(exponent), first), second)

    return Distribution(value=log_uniform, is_logarithmic=True)


def _levels(data: Any, *, place: str) -> dict[str, Any]:
    """Return the values of a choice or list by name; values without names are their own."""
    if not isinstance(data, (list, Mapping)) or not data:
        raise CampaignError(f"{place}: must be a list of at least one value, or values by name")
    if isinstance(data, Mapping):
        return {name: _tidy(value, place=f"{place}.{name}") for name, value in data.items()}
    values = [_tidy(value, place=f"{place}[{i}]") for i, value in enumerate(data)]
    names = [f"{value:g}" if isinstance(value, float) else str(value) for value in values]
    unique = len(set(names)) == len(names)
    return {
        name if unique else f"{i}: {name}": value
        for i, (name, value) in enumerate(zip(names, values, strict=True))
    }


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rule:
    """One entry of ``derive``: the values it reads, and the function applied to them."""

    sources: tuple[str, ...]
    apply: Callable[[list[Value]], Value]


_OPTIONAL = ("by",)
_RULES = {
    "scale": ("of", "by"),
    "sum": ("of",),
    "relative": ("of", "error"),
    "direction": ("of", "height", "azimuth"),
    "solid_cube": ("mass", "side"),
    "solid_sphere": ("mass", "radius"),
}
_SOLIDS = {"solid_cube": 1.0 / 6.0, "solid_sphere": 0.4}  # inertia over mass times size^2


def parse_rule(data: Any, *, place: str) -> Rule:
    """Parse the rule in one entry of ``derive``.

    Raises:
      CampaignError: an unknown rule or field, or a field missing or of the wrong type.
    """
    kind = _kind_of(
        data, "rule", _RULES, place=place, example="rule: scale, of: payload.truth.mass, by: 0.8"
    )
    sources = _names(data[_RULES[kind][0]], place=place)
    if kind == "relative":
        sources = (*sources, *_names(data["error"], place=place))
        return Rule(
            sources=sources,
            apply=lambda values: _product([*values[:-1], 1.0 + _single(values[-1])]),
        )
    if kind == "direction":
        places = (*_names(data["height"], place=place), *_names(data["azimuth"], place=place))
        if len(sources) > 1 or len(places) > 2:
            raise CampaignError(f"{place}: direction takes one name each of of, height and azimuth")
        return Rule(sources=(*sources, *places), apply=_direction)
    if kind in _SOLIDS:
        name, factor = _RULES[kind][1], _SOLIDS[kind]
        size = number(data[name], place=f"{place}.{name}")
        return Rule(sources=sources, apply=lambda m: [factor * _single(m[0]) * size * size] * 3)
    if kind == "sum":
        return Rule(sources=sources, apply=_sum)
    by = data.get("by", 1.0)
    is_list = isinstance(by, list)
    factors = [number(item, place=f"{place}.by") for item in (by if is_list else [by])]
    return Rule(
        sources=sources,
        apply=lambda values: _product([*values, factors if is_list else factors[0]]),
    )


def _product(values: list[Value]) -> Value:
    lists = [value for value in values if isinstance(value, list)]
    scalar = math.prod(value for value in values if not isinstance(value, list))
    if len(lists) > 1:
        raise CampaignError("only one of the values that are multiplied may be a list")
    return [scalar * item for item in lists[0]] if lists else scalar


def _sum(values: list[Value]) -> Value:
    if all(isinstance(value, list) for value in values):
        if len({len(value) for value in values if isinstance(value, list)}) > 1:
            raise CampaignError("lists that are added must have the same length")
        return [math.fsum(items) for items in zip(*values, strict=True)]
    return math.fsum(_single(value) for value in values)


def _direction(values: list[Value]) -> Value:
    size, height, azimuth = map(_single, values)
    if abs(height) > 1.0:
        raise CampaignError(f"height must be from -1 to 1, not {height:g}")
    across = size * math.sqrt(1.0 - height * height)
    return [across * math.cos(azimuth), across * math.sin(azimuth), size * height]


def _single(value: Value) -> float:
    if isinstance(value, list):
        raise CampaignError("needs a single number, not a list")
    return value


def number(data: Any, *, place: str) -> float:
    """Return a finite number, also from text such as 1e-7, which YAML reads as a string."""
    try:
        if isinstance(data, bool) or not isinstance(data, (int, float, str)):
            raise ValueError
        value = float(data)
    except OverflowError:
        raise CampaignError(
            f"{place}: must be finite, not a number of hundreds of digits"
        ) from None
    except ValueError:
        raise CampaignError(f"{place}: must be a number, not {shown(data)}") from None
    if not math.isfinite(value):
        raise CampaignError(f"{place}: must be finite, not {value}")
    return value


def check_plain(data: Any, *, place: str) -> None:
    """Raise CampaignError for what neither a scenario nor a database can hold, at any depth."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            if not isinstance(key, str) or not key.isprintable() or not key:
                raise CampaignError(f"{place}: key {shown(key)} must be printable text")
            check_plain(value, place=f"{place}.{key}")
    elif isinstance(data, list):
        for i, value in enumerate(data):
            check_plain(value, place=f"{place}[{i}]")
    elif isinstance(data, str):
        if any("\ud800" <= character <= "\udfff" for character in data):
            raise CampaignError(f"{place}: holds half a character (a lone surrogate)")
    elif isinstance(data, int):
        if not -(2**63) <= data < 2**63:
            raise CampaignError(
                f"{place}: a whole number must fit into 64 bits; write it with a decimal point"
            )
    elif not (data is None or isinstance(data, float)):
        raise CampaignError(
            f"{place}: must be a number, text, list or mapping, not a {type(data).__name__}; quote "
            "it"
        )


def check_keys(data: Mapping[str, Any], valid: tuple[str, ...], *, place: str) -> None:
    """Raise CampaignError for a key that is not valid."""
    for key in data:
        if key not in valid:
            raise CampaignError(f"{place}.{key}: unknown key; valid here: {', '.join(valid)}")


def _kind_of(
    data: Any, key: str, fields: Mapping[str, tuple[str, ...]], *, place: str, example: str
) -> str:
    """Return the kind named under ``key``; the entry's other keys must be the fields of that
    kind.
    """
    if not isinstance(data, Mapping):
        raise CampaignError(f"{place}: must be a mapping such as {{{example}}}")
    kind = data.get(key)
    if not isinstance(kind, str) or kind not in fields:
        raise CampaignError(
            f"{place}: {key} '{kind}' is unknown; choose one of {', '.join(fields)}"
        )
    check_keys(data, (key, *fields[kind]), place=place)
    if missing := [name for name in fields[kind] if name not in data and name not in _OPTIONAL]:
        raise CampaignError(f"{place}: {kind} needs {' and '.join(missing)}")
    return kind


def _names(data: Any, *, place: str) -> tuple[str, ...]:
    names = data if isinstance(data, list) else [data]
    if not names or not all(isinstance(name, str) for name in names):
        raise CampaignError(f"{place}: must name other values, not {shown(data)}")
    return tuple(names)


def _tidy(value: Any, *, place: str) -> Any:
    """Return a value for the scenario; numbers, also nested ones and those in text, must be
    finite.
    """
    if isinstance(value, Mapping):
        return {name: _tidy(item, place=f"{place}.{name}") for name, item in value.items()}
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


def get_value(data: Any, key: str) -> Any:
    """Return the value in plain data at a dotted key, such as ``payload.truth.center_of_mass.0``.

    Raises:
      CampaignError: there is none.
    """
    for part in key.split("."):
        try:
            data = data[_entry(data, part, key)]
        except (CampaignError, KeyError):
            raise CampaignError(f"{key}: the scenario has no such value") from None
    return data


def set_value(data: Any, key: str, value: Any) -> None:
    """Write the value at a dotted key; missing mappings are added. The schema is checked later.

    Raises:
      CampaignError: the key leads through a single value, or past the end of a list.
    """
    *parents, last = key.split(".")
    for part in parents:
        if isinstance(data, dict) and data.get(part) is None:
            data[part] = {}
        data = data[_entry(data, part, key)]
    data[_entry(data, last, key)] = value


def _entry(data: Any, part: str, key: str) -> int | str:
    """Index into a mapping or list for one part of a dotted key."""
    if isinstance(data, dict):
        return part
    if not isinstance(data, list):
        raise CampaignError(f"{key}: unknown key; '{part}' lies within a single value")
    if not part.isdecimal() or int(part) >= len(data):
        raise CampaignError(f"{key}: '{part}' must be a number from 0 to {len(data) - 1}")
    return int(part)
