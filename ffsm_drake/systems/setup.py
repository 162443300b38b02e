"""Inputs of a block's factory."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from ffsm_drake.common.errors import some
from ffsm_drake.scenario import Grip, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit
from ffsm_drake.spacecraft.nominal import PlantModel, make_true_plant


class _Settings(dict[str, Any]):
    """Settings whose KeyError lists the valid keys."""

    def __missing__(self, key: object) -> Any:
        raise KeyError(f"no '{key}' in the scenario's settings; there are: {some(self)}")


class CompositeBlock(Diagram):
    """A block of several systems; it passes the initial state to them."""

    def set_initial_state(self, context: Context, state: np.ndarray) -> None:
        """The spacecraft was at ``state`` [q; v] before the start."""
        for system in self.GetSystems():
            if hasattr(system, "set_initial_state"):
                system.set_initial_state(self.GetMutableSubsystemContext(system, context), state)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BlockSetup:
    """Input of a block's factory, which returns a Drake system with the ports of the block.

    The factory of a controller can return a control law instead. A controller must use only
    ``nominal``. ``true`` is for blocks of its environment, such as sensors and forces.

    Example:
      >>> from ffsm_drake import BlockSetup, load_scenario, make_nominal_plant
      >>> scenario = load_scenario("postcapture")
      >>> nominal = make_nominal_plant(scenario)
      >>> given = {"scenario": scenario, "nominal": nominal, "settings": {"gain": 2.0}}
      >>> setup = BlockSetup(name="drag", **given)
      >>> setup.settings["gain"], setup.sample_time, len(setup.coordinates.names)
      (2.0, 0.01, 11)
    """

    name: str  # the system's name in the diagram
    scenario: Scenario
    nominal: PlantModel  # the plant with the nominal payload
    settings: Mapping[str, Any]  # as the scenario gives them to this block
    # properties of the environment, unknown to any controller
    split: StateSplit = dataclasses.field(default_factory=StateSplit)

    def __post_init__(self) -> None:
        object.__setattr__(self, "settings", _Settings(self.settings))

    @property
    def coordinates(self) -> Coordinates:
        """Names of the generalized velocities."""
        return self.nominal.coordinates

    @property
    def grip(self) -> Grip:
        """What holds the target."""
        return self.nominal.grip

    @property
    def sample_time(self) -> float:
        """The control period L, s."""
        return self.scenario.sample_time

    @functools.cached_property
    def true(self) -> PlantModel:
        """The plant with the true payload, with its own context."""
        return make_true_plant(self.scenario, self.grip)
