"""Designs of any law: its declared gains varied by group, on the loop as it is wired."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ffsm_drake.control_design.gains.requirement import DesignPoint
from ffsm_drake.scenario import Scenario, controller_key, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.systems.controllers import PAPER_LAWS, declared_gains
from ffsm_drake.systems.controllers.estimators import KINDS

# Prices and factors that other laws' gains are varied with.
PRICES_VARIED = (0.08, 0.022, 0.006)
_FACTORS = (2.0, 1.4)


def varied(
    start: DesignPoint, evaluate: Callable[[Scenario], DesignPoint], *, on_price: Callable[[], None]
) -> Iterator[DesignPoint]:
    """All that is tried while the declared gains are varied by group; a step is kept for the groups
    that it helps.
    """
    best = start
    yield best
    for price in PRICES_VARIED:
        for factor in _FACTORS:
            for name in _tunable(best.scenario):
                for step in (factor, 1.0 / factor):
                    point = evaluate(
                        _scaled(best.scenario, name, dict.fromkeys(_groups(best), step))
                    )
                    yield point
                    before, after = _group_costs(best, price), _group_costs(point, price)
                    better = {
                        group: step for group in before if after[group] < before[group] - 1e-3
                    }
                    if not better:
                        continue
                    joined = (
                        point
                        if len(better) == len(before)
                        else evaluate(_scaled(best.scenario, name, better))
                    )
                    yield joined
                    if sum(_group_costs(joined, price).values()) < sum(before.values()):
                        best = joined
                        break
        on_price()


def _group_costs(point: DesignPoint, price: float) -> dict[str, float]:
    """log(rms error) + price * effort by group; infinite where the point is unstable for some
    payload.
    """
    prediction, groups = point.prediction, _groups(point)
    if max(point.radius_by_mass.values()) >= 1.0 or not np.isfinite(prediction.isv):
        return dict.fromkeys(groups, np.inf)
    errors = prediction.by_group()
    return {
        name: float(np.log(errors[name]) + price * prediction.isv_by_coordinate[part].sum())
        for name, part in groups.items()
    }


def _groups(point: DesignPoint) -> Mapping[str, slice]:
    return point.prediction.coordinates.driven_groups


def _tunable(scenario: Scenario) -> list[str]:
    """What ``_scaled`` takes: feedback gains by coordinate, bounds apart, and the estimator's
    walk.
    """
    gains = declared_gains(scenario)
    names = [
        name for name, gain in gains.items() if gain.feedback and not gain.bound and not gain.scalar
    ]
    walks = KINDS[scenario.estimator.kind].walks
    return [*names, *(walks if scenario.controller in PAPER_LAWS else ())]


def _scaled(scenario: Scenario, name: str, factors: Mapping[str, float]) -> Scenario:
    """The scenario with one tunable value times a factor by group, and with it the bound it must
    stay below.
    """
    coordinates = make_nominal_plant(scenario).coordinates
    data: dict[str, Any] = scenario_to_dict(scenario)
    if name in ("walk", "force_walk"):
        data["estimator"][name] = _times(data["estimator"][name], factors, coordinates)
        return scenario_from_dict(data)
    gains = data["controllers"][controller_key(scenario.controller)]
    bound = f"{name.removesuffix('_initial')}_max"
    for each in (name, bound) if gains.get(bound) is not None else (name,):
        gains[each] = _times(gains[each], factors, coordinates)
    return scenario_from_dict(data)


def _times(
    value: Mapping[str, float], factors: Mapping[str, float], coordinates: Coordinates
) -> dict[str, float]:
    """Values by coordinate times factors by group, three digits, by group where a group's are
    equal.
    """
    vector = coordinates.vector(value, key="")
    result: dict[str, float] = {}
    for group, part in coordinates.groups.items():
        scaled = [
            float(f"{number * factors.get(group, 1.0):.3g}") for number in vector[part].tolist()
        ]
        equal = len(set(scaled)) == 1
        result |= (
            {group: scaled[0]} if equal else dict(zip(coordinates.names[part], scaled, strict=True))
        )
    return result
