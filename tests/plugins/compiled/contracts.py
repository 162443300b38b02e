"""For mypy: what other plug-ins bring has what compiled runs read of it."""

from ffsm_drake.plugins.actuators.row import acting_blocks
from ffsm_drake.plugins.capture.modes import Supervising, Supervisor
from ffsm_drake.plugins.capture.supervisor import SupervisorPart
from ffsm_drake.plugins.compiled import supervising
from ffsm_drake.plugins.compiled.scenario_blocks import ActingBlocks

ACTING: ActingBlocks = acting_blocks


def watch(block: Supervising) -> supervising.Watch:
    return block


def supervisor(made: Supervisor) -> supervising.Supervisor:
    return made


def supervised(part: SupervisorPart) -> supervising.Supervised:
    return part
