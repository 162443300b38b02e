"""Simulate and judge controllers of a free-flying space manipulator that has just captured a piece of debris."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ffsm_drake.common.errors import BlockError, FfsmError, ModelError, RecordError, ScenarioError
    from ffsm_drake.loop.closed_loop import ClosedLoop, add_closed_loop, make_closed_loop
    from ffsm_drake.runs.record import Outcome, RunRecord
    from ffsm_drake.runs.rollout import Rollout, RunLog
    from ffsm_drake.runs.simulate import simulate
    from ffsm_drake.scenario import Scenario, load_scenario, override_scenario
    from ffsm_drake.show.outputs import write_outputs
    from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant, make_true_plant
    from ffsm_drake.systems.controllers import ControlLaw, InjectedDynamics, Sample, gain

# Imported on first use: Drake takes a while, and the command line's help should not wait for it.
_HOMES = {
    "ClosedLoop": "loop.closed_loop",
    "add_closed_loop": "loop.closed_loop",
    "make_closed_loop": "loop.closed_loop",
    "BlockSetup": "systems.setup",
    "ControlLaw": "systems.controllers",
    "InjectedDynamics": "systems.controllers",
    "gain": "systems.controllers",
    "Sample": "systems.controllers",
    "BlockError": "common.errors",
    "FfsmError": "common.errors",
    "ModelError": "common.errors",
    "RecordError": "common.errors",
    "ScenarioError": "common.errors",
    "write_outputs": "show.outputs",
    "PlantModel": "spacecraft.nominal",
    "make_nominal_plant": "spacecraft.nominal",
    "make_true_plant": "spacecraft.nominal",
    "Outcome": "runs.record",
    "RunRecord": "runs.record",
    "Scenario": "scenario",
    "load_scenario": "scenario",
    "override_scenario": "scenario",
    "Rollout": "runs.rollout",
    "RunLog": "runs.rollout",
    "simulate": "runs.simulate",
}

__all__ = [
    "ClosedLoop",
    "BlockError",
    "BlockSetup",
    "ControlLaw",
    "InjectedDynamics",
    "gain",
    "FfsmError",
    "ModelError",
    "Outcome",
    "PlantModel",
    "RecordError",
    "Rollout",
    "RunLog",
    "RunRecord",
    "Sample",
    "Scenario",
    "ScenarioError",
    "add_closed_loop",
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
