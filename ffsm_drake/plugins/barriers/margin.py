"""What the linear verdict covers of a loop with barriers: it leaves them out."""

from collections.abc import Iterator

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.barriers.guarded import GuardedLaw
from ffsm_drake.scenario import EMPTY, HELD, Grip
from ffsm_drake.spacecraft.coordinates import NUM_BASE_POSITIONS, NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.limits import FORCE
from ffsm_drake.systems.controllers import make_controller
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import make_motion

_INSTANTS = 201
_OUT = "not in the linear loop"
_JOINTS = slice(NUM_BASE_VELOCITIES, None)


def barrier_remark(mission: Mission) -> str:
    """Return whether barriers act along the planned motion with perfect tracking, and with what
    margin they do not: then the linear loop is that of small errors. Noise and disturbances are
    left out.

    Raises: the errors of ``with_barriers``.
    """
    scenario = mission.scenario
    if scenario.blocks.reference is not None:
        return f"{_OUT}; the motion of blocks.reference is not checked"
    motion = make_motion(mission)
    nearest = np.inf, "", 0.0
    for begin, end, grip in _legs(mission, motion):
        times = np.linspace(begin, end, _INSTANTS)
        margins, names = margins_along(mission, motion, times, grip)
        if (acts := margins.min(axis=1) <= 0.0).any():
            first = int(acts.argmax())
            name = names[int(margins[first].argmin())]
            return (
                f"{_OUT}; they act on the planned motion, first on {name} at t = "
                f"{times[first]:.3g} s, so the linear results do not cover it"
            )
        row, joint = np.unravel_index(margins.argmin(), margins.shape)
        nearest = min(nearest, (float(margins[row, joint]), names[joint], float(times[row])))
    least, name, time = nearest
    if not np.isfinite(least):
        return f"{_OUT}; no joint has a limit"
    return (
        f"{_OUT}; inactive for small errors along the plan: {name} has the smallest margin, "
        f"{least:.3g} rad/s^2 or m/s^2 at t = {time:.3g} s"
    )


def margins_along(
    mission: Mission, motion: PlannedMotion, times: np.ndarray, grip: Grip = HELD
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return distances of the predicted accelerations from the bounds of barriers (n, nj), rad/s^2
    or m/s^2, and the names of the joints. A negative one changes the force.

    Args:
      mission: a mission with barriers.
      motion: tracked perfectly by the spacecraft with its true payload.
      times: s (n).
      grip: what holds the target.
    """
    nominal, true = mission.craft.nominal(grip), mission.craft.true(grip)
    law = make_controller(mission, nominal).law
    assert isinstance(law, GuardedLaw)
    q, v, _ = motion.evaluate(times)
    force = motion.demand(true, times)[FORCE]
    predicted = np.array([
        np.linalg.solve(nominal.calc_mass_matrix(each), own - nominal.calc_bias(each, rate))
        for each, rate, own in zip(q, v, force, strict=True)
    ])[:, _JOINTS]  # fmt: skip
    low, high = law.bounds(q[:, NUM_BASE_POSITIONS:], v[:, _JOINTS])
    return np.minimum(predicted - low, high - predicted), law.joints


def _legs(mission: Mission, motion: PlannedMotion) -> Iterator[tuple[float, float, Grip]]:
    """Begin and end of the plan's parts, s, and what holds the target in each."""
    scenario = mission.scenario
    if motion.begin > 0.0:
        yield 0.0, motion.begin - scenario.sample_time, EMPTY
    yield motion.begin, min(motion.end, scenario.duration), HELD
