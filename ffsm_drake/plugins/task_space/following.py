"""Motions of a mission that follow a frame's path or the conservation of momentum."""

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.task_space.free_motion import FreeMotion
from ffsm_drake.plugins.task_space.resolved_motion import ResolvedMotion
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import goal_frame, make_frame_path
from ffsm_drake.systems.planned_motion import PlannedMotion


def free_motion(motion: PlannedMotion, mission: Mission, model: PlantModel) -> FreeMotion:
    """Return a motion whose undriven coordinates conserve momentum."""
    return FreeMotion(motion, model=model, sample_time=mission.scenario.sample_time)


def resolved_motion(motion: PlannedMotion, mission: Mission, model: PlantModel) -> ResolvedMotion:
    """Return a motion whose joints move a frame along its path. Raises the errors of the path.

    The model may be one of a closed chain, with fewer coordinates than the motion.
    """
    scenario, tree = mission.scenario, mission.craft.nominal(model.grip)
    assert scenario.reference.frame is not None
    return ResolvedMotion(
        motion,
        path=make_frame_path(mission, tree, duration=motion.end),
        goal=scenario.reference.frame,
        frame=goal_frame(scenario, model.plant),
        model=model,
        sample_time=scenario.sample_time,
    )
