"""Designs of any law: its declared gains varied by group, on the wired loop."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.design.gains.requirement import DesignPoint, Requirement
from ffsm_drake.plugins.design.rounding import rounded, rounded_by_group
from ffsm_drake.plugins.design.stability.outputs import Group
from ffsm_drake.scenario import Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.controllers import declared_gains, make_law

# Prices of effort, and factors by which gains are varied.
PRICES_VARIED = (0.08, 0.022, 0.006)
_FACTORS = (2.0, 1.4)
_PENALTY = 10.0  # weight of log(rms error) beyond that of the given gains


def vary(
    start: DesignPoint,
    evaluate: Callable[[Scenario], DesignPoint],
    *,
    requirement: Requirement,
    on_price: Callable[[], None],
) -> None:
    """Vary the declared gains by group; a step is kept for the groups whose cost it lowers."""
    best = start
    for price in PRICES_VARIED:
        for factor in _FACTORS:
            for name in _tunable(best.scenario):
                for step in (factor, 1.0 / factor):
                    point = evaluate(
                        _scaled(best.scenario, name, dict.fromkeys(_groups(best), step))
                    )
                    before = _group_costs(best, price, requirement)
                    after = _group_costs(point, price, requirement)
                    better = {
                        group: step for group in before if after[group] < before[group] - 1e-3
                    }
                    if not better:
                        continue
                    joined = (
                        point
                        if len(better) == len(before) or _is_scalar(best.scenario, name)
                        else evaluate(_scaled(best.scenario, name, better))
                    )
                    if sum(_group_costs(joined, price, requirement).values()) < sum(
                        before.values()
                    ):
                        best = joined
                        break
        on_price()


def _group_costs(point: DesignPoint, price: float, requirement: Requirement) -> dict[str, float]:
    """log(rms error * crowding) + price * effort by group, and a penalty where it is less accurate
    than it was; infinite where the point is unstable for some payload, not run, or loses a margin.
    """
    baseline, crowding = requirement.baseline, requirement.crowding(point.prediction)
    prediction, groups = point.prediction, _groups(point)
    refused = point.lost_margin or not point.is_run or not np.isfinite(prediction.isv)
    if refused or max(point.radius_by_mass.values()) >= 1.0:
        return dict.fromkeys(groups, np.inf)
    errors = prediction.by_group()
    costs = {
        name: float(
            np.log(errors[name] * crowding[group.forces].max()) + price * prediction.isv_of(group)
        )
        for name, group in groups.items()
    }
    if baseline is not None and "accuracy" not in baseline.trade:
        for name, (after, before) in baseline.errors(point).items():
            costs[name] += _PENALTY * max(0.0, float(np.log(after / before)))
    return costs


def _groups(point: DesignPoint) -> Mapping[str, Group]:
    return point.prediction.groups


def _is_scalar(scenario: Scenario, name: str) -> bool:
    """Whether a value is one for all groups."""
    gain = declared_gains(scenario).get(name)
    return gain is not None and gain.scalar


def _tunable(scenario: Scenario) -> list[str]:
    """Names that ``_scaled`` takes: feedback gains, except bounds, and random walks. Scalar gains
    must be per time, because others may be shares or powers.
    """
    names = [
        name
        for name, gain in declared_gains(scenario).items()
        if gain.feedback and not gain.bound and (not gain.scalar or gain.unit.startswith("1/s"))
    ]
    mission = Mission(scenario)
    law = make_law(mission, mission.craft.nominal())
    return [*names, *getattr(law, "random_walks", ())]


def _scaled(scenario: Scenario, name: str, factors: Mapping[str, float]) -> Scenario:
    """The scenario with one tunable value times a factor by group, and likewise the upper bound of
    an adapted gain.
    """
    data: dict[str, Any] = scenario_to_dict(scenario)
    gains = data["controllers"][scenario.controller_key]
    coordinates = Craft(scenario).coordinates
    if _is_scalar(scenario, name):
        value, scale = coordinates.vector(gains[name], key=name)[0], next(iter(factors.values()))
        gains[name] = {"all": rounded(float(value) * scale)}
        return scenario_from_dict(data)
    factor = coordinates.vector(factors, key=name, default=1.0)
    place = gains if name in gains else data["estimator"]
    for key in (name, f"{name.removesuffix('_initial')}_max"):
        if place.get(key) is not None:
            values = coordinates.vector(place[key], key=key)
            place[key] = rounded_by_group(factor * values, coordinates)
    return scenario_from_dict(data)
