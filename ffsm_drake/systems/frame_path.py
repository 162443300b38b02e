"""The frame whose pose a scenario prescribes (``reference.frame``)."""

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame

from ffsm_drake.scenario import FrameGoal, Scenario
from ffsm_drake.spacecraft.free_floating import TASK_ROWS
from ffsm_drake.spacecraft.plant import find_frame, hand_frame

# length of a row: quaternion (w, x, y, z) of R_WF, p_WF, w_WF, v_WF, alpha_WF, a_WF
FRAME_SIZE = 19


def goal_frame(scenario: Scenario, plant: MultibodyPlant) -> Frame:
    """Return the frame of ``reference.frame``. Raises ModelError: there is no such frame."""
    goal = scenario.reference.frame or FrameGoal()
    if goal.frame is None:
        return hand_frame(plant, scenario.model)
    return find_frame(plant, goal.frame, key="reference.frame.frame")


def tracked_rows(scenario: Scenario) -> slice:
    """Return the rows of a twist [w; v] that a law tracks: the prescribed ones of
    ``reference.frame``, or all if there are none.
    """
    goal = scenario.reference.frame
    return TASK_ROWS["pose" if goal is None or goal.task == "none" else goal.task]
