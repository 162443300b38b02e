"""The grasp of a moving target, as a plug-in computes it."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol

from ffsm_drake.common.registrations import Registry
from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.grasp import Contact
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.planned_motion import PlannedMotion


class Grasping(Protocol):
    """The capture of a mission. Functions of a mission raise ScenarioError: a grasp of the target,
    or a motion to it, cannot be computed.
    """

    def contact(self, mission: Mission, model: PlantModel) -> Contact:
        """Return the planned grasp, with the payload of a model."""

    def approach(self, mission: Mission) -> PlannedMotion:
        """Return the motion with an empty gripper, from the start to the grasp."""

    def budget(self, mission: Mission) -> dict[str, Any] | None:
        """Return how momentum is stored after the grasp, as plain data; None: it is not limited."""

    def lines(self, grasps: Sequence[tuple[str, Mapping[str, Any]]]) -> Iterable[str]:
        """Return lines on the grasps of records, each with what the line begins with."""


GRASPINGS = Registry[Grasping]("graspings")
