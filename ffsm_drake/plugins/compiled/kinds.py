"""Which scenarios can have the same code."""

import dataclasses
import json
from typing import Any

from ffsm_drake.scenario import Scenario, scenario_to_dict

# Sections on which code depends only through blocks and the controller's name, see ``Run.key``.
_FREE = (
    "controller",
    "controllers",
    "description",
    "random_seed",
    "divergence_speed",
    "tolerance",
    "clearance",
    "planning",
    "initial_posture",
    "initial_velocity",
    "target_posture",
    "disturbance",
    "payload",
    "capture",
)


def kind_of(scenario: Scenario) -> str:
    """Equal for scenarios that differ in their controllers, in numbers other than zero, and in the
    sections ``_FREE``.
    """
    neutral = Scenario()
    free = {name: getattr(neutral, name) for name in _FREE}
    data = scenario_to_dict(dataclasses.replace(scenario, **free))
    exact = {name: data[name] for name in ("sample_time", "simulator_config")}
    return json.dumps(_kind(data) | exact, sort_keys=True)


def _kind(data: Any) -> Any:
    """Plain data without the values of its numbers other than zero; those by coordinate, and of
    vectors, as one.
    """
    entries = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    if entries and all(isinstance(each, float) for each in entries):
        return any(entries)
    if isinstance(data, dict):
        return {name: _kind(value) for name, value in data.items()}
    if isinstance(data, list):
        return [_kind(value) for value in data]
    return bool(data) if isinstance(data, float) else data
