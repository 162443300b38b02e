"""The controllers: the paper's four, time-delay estimation (tde.py) around their own laws, and the door for others."""

from typing import Any

from pydrake.systems.framework import LeafSystem

from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers.estimators import make_estimator
from ffsm_drake.systems.controllers.laws.aismc import AismcLaw
from ffsm_drake.systems.controllers.laws.asmc import AsmcLaw
from ffsm_drake.systems.controllers.laws.tdc import TdcLaw
from ffsm_drake.systems.controllers.laws.tde_aismc import TdeAismcLaw
from ffsm_drake.systems.controllers.registry import build_controller, controller_names, find_factory, setup_for
from ffsm_drake.systems.controllers.sampled import OPTIONAL_OUTPUTS, ControllerSetup, Sample, SampledController
from ffsm_drake.systems.controllers.time_delay import TimeDelayController

__all__ = [
    "LAWS",
    "OPTIONAL_OUTPUTS",
    "ControllerSetup",
    "Sample",
    "SampledController",
    "controller_names",
    "make_controller",
]

LAWS: dict[str, Any] = {"tdc": TdcLaw, "asmc": AsmcLaw, "aismc": AismcLaw, "tde_aismc": TdeAismcLaw}


def make_controller(scenario: Scenario, nominal: PlantModel) -> LeafSystem:
    """The scenario's controller as a LeafSystem of that name (its part after the colon).

    Raises:
      ScenarioError: gains of unknown or missing coordinates.
      ControllerError: a controller from elsewhere cannot be loaded, built or wired.
    """
    name = scenario.controller
    if name not in LAWS:
        return build_controller(find_factory(name), setup_for(scenario, nominal))
    law = LAWS[name].from_gains(getattr(scenario.controllers, name), nominal.coordinates, scenario.sample_time)
    controller = TimeDelayController(
        nominal=nominal,
        estimator=make_estimator(scenario, nominal.coordinates),
        law=law,
        sample_time=scenario.sample_time,
    )
    controller.set_name(name)
    return controller
