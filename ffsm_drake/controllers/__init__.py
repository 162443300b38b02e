"""The four controllers of the paper. Each is time-delay estimation (tde.py) around its own injected dynamics."""

from typing import Any

from ffsm_drake.controllers.aismc import AismcLaw
from ffsm_drake.controllers.asmc import AsmcLaw
from ffsm_drake.controllers.estimators import make_estimator
from ffsm_drake.controllers.tdc import TdcLaw
from ffsm_drake.controllers.tde import TimeDelayController
from ffsm_drake.controllers.tde_aismc import TdeAismcLaw
from ffsm_drake.plant import PlantModel
from ffsm_drake.scenario import Scenario

LAWS: dict[str, Any] = {"tdc": TdcLaw, "asmc": AsmcLaw, "aismc": AismcLaw, "tde_aismc": TdeAismcLaw}


def make_controller(scenario: Scenario, nominal: PlantModel) -> TimeDelayController:
    """The scenario's controller as a LeafSystem of that name.

    Raises ScenarioError for gains of unknown or missing coordinates.
    """
    name = scenario.controller
    law = LAWS[name].from_gains(getattr(scenario.controllers, name), nominal.coordinates, scenario.sample_time)
    controller = TimeDelayController(
        nominal=nominal,
        estimator=make_estimator(scenario, nominal.coordinates),
        law=law,
        sample_time=scenario.sample_time,
    )
    controller.set_name(name)
    return controller
