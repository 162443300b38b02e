"""The shipped layouts of thrusters, and those that a scenario has."""

import functools
from pathlib import Path

import yaml

from ffsm_drake.scenario.schema import Scenario, Thruster, Thrusters


@functools.cache
def thruster_layouts() -> dict[str, dict[str, Thruster]]:
    """Layout -> name -> thruster."""
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    return {
        layout: {name: Thruster(**values) for name, values in units.items()}
        for layout, units in yaml.safe_load(text).items()
    }


def thrusters_of(settings: Thrusters) -> dict[str, Thruster]:
    """The thrusters that settings describe, by name."""
    return settings.units if settings.layout is None else thruster_layouts()[settings.layout]


def own_thrusters(scenario: Scenario) -> dict[str, Thruster]:
    """The thrusters of a scenario's own actuators, by name; empty where it has none, or a
    user-supplied block.
    """
    settings = scenario.actuation.thrusters
    return (
        {} if settings is None or scenario.blocks.actuation is not None else thrusters_of(settings)
    )
