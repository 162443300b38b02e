"""Motions backwards in time, and those of an empty gripper whose base is not driven."""

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.scenario import EMPTY
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import FOLLOWERS

_KEY = "actuation.driven"


def floated(motion: PlannedMotion, mission: Mission) -> PlannedMotion:
    """Return a motion whose undriven coordinates conserve its momentum at its start."""
    if not mission.scenario.undriven:
        return motion
    return FOLLOWERS.load(_KEY, _KEY)(motion, mission, mission.craft.nominal(EMPTY))


def unfloated(motion: PlannedMotion, sample_time: float) -> PlannedMotion:
    """Return a motion with the driven coordinates of one that ``floated``, backwards or not, and
    with any others. The others need integration.
    """
    if isinstance(motion, Backwards):
        inner = unfloated(motion.motion, sample_time)
        return Backwards(inner, sample_time=sample_time, end=motion.end)
    return getattr(motion, "wanted", motion)


class From(PlannedMotion):
    """A motion with the undriven coordinates of a row, the state in which ``floated`` begins."""

    def __init__(self, motion: PlannedMotion, row: np.ndarray, *, sample_time: float) -> None:
        """Args: the motion; [q; v; ...] of its first instant; the control period, s."""
        self._motion, coordinates = motion, motion.coordinates
        undriven = np.flatnonzero(~coordinates.is_driven)
        nq = coordinates.num_positions
        turns = [0] if undriven.size and not undriven[0] else []
        self._columns = np.concatenate([turns, undriven + 1, undriven + nq]).astype(int)
        self._values = row[self._columns]
        super().__init__(coordinates=coordinates, sample_time=sample_time, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._motion.rows(times)
        rows[:, self._columns] = self._values
        return rows


class Backwards(PlannedMotion):
    """A motion from its end to its beginning."""

    def __init__(
        self, motion: PlannedMotion, *, sample_time: float, end: float | None = None
    ) -> None:
        """Args: the motion; the control period, s; its end, s, default: its own."""
        self.motion, end = motion, motion.end if end is None else end
        super().__init__(coordinates=motion.coordinates, sample_time=sample_time, end=end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self.motion.rows(self.end - times)
        first = len(self.coordinates.position_names)
        rows[:, first : first + len(self.coordinates.names)] *= -1.0
        return rows


def before(
    motion: PlannedMotion, row: np.ndarray, mission: Mission, *, duration: float
) -> PlannedMotion:
    """Return a motion of a duration (s) whose undriven coordinates end, with their momentum, in a
    row [q; v; ...].
    """
    period = mission.scenario.sample_time
    back = Backwards(From(motion, row, sample_time=period), sample_time=period, end=duration)
    return Backwards(floated(back, mission), sample_time=period)
