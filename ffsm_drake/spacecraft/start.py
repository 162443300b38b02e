"""The motion of servicer and payload at the start of a run, or right after a grasp."""

import numpy as np

from ffsm_drake.plugins.capture.contact import planned_contact
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import configuration


def velocity_at_start(scenario: Scenario, model: PlantModel) -> np.ndarray:
    """Initial velocity (nv) of the motion with the target held; errors as ``planned_contact``."""
    if scenario.grasps:
        return planned_contact(scenario, model).grasp.velocity
    return model.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)


def state_at_start(scenario: Scenario, model: PlantModel) -> np.ndarray:
    """The plant's own [q; v] at the start; errors as ``planned_contact``."""
    q = configuration(model.plant, scenario.initial_posture, key="initial_posture")
    v = model.coordinates.vector(scenario.initial_velocity, key="initial_velocity", default=0.0)
    state = model.split.whole(np.concatenate([q, v]))
    if scenario.grasps:
        state[model.plant.num_positions() :] += planned_contact(scenario, model).grasp.velocity
    return state
