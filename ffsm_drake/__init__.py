"""Simulate and evaluate controllers of a free-flying space manipulator that has just captured a
piece of debris.

The verbs: ``simulate``, ``compare``, and those of installed plug-ins, such as ``analyze``,
``stability``, ``design`` and ``run_campaign``. Type checkers read ``__init__.pyi``.
"""

import importlib

# Imported on first use: Drake takes a while, and the command line's help should not wait for it.
_HOMES = {
    "common.errors": ("BlockError", "FfsmError", "ModelError", "RecordError", "ScenarioError"),
    "common.settings": ("setting",),
    "loop.closed_loop": ("ClosedLoop", "add_closed_loop", "make_closed_loop"),
    "runs.ending": ("Ending", "Outcome"),
    "runs.log": ("RunLog",),
    "runs.phases": ("Phase", "make_rollout"),
    "runs.record": ("RunRecord",),
    "runs.rollout": ("Rollout",),
    "runs.simulate": ("compare", "simulate", "simulate_many"),
    "scenario": ("Scenario", "load_scenario", "override_scenario"),
    "show.outputs": ("write_outputs",),
    "spacecraft.free_floating": ("FreeFloating", "free_floating"),
    "spacecraft.craft": ("make_nominal_plant", "make_true_plant"),
    "spacecraft.nominal": ("PlantModel",),
    "systems.controllers": ("ControlLaw", "InjectedDynamics", "Sample", "gain"),
    "systems.parts.metrics": ("Metric",),
    "systems.parts.part": ("Part",),
    "systems.parts.signals": ("Signal",),
    "systems.sampled": ("Sampled",),
    "systems.setup": ("BlockSetup",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = sorted(_HOME_OF)


def __getattr__(name: str) -> object:
    if name in _HOME_OF:
        return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    if not name.startswith("_"):
        verbs = importlib.import_module(f"{__name__}.common.registrations").VERBS
        if name in verbs.offers():
            return verbs.load(name, f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
