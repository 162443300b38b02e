"""A motion of the closed chain whose frame follows a path (``reference.frame``).

The rates along the path are resolved in the minimal velocities of the hands that hold the target
from the start. Hands that close later come to their places as in ``following``.
"""

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.two_arms.chain import ClosedChain, joints_to
from ffsm_drake.plugins.two_arms.chain_model import ChainModel, model_at
from ffsm_drake.plugins.two_arms.closed_motion import ClosedMotion
from ffsm_drake.plugins.two_arms.following import Following, span
from ffsm_drake.scenario.contacts import ALL_HANDS, Grip
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import FOLLOWERS

_KEY = "reference.frame"


def framed_motion(
    motion: PlannedMotion,
    mission: Mission,
    nominal: PlantModel,
    *,
    since: float = 0.0,
    closed: float | None = None,
) -> PlannedMotion:
    """The motion of a chain with a frame on its path.

    Args: the motion without frame and chain; its mission; the plant with the nominal payload; see
      ``Following``.

    Raises ScenarioError: the frame is on an arm that follows, a hand does not reach its place, or
    an arm is singular.
    """
    scenario, plant = mission.scenario, nominal.plant
    held = ClosedChain(nominal, scenario, Grip(closed=closed or 0.0), true=False)
    hands = ClosedChain(nominal, scenario, ALL_HANDS, true=False).loops
    own = joints_to(plant, goal_frame(scenario, plant))
    for loop in hands:
        if np.isin(own, loop.joints).any():
            problem = f"is on the arm of contacts.{loop.name}, which follows; name a frame of the"
            raise ScenarioError(f"{_KEY}.frame", f"{problem} target or of the other arm")
    is_late = len(hands) > len(held.loops)
    if is_late and scenario.undriven:
        late = next(loop.name for loop in hands if loop.contact.closes)
        problem = "with reference.frame needs a base with actuators, because the arm moves the base"
        raise ScenarioError(f"contacts.{late}.closes", f"{problem} and the base moves its place")
    first = motion.evaluate(0.0)[0]
    posture, model = held.closed(first), nominal
    if held.loops:
        model = model_at(scenario, held, posture)
    period, moved = scenario.sample_time, posture - first
    made = FOLLOWERS.load(_KEY, _KEY)(_Moved(motion, moved, period), mission, model)
    if isinstance(model, ChainModel):
        made = _OfTree(made, model, nominal.coordinates, period)
    if not is_late and closed is None:
        return ClosedMotion(made, mission, nominal)
    found = Following(made, mission, nominal, since=since, closed=closed)
    if closed is None:
        found.begin, found.end = span(scenario, nominal.grip, made.end)
    return found


class _Moved(PlannedMotion):
    """A motion with its positions moved, so that the loops are closed at the start."""

    def __init__(self, motion: PlannedMotion, change: np.ndarray, period: float) -> None:
        self._motion, self._change = motion, change
        super().__init__(coordinates=motion.coordinates, sample_time=period, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._motion.rows(times)
        rows[:, : self._change.size] += self._change
        return rows


class _OfTree(PlannedMotion):
    """A motion in minimal velocities as one of the tree; rates of the others are zero."""

    def __init__(
        self, motion: PlannedMotion, model: ChainModel, coordinates: Coordinates, period: float
    ) -> None:
        self._motion, self.path = motion, motion.path
        self._free = np.arange(len(coordinates.names))[model.free]
        super().__init__(coordinates=coordinates, sample_time=period, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        nq, nv = self.coordinates.num_positions, self.coordinates.num_velocities
        q, v, a = np.split(self._motion.rows(times), [nq, nq + self._free.size], axis=1)
        rows = np.zeros((len(q), nq + 2 * nv))
        rows[:, :nq], rows[:, nq + self._free], rows[:, nq + nv + self._free] = q, v, a
        return rows

    def remarks(self) -> list[str]:
        """See PlannedMotion."""
        return self._motion.remarks()
