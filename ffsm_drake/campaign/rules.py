"""Derived values: named rules that compute a value from others of the same case.

  scale         of (one name or several) multiplied with each other and with ``by`` (a number or a list; default 1)
  sum           of (several names), added up; lists of the same length element by element
  relative      of * (1 + error)
  solid_cube    inertia of a homogeneous cube: mass side^2 / 6 about each axis
  solid_sphere  inertia of a homogeneous sphere: 2/5 mass radius^2 about each axis

A name is a factor, a parameter, a value derived before, or any other key of the scenario.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

from ffsm_drake.campaign.distributions import check_keys, number
from ffsm_drake.campaign.errors import CampaignError

Value = float | list[float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rule:
    """One entry of ``derive``: the values it reads, and the function applied to them."""

    sources: tuple[str, ...]
    apply: Callable[[list[Value]], Value]


def parse_rule(data: Any, *, place: str) -> Rule:
    """The rule that one entry of ``derive`` describes.

    Raises:
      CampaignError: an unknown rule or field, or one that is missing or of the wrong type.
    """
    if not isinstance(data, Mapping):
        raise CampaignError(f"{place}: must be a mapping such as {{rule: scale, of: payload.truth.mass, by: 0.8}}")
    kind = data.get("rule")
    if kind not in _FIELDS:
        raise CampaignError(f"{place}: rule '{kind}' is unknown; choose one of {', '.join(_FIELDS)}")
    required, optional = _FIELDS[kind]
    check_keys(data, ("rule", *required, *optional), place=place)
    if missing := [name for name in required if name not in data]:
        raise CampaignError(f"{place}: {kind} needs {' and '.join(missing)}")
    if kind == "relative":
        return Rule(sources=(*_names(data["of"], place=place), *_names(data["error"], place=place)), apply=_relative)
    if kind == "solid_cube":
        side = number(data["side"], place=f"{place}.side")
        return Rule(sources=_names(data["mass"], place=place), apply=lambda m: [_single(m[0]) * side * side / 6.0] * 3)
    if kind == "solid_sphere":
        radius = number(data["radius"], place=f"{place}.radius")
        return Rule(
            sources=_names(data["mass"], place=place), apply=lambda m: [0.4 * _single(m[0]) * radius * radius] * 3
        )
    sources = _names(data["of"], place=place)
    if kind == "sum":
        return Rule(sources=sources, apply=_sum)
    by = data.get("by", 1.0)
    factor: Value = (
        [number(item, place=f"{place}.by") for item in by] if isinstance(by, list) else number(by, place=f"{place}.by")
    )
    return Rule(sources=sources, apply=lambda values: _product([*values, factor]))


_FIELDS: dict[Any, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "scale": (("of",), ("by",)),
    "sum": (("of",), ()),
    "relative": (("of", "error"), ()),
    "solid_cube": (("mass", "side"), ()),
    "solid_sphere": (("mass", "radius"), ()),
}


def _names(data: Any, *, place: str) -> tuple[str, ...]:
    names = data if isinstance(data, list) else [data]
    if not names or not all(isinstance(name, str) for name in names):
        raise CampaignError(f"{place}: must name other values, not {data!r}")
    return tuple(names)


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


def _relative(values: list[Value]) -> Value:
    *of, error = values
    return _product([*of, 1.0 + _single(error)])


def _single(value: Value) -> float:
    if isinstance(value, list):
        raise CampaignError("needs a single number, not a list")
    return value
