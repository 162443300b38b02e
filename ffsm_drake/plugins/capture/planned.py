"""The planned capture of a mission, for the core."""

import dataclasses
from typing import Any

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.capture.approach import planned_approach
from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.plugins.capture.momentum import momentum_budget
from ffsm_drake.plugins.capture.tables import grasp_lines
from ffsm_drake.systems.grasping import Grasping
from ffsm_drake.systems.planned_motion import PlannedMotion


class Planned(Grasping):
    """The grasp in ``initial_posture``, and the approach to it."""

    contact = staticmethod(planned_contact)
    lines = staticmethod(grasp_lines)

    def approach(self, mission: Mission) -> PlannedMotion:
        """See Grasping."""
        return planned_approach(mission)

    def budget(self, mission: Mission) -> dict[str, Any] | None:
        """See Grasping."""
        found = momentum_budget(mission)
        return None if found is None else dataclasses.asdict(found)


PLANNED = Planned()
