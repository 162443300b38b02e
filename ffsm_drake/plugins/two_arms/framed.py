"""A motion of the closed chain whose frame follows a path (``reference.frame``).

The rates along the path are resolved in the minimal velocities of the hands that hold the target
from the start. Hands that close later come to their places as in ``following``. They move a base
that is not driven, and the base moves the arm that carries the target, so both are found together.
"""

import copy
from collections.abc import Callable, Sequence

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.two_arms.chain import ClosedChain, joints_to
from ffsm_drake.plugins.two_arms.chain_model import ChainModel, model_at
from ffsm_drake.plugins.two_arms.closed_motion import ClosedMotion
from ffsm_drake.plugins.two_arms.following import NODES, Following, Reach, span, with_arms
from ffsm_drake.scenario.contacts import ALL_HANDS, Grip
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.frame_path import goal_frame
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import FOLLOWERS

_KEY = "reference.frame"
_ROUNDS, _SAME = 30, 1e-10  # rounds, at most; change of joints that ends them, rad or m
# Steps of the integration, of _STEP and of the motion, with the change of joints that ends them;
# the last rounds integrate adaptively.
_STEP, _OF_MOTION = 0.5, 0.05  # s, and fraction of the duration, at most
_STAGES = ((1.0, 1e-8), (0.5, _SAME))


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
    held_by = [loop.name for loop in held.loops]
    late = [loop for loop in hands if loop.name not in held_by]
    names = np.array(nominal.coordinates.names)
    given = [str(names[i]) for loop in late for i in loop.joints] if scenario.undriven else []
    first = motion.evaluate(0.0)[0]
    posture, model = held.closed(first), nominal
    if held.loops:
        model = model_at(scenario, held, posture)
    period, moved = scenario.sample_time, posture - first

    def resolved(arms: Sequence[Reach], step: float | None = None) -> PlannedMotion:
        wanted = _Moved(motion, moved, arms, period)
        follower: Callable[..., PlannedMotion] = FOLLOWERS.load(_KEY, _KEY)
        marks = [time for each in arms for time in each.marks]
        made = follower(wanted, mission, model, given, step, marks)
        if isinstance(model, ChainModel):
            made = _OfTree(made, model, nominal.coordinates, period)
        return made

    if not late and closed is None:
        return ClosedMotion(resolved([]), mission, nominal)

    def follow(arms: Sequence[Reach], share: float = 0.0) -> Following:
        step = share * min(_STEP, _OF_MOTION * motion.end)
        how = {"most": NODES} if step else {}
        made = resolved(arms, step or None)
        return Following(made, mission, nominal, since=since, closed=closed, **how)

    kept = _kept(mission, motion.end) if closed is None else []
    if given and not kept:
        kept.append(_consistent(follow, late[0].name))
    found = copy.copy(kept[0]) if given else follow([])
    if closed is None:
        found.begin, found.end = span(scenario, nominal.grip, found.end)
    return found


@planned
def _kept(mission: Mission, end: float) -> list[Following]:
    """A cache: the motion to an end (s), which all phases share."""
    return []


def _consistent(follow: Callable[[Sequence[Reach], float], Following], name: str) -> Following:
    """A motion that has the arms for which it is made, by a fixed-point iteration that begins with
    the arms' own motion. Raises ScenarioError: there is none.

    A round begins with the combination of those before with the least change (Anderson 1965,
    doi:10.1145/321296.321305). The first rounds have given steps (``_STAGES``): an adaptive
    integration takes longer, and its errors, which are not smooth, delay the convergence.
    """
    stages, largest = [*_STAGES, (0.0, _SAME)], np.inf
    arms, steps, before = follow([], stages[0][0]).arms, list[np.ndarray](), None
    for _ in range(_ROUNDS):
        found = follow(arms, stages[0][0])
        sizes = [each.values.size for each in found.arms]
        if sizes != [each.values.size for each in arms]:  # other nodes
            arms, steps, before = found.arms, [], None
            continue
        used, made = (
            np.concatenate([each.values.ravel() for each in of]) for of in (arms, found.arms)
        )
        change = made - used
        now, largest = np.array([change, made]), np.abs(change).max()
        if before is not None:
            steps.append(now - before)
        before = now
        if largest < stages[0][1]:
            if len(stages) == 1:
                found.arms = arms  # base and carrying arm have been made for these
                return found
            del stages[0]
            before = None  # other errors of integration
        if steps:
            changes, rows = np.swapaxes(steps, 0, 1)
            made = made - np.linalg.lstsq(changes.T, change, rcond=None)[0] @ rows
        parts = np.split(made, np.cumsum(sizes)[:-1])
        arms = [each.with_values(own) for each, own in zip(found.arms, parts, strict=True)]
    raise ScenarioError(
        f"contacts.{name}.closes",
        f"the arm moves the base, and no place of its hand is found (change {largest:.2g} rad); "
        "close later",
    )


class _Moved(PlannedMotion):
    """A motion with its positions moved, so that the loops are closed at the start."""

    def __init__(
        self, motion: PlannedMotion, change: np.ndarray, arms: Sequence[Reach], period: float
    ) -> None:
        self._motion, self._change, self._arms = motion, change, arms
        super().__init__(coordinates=motion.coordinates, sample_time=period, end=motion.end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._motion.rows(times)
        rows[:, : self._change.size] += self._change
        return with_arms(self, rows, self._arms, times)


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
