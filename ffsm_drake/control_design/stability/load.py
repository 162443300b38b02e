"""The force that a motion and a wrong velocity at its start ask for, against its limits."""

import numpy as np

from ffsm_drake.control_design.stability.linearization import Linearizer
from ffsm_drake.spacecraft.limits import FORCE, tightest
from ffsm_drake.spacecraft.nominal import make_true_plant
from ffsm_drake.systems.limits import limits_of

_ANSWER = 1.0  # s; response of the loop to a wrong velocity at the start
_INSTANTS = 101  # of the plan after that


def predicted_load(linearizer: Linearizer) -> float:
    """Largest force after a grasp, without noise, as a fraction of its limit; above 1 it saturates.

    The first second, in which the loop responds to the difference between true and planned velocity
    after the grasp, is run without noise and limits. After that it is the force of perfect tracking
    with the true payload, less the disturbance.
    """
    scenario, motion = linearizer.given, linearizer.motion
    answer = min(round(_ANSWER / scenario.sample_time), scenario.num_control_periods)
    _, force = linearizer.follow(samples=answer)
    begin = answer * scenario.sample_time
    times = np.linspace(begin, max(begin, min(motion.end, scenario.duration)), _INSTANTS)
    _, ideal = linearizer.planned.perfect_tracking(times)
    plant = make_true_plant(scenario).plant
    limit = tightest(limits_of(scenario, plant, helped=True), FORCE)
    share = np.abs(np.concatenate([force, ideal])) / limit.upper
    return float(np.nan_to_num(share, nan=np.inf).max())
