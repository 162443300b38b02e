"""Simulate and judge controllers of a free-flying space manipulator that has just captured a piece of debris."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ffsm_drake.closed_loop import ClosedLoop, make_closed_loop
    from ffsm_drake.controllers import ControllerSetup, Sample, SampledController
    from ffsm_drake.errors import ControllerError, FfsmError, ModelError, RecordError, ScenarioError
    from ffsm_drake.outputs import write_outputs
    from ffsm_drake.plant import PlantModel, make_nominal_plant, make_true_plant
    from ffsm_drake.record import Outcome, RunRecord
    from ffsm_drake.scenario import Scenario, load_scenario, override_scenario
    from ffsm_drake.simulation import Rollout, RunLog, simulate

# Imported on first use: Drake takes a while, and the command line's help should not wait for it.
_HOMES = {
    "ClosedLoop": "closed_loop",
    "make_closed_loop": "closed_loop",
    "ControllerSetup": "controllers",
    "Sample": "controllers",
    "SampledController": "controllers",
    "ControllerError": "errors",
    "FfsmError": "errors",
    "ModelError": "errors",
    "RecordError": "errors",
    "ScenarioError": "errors",
    "write_outputs": "outputs",
    "PlantModel": "plant",
    "make_nominal_plant": "plant",
    "make_true_plant": "plant",
    "Outcome": "record",
    "RunRecord": "record",
    "Scenario": "scenario",
    "load_scenario": "scenario",
    "override_scenario": "scenario",
    "Rollout": "simulation",
    "RunLog": "simulation",
    "simulate": "simulation",
}

__all__ = [
    "ClosedLoop",
    "ControllerError",
    "ControllerSetup",
    "FfsmError",
    "ModelError",
    "Outcome",
    "PlantModel",
    "RecordError",
    "Rollout",
    "RunLog",
    "RunRecord",
    "Sample",
    "SampledController",
    "Scenario",
    "ScenarioError",
    "load_scenario",
    "make_closed_loop",
    "make_nominal_plant",
    "make_true_plant",
    "override_scenario",
    "simulate",
    "write_outputs",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
