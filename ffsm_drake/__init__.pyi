"""What a type checker sees of the package, the verbs of its plug-ins too."""

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
from ffsm_drake.plugins.campaign.run import run_campaign
from ffsm_drake.plugins.design.gains import design
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.exports.export import export
from ffsm_drake.runs.ending import Ending, Outcome
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.phases import Phase, make_rollout
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.runs.simulate import compare, simulate, simulate_many
from ffsm_drake.scenario import Scenario, load_scenario, override_scenario
from ffsm_drake.show.outputs import write_outputs
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.free_floating import FreeFloating, free_floating
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.controllers import ControlLaw, InjectedDynamics, Sample, gain
from ffsm_drake.systems.parts.metrics import Metric
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.parts.signals import Signal
from ffsm_drake.systems.sampled import Sampled
from ffsm_drake.systems.setup import BlockSetup

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
    "Phase",
    "PlantModel",
    "RecordError",
    "Rollout",
    "RunLog",
    "RunRecord",
    "Sample",
    "Sampled",
    "Scenario",
    "ScenarioError",
    "Signal",
    "add_closed_loop",
    "analyze",
    "compare",
    "design",
    "export",
    "free_floating",
    "gain",
    "load_scenario",
    "make_closed_loop",
    "make_nominal_plant",
    "make_rollout",
    "make_true_plant",
    "override_scenario",
    "run_campaign",
    "setting",
    "simulate",
    "simulate_many",
    "stability",
    "write_outputs",
]
