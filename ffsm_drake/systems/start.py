"""The motion of servicer and payload at the start of a run, or right after a grasp."""

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration
from ffsm_drake.systems.closed_chains import CLOSED_CHAINS
from ffsm_drake.systems.grasping import GRASPINGS


def velocity_at_start(mission: Mission, model: PlantModel) -> np.ndarray:
    """Return the initial velocity (nv) of the motion with the target held. Raises as a grasp."""
    scenario = mission.scenario
    if scenario.grasps:
        return _after_grasp(mission, model)
    return model.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)


def state_at_start(mission: Mission, model: PlantModel) -> np.ndarray:
    """Return [q; v] of the plant at the start. Raises the errors of a grasp."""
    scenario = mission.scenario
    q = configuration(model.coordinates, scenario.initial_posture, key="initial_posture")
    v = model.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)
    state = model.split.whole(np.concatenate([q, v]))
    if scenario.grasps and model.grip.holds:
        state[model.plant.num_positions() :] += _after_grasp(mission, model)
    if len(scenario.contacts) > 1:
        return CLOSED_CHAINS.only("contacts").start(mission, model, state)
    return state


def _after_grasp(mission: Mission, model: PlantModel) -> np.ndarray:
    """Velocity (nv) right after the grasp of the target with the model's payload."""
    return GRASPINGS.only("capture").contact(mission, model).grasp.velocity
