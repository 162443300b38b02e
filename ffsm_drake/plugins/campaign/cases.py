"""The cases of a campaign: number -> seed and values, and their scenario for a controller."""

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

from ffsm_drake.common.errors import CampaignError
from ffsm_drake.common.settings import fresh
from ffsm_drake.plugins.campaign.dispersion import (
    Value,
    case_seed,
    get_value,
    set_value,
    unit_points,
)
from ffsm_drake.plugins.campaign.spec import Spec
from ffsm_drake.scenario import Scenario, scenario_from_dict, shown


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One draw of all dispersed values; every controller meets the same."""

    index: int  # from 0
    seed: int  # the scenario's random_seed
    values: Mapping[str, Any]  # by name: parameters, factors, derived values


def make_cases(spec: Spec) -> Iterator[Case]:
    """All cases of a campaign, in their order.

    Raises:
      CampaignError: a rule cannot be applied to its sources.
    """
    distributions = spec.distributions
    sampled = [name for name, distribution in distributions.items() if distribution.uses_point]
    points = unit_points(spec.sampling, cases=spec.cases, dimensions=len(sampled), seed=spec.seed)
    strides = spec.strides
    for index in range(spec.cases):
        point = dict(zip(sampled, points[index].tolist(), strict=True))
        drawn = {
            name: item.value(point.get(name, 0.0), index // strides[name])
            for name, item in distributions.items()
        }
        yield make_case(spec, index, drawn)


def make_case(spec: Spec, index: int, drawn: Mapping[str, Any]) -> Case:
    """Return the case with given values of all parameters and factors.

    Raises:
      CampaignError: a rule cannot be applied to its sources.
    """
    values = dict(drawn)
    for name, rule in spec.rules.items():
        try:
            values[name] = rule.apply([_operand(spec, values, source) for source in rule.sources])
        except CampaignError as error:
            raise CampaignError(f"derive.{name}: {error}") from None
        except OverflowError:
            values[name] = math.inf
    for name, value in values.items():
        numbers = value if isinstance(value, list) else [value]
        if not all(math.isfinite(x) for x in numbers if isinstance(x, float)):
            raise CampaignError(f"{name}: is not finite in case {index}: {value}")
    return Case(index=index, seed=case_seed(spec.seed, index), values=values)


def _operand(spec: Spec, values: Mapping[str, Any], source: str) -> Value:
    value = values[source] if source in values else get_value(spec.base, source)
    numbers = value if isinstance(value, list) else [value]
    if not all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in numbers):
        raise CampaignError(f"{source} must be a number or a list of numbers, not {shown(value)}")
    return value


def scenario_of(spec: Spec, case: Case, controller: str) -> Scenario:
    """Return the scenario of one case for one controller, checked as any other.

    Raises:
      CampaignError, ScenarioError: a key is unknown, or a value cannot be used.
    """
    data = fresh(spec.base)
    for name, value in case.values.items():
        if name not in spec.factors:
            set_value(data, name, value)
    data["random_seed"], data["controller"] = case.seed, controller
    return scenario_from_dict(data)


def with_controller(scenario: Scenario, controller: str) -> Scenario:
    """Return the scenario of a case for another controller of the campaign; they share all else,
    as the same objects.
    """
    made = copy.copy(scenario)
    made.controller = controller
    return made
