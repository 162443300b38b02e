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
import functools
import itertools
import math
from collections.abc import Callable, Mapping
from statistics import NormalDist
from typing import Any

import numpy as np

from ffsm_drake.common.errors import CampaignError
from ffsm_drake.scenario.resolving import entry_named, resolve

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


_Names = list[str]  # of other values; one may stand alone
_Numbers = list[float]  # or one number
_OPTIONAL = {"by": 1.0}  # fields that may be left out, with their values
_DISTRIBUTIONS: dict[str, dict[str, Any]] = {
    "uniform": {"low": float, "high": float},
    "log_uniform": {"low": float, "high": float},
    "normal": {"mean": float, "deviation": float},
    "choice": {"values": Any},
    "list": {"values": Any},
}


def parse_distribution(data: Any, *, place: str) -> Distribution:
    """Return the distribution that one entry of the specification describes; ``place`` names it in
    errors.

    Raises:
      CampaignError, ScenarioError: an unknown distribution or field, a missing one, or numbers out
        of range.
    """
    example = "distribution: uniform, low: 0, high: 1"
    kind, given = _parsed(data, "distribution", _DISTRIBUTIONS, place=place, example=example)
    if kind in ("choice", "list"):
        levels = _levels(given["values"], place=f"{place}.values")
        values = list(levels.values())
        if kind == "list":
            return Distribution(
                value=lambda u, case: values[case % len(values)], uses_point=False, levels=levels
            )
        return Distribution(value=lambda u, case: values[int(u * len(values))])
    if kind == "normal":
        if given["deviation"] <= 0.0:
            raise CampaignError(f"{place}.deviation: must be > 0, not {given['deviation']:g}")
        normal = NormalDist(given["mean"], given["deviation"])
        return Distribution(value=lambda u, case: normal.inv_cdf(u))
    low, high = given["low"], given["high"]
    if low >= high:
        raise CampaignError(f"{place}: low must be below high, not {low:g} and {high:g}")
    if kind == "uniform":
        return Distribution(value=lambda u, case: min(max(low + u * (high - low), low), high))
    if low <= 0.0:
        raise CampaignError(f"{place}.low: must be > 0 for log_uniform, not {low:g}")
    first, last = math.log(low), math.log(high)
    return Distribution(
        value=lambda u, case: min(max(math.exp(first + u * (last - first)), low), high),
        is_logarithmic=True,
    )


def _levels(data: Any, *, place: str) -> dict[str, Any]:
    """Return the values of a choice or list by name; values without names are their own."""
    if not isinstance(data, (list, dict)) or not data:
        raise CampaignError(f"{place}: must be a list of at least one value, or values by name")
    levels: dict[str, Any]
    if isinstance(data, dict):
        levels = data
    else:
        names = [f"{value:g}" if isinstance(value, float) else str(value) for value in data]
        if len(set(names)) < len(names):
            names = [f"{i}: {name}" for i, name in enumerate(names)]
        levels = dict(zip(names, data, strict=True))
    for name, value in levels.items():
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise CampaignError(
                f"{place}.{name}: a whole number must fit into 64 bits; write it with a decimal "
                "point"
            )
    return levels


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rule:
    """One entry of ``derive``: the values it reads, and the function applied to them."""

    sources: tuple[str, ...]
    apply: Callable[[list[Value]], Value]


def parse_rule(data: Any, *, place: str) -> Rule:
    """Parse the rule in one entry of ``derive``.

    Raises:
      CampaignError, ScenarioError: an unknown rule or field, or a field missing or of the wrong
        type.
    """
    kinds = {kind: fields for kind, (fields, _) in _RULES.items()}
    example = "rule: scale, of: payload.truth.mass, by: 0.8"
    kind, given = _parsed(data, "rule", kinds, place=place, example=example)
    fields, function = _RULES[kind]
    names = {name: value for name, value in given.items() if fields[name] in (str, _Names)}
    constants = [value for name, value in given.items() if name not in names]
    sources = (name if isinstance(name, list) else [name] for name in names.values())
    return Rule(
        sources=tuple(itertools.chain(*sources)), apply=lambda values: function(values, *constants)
    )


