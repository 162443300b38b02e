"""When a run first exceeded each of its limits."""

import numpy as np

from ffsm_drake.common.numbers import usable
from ffsm_drake.runs.exceeded_limits import INSTANTS
from ffsm_drake.runs.log import RunLog
from ffsm_drake.spacecraft.clearance import TOLERANCE, shapes_of
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, SLACK, tightest
from ffsm_drake.systems.mission_limits import limits_of

CLEARANCE = "clearance"  # its name among the exceeded limits


def limits_left(log: RunLog, near: tuple[np.ndarray, np.ndarray] | None = None) -> dict[str, float]:
    """Times of a run's first excess of each of its limits, s: commanded forces, rates and positions
    of the coordinates, limits of parts, clearance.

    ``near``: the run's ``distances_in``, if already known.
    """
    clearance = shapes_of(log.scenario)
    parts = [placed.part for placed in log.parts.values()]
    limits = limits_of(log.mission, parts, helped=True)
    q, v = np.split(log.series["state"], [len(log.coordinates.position_names)], axis=1)
    motion = {FORCE: log.generalized_force, RATE: v, POSITION: q[:, 1:]}
    found = {}
    for limit in (
        *(tightest(limits, quantity) for quantity in motion),
        *(limit for limit in limits if limit.quantity not in motion and limit.quantity in log),
    ):
        values = motion[limit.quantity] if limit.quantity in motion else log[limit.quantity]
        left = limit.used(values.reshape(len(values), -1)) > 1.0 + SLACK
        for i in np.flatnonzero(left.any(axis=0)):
            found[limit.told(int(i))] = float(log.time[np.argmax(left[:, i])])
    times, distances = distances_in(log) if near is None else near
    too_near = distances < log.scenario.clearance - TOLERANCE
    if clearance.unmeasured:
        found[CLEARANCE] = float(log.time[0])
    elif too_near.any():
        found[CLEARANCE] = float(times[np.argmax(too_near)])
    return found


def distances_in(log: RunLog) -> tuple[np.ndarray, np.ndarray]:
    """Instants of a run, s (n), and the smallest distance of parts then, m (n), with hidden
    coordinates as logged and, before the grasp, the target where it then was.
    """
    held = 0 if log.grasp is None else log.grasp.sample
    positions = log.table["position"].values
    hidden = np.empty((log.time.size, 0))
    if "hidden_state" in log.series:
        hidden = np.split(log.series["hidden_state"], 2, axis=1)[0]
    times, found = [np.empty(0)], [np.empty(0)]
    for first, last in ((0, held), (held, log.time.size)):
        if first >= last:
            continue
        samples = np.unique(np.linspace(first, last - 1, INSTANTS).round().astype(int))
        parts, apart = [positions[samples], hidden[samples]], False
        if last == held and log.grasp is not None:
            parts.insert(1, log.grasp.target[samples, :7])
            apart = True
        shapes, q = shapes_of(log.scenario, apart=apart), np.hstack(parts)
        if shapes.pairs:
            good = usable(q)
            times.append(log.time[samples[good]])
            found.append(np.array([shapes.nearest(each).distance for each in q[good]]))
    return np.concatenate(times), np.concatenate(found)
