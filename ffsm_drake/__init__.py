"""Simulate and judge controllers of a free-flying space manipulator that has just captured a piece of debris."""

from ffsm_drake.closed_loop import ClosedLoop, make_closed_loop
from ffsm_drake.errors import FfsmError, ModelError, RecordError, ScenarioError
from ffsm_drake.plant import PlantModel, make_nominal_plant, make_true_plant
from ffsm_drake.record import Outcome, RunRecord
from ffsm_drake.scenario import Scenario, load_scenario, override_scenario
from ffsm_drake.simulation import simulate

__all__ = [
    "ClosedLoop",
    "FfsmError",
    "ModelError",
    "PlantModel",
    "Outcome",
    "RecordError",
    "RunRecord",
    "Scenario",
    "ScenarioError",
    "load_scenario",
    "make_closed_loop",
    "make_nominal_plant",
    "make_true_plant",
    "override_scenario",
    "simulate",
]
