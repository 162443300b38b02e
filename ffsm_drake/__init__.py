"""Simulate and evaluate controllers of a free-flying space manipulator that has just captured a
piece of debris.

The verbs: ``simulate``, ``compare``, ``analyze``, ``stability``, ``design``; those of installed
plug-ins, such as ``run_campaign``, are names of this module too.
"""

import importlib

# not from typing: nothing that takes a while is imported before the command line handles signals
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from ffsm_drake.common.errors import (
        BlockError,
        FfsmError,
        ModelError,
        RecordError,
        ScenarioError,
    )
    from ffsm_drake.common.settings import setting
    from ffsm_drake.loop.closed_loop import ClosedLoop, add_closed_loop, make_closed_loop
    from ffsm_drake.plugins.analysis import analyze
    from ffsm_drake.plugins.design.gains import design
    from ffsm_drake.plugins.design.stability import stability
    from ffsm_drake.runs.ending import Ending, Outcome
    from ffsm_drake.runs.log import RunLog
    from ffsm_drake.runs.record import RunRecord
    from ffsm_drake.runs.rollout import Rollout
    from ffsm_drake.runs.simulate import compare, simulate, simulate_many
    from ffsm_drake.scenario import Scenario, load_scenario, override_scenario
    from ffsm_drake.show.outputs import write_outputs
    from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
    from ffsm_drake.spacecraft.nominal import PlantModel, make_nominal_plant, make_true_plant
    from ffsm_drake.systems.controllers import ControlLaw, InjectedDynamics, Sample, gain
    from ffsm_drake.systems.part import Metric, Part, Signal
    from ffsm_drake.systems.setup import BlockSetup

# Imported on first use: Drake takes a while, and the command line's help should not wait for it.
_HOMES = {
    "plugins.analysis": ("analyze",),
    "common.errors": ("BlockError", "FfsmError", "ModelError", "RecordError", "ScenarioError"),
    "plugins.design.gains": ("design",),
    "plugins.design.stability": ("stability",),
    "loop.closed_loop": ("ClosedLoop", "add_closed_loop", "make_closed_loop"),
    "runs.ending": ("Ending", "Outcome"),
    "runs.log": ("RunLog",),
    "runs.record": ("RunRecord",),
    "runs.rollout": ("Rollout",),
    "runs.simulate": ("compare", "simulate", "simulate_many"),
    "scenario": ("Scenario", "load_scenario", "override_scenario"),
    "show.outputs": ("write_outputs",),
    "spacecraft.free_floating": ("FreeFloating", "free_floating"),
    "spacecraft.nominal": ("PlantModel", "make_nominal_plant", "make_true_plant"),
    "systems.controllers": ("ControlLaw", "InjectedDynamics", "Sample", "gain"),
    "systems.part": ("Metric", "Part", "Signal"),
    "systems.setup": ("BlockSetup",),
    "common.settings": ("setting",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "BlockError",
    "BlockSetup",
    "ClosedLoop",
    "ControlLaw",
    "Ending",
    "FfsmError",
    "FreeFloating",
    "InjectedDynamics",
    "Metric",
    "ModelError",
    "Outcome",
    "Part",
    "PlantModel",
    "RecordError",
    "Rollout",
    "RunLog",
    "RunRecord",
    "Sample",
    "Scenario",
    "ScenarioError",
    "Signal",
    "add_closed_loop",
    "analyze",
    "compare",
    "design",
    "free_floating",
    "gain",
    "load_scenario",
    "make_closed_loop",
    "make_nominal_plant",
    "make_true_plant",
    "override_scenario",
    "setting",
    "simulate",
    "simulate_many",
    "stability",
    "write_outputs",
]


def __getattr__(name: str) -> "Any":
    if name in _HOME_OF:
        return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    if not name.startswith("_"):
        plugins = importlib.import_module(f"{__name__}.common.plugins")
        if name in plugins.offered(plugins.VERBS):
            return plugins.load(plugins.VERBS, name, f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