def _scale(values: list[Value], by: Value) -> Value:
    factors = [*values, by]
    lists = [value for value in factors if isinstance(value, list)]
    scalar = math.prod(value for value in factors if not isinstance(value, list))
    if len(lists) > 1:
        raise CampaignError("only one of the values that are multiplied may be a list")
    return [scalar * item for item in lists[0]] if lists else scalar


def _sum(values: list[Value]) -> Value:
    if all(isinstance(value, list) for value in values):
        if len({len(value) for value in values if isinstance(value, list)}) > 1:
            raise CampaignError("lists that are added must have the same length")
        return [math.fsum(items) for items in zip(*values, strict=True)]
    return math.fsum(_single(value) for value in values)


def _relative(values: list[Value]) -> Value:
    return _scale(values[:-1], 1.0 + _single(values[-1]))


def _direction(values: list[Value]) -> Value:
    size, height, azimuth = map(_single, values)
    if abs(height) > 1.0:
        raise CampaignError(f"height must be from -1 to 1, not {height:g}")
    across = size * math.sqrt(1.0 - height * height)
    return [across * math.cos(azimuth), across * math.sin(azimuth), size * height]


def _solid(factor: float, values: list[Value], size: float) -> Value:
    return [factor * _single(values[0]) * size * size] * 3


def _single(value: Value) -> float:
    if isinstance(value, list):
        raise CampaignError("needs a single number, not a list")
    return value


# rule -> its fields, and its function of the values that are named and of the other fields
_RULES: dict[str, tuple[dict[str, Any], Callable[..., Value]]] = {
    "scale": ({"of": _Names, "by": _Numbers}, _scale),
    "sum": ({"of": _Names}, _sum),
    "relative": ({"of": _Names, "error": str}, _relative),
    "direction": ({"of": str, "height": str, "azimuth": str}, _direction),
    # inertia: a factor times mass times size^2
    "solid_cube": ({"mass": str, "side": float}, functools.partial(_solid, 1.0 / 6.0)),
    "solid_sphere": ({"mass": str, "radius": float}, functools.partial(_solid, 0.4)),
}


def _parsed(
    data: Any, key: str, kinds: Mapping[str, dict[str, Any]], *, place: str, example: str
) -> tuple[str, dict[str, Any]]:
    """Return the kind named under ``key``, and the entry's other values, which must be the fields
    of that kind.
    """
    if not isinstance(data, Mapping):
        raise CampaignError(f"{place}: must be a mapping such as {{{example}}}")
    kind = data.get(key)
    if not isinstance(kind, str) or kind not in kinds:
        raise CampaignError(f"{place}: {key} '{kind}' is unknown; choose one of {', '.join(kinds)}")
    fields, found = kinds[kind], {**_OPTIONAL, **data}
    for name in data:
        if name not in (key, *fields):
            valid = ", ".join((key, *fields))
            raise CampaignError(f"{place}.{name}: unknown key; valid here: {valid}")
    if missing := [name for name in fields if found.get(name) in (None, [])]:
        raise CampaignError(f"{place}: {kind} needs {' and '.join(missing)}")
    given = {}
    for name, type_ in fields.items():
        value = found[name]
        if type_ is _Names and not isinstance(value, list):
            value = [value]
        alone = type_ is _Numbers and not isinstance(value, list)
        given[name] = resolve(float if alone else type_, None, value, f"{place}.{name}")
    return kind, given


def get_value(data: Any, key: str) -> Any:
    """Return the value in plain data at a dotted key, such as ``payload.truth.center_of_mass.0``.

    Raises:
      CampaignError: there is none.
    """
    for part in key.split("."):
        try:
            data, place = _placed(data, part, key)
            data = data[place]
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
        data, place = _placed(data, part, key)
        if isinstance(data, dict) and data.get(place) is None:
            data[place] = {}
        data = data[place]
    data, place = _placed(data, last, key)
    data[place] = value


def _placed(data: Any, part: str, key: str) -> tuple[Any, int | str]:
    """A mapping or list, or the entry of that name in a list, with its index for one part of a
    dotted key.
    """
    data = entry_named(data, part) or data
    if isinstance(data, dict):
        return data, part
    if not isinstance(data, list):
        raise CampaignError(f"{key}: unknown key; '{part}' lies within a single value")
    if not part.isdecimal() or int(part) >= len(data):
        raise CampaignError(f"{key}: '{part}' must be a number from 0 to {len(data) - 1}")
    return data, int(part)
