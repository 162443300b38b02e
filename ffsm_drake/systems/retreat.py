"""The planned motion after a target that was not captured: away from it, and to it again."""

import dataclasses

import numpy as np
from pydrake.systems.framework import Diagram

from ffsm_drake.scenario import Posture
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.reference import PolynomialMotion, make_motion, reference_from
from ffsm_drake.systems.setup import BlockSetup


class _Retrying(PlannedMotion):
    """A motion that begins at a time, and another, if any, that begins later where it ends."""

    def __init__(
        self,
        retreat: PlannedMotion,
        again: PlannedMotion | None,
        *,
        first: float,
        turn: float,
        sample_time: float,
    ) -> None:
        self._retreat, self._again, self._first, self._turn = retreat, again, first, turn
        super().__init__(
            coordinates=retreat.coordinates,
            sample_time=sample_time,
            begin=turn + (again.begin if again else 0.0),
            end=turn + (again.end if again else 0.0),
        )

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        rows = self._retreat.rows(times - self._first)
        if self._again is None:
            return rows
        later = times > self._turn - 1e-9
        return np.where(later[:, None], self._again.rows(times - self._turn), rows)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetreatReference:
    """A reference that leads from a desired state to rest in a posture, and then, from ``again``
    on, through the scenario's own motion, which begins there.
    """

    first: float  # s
    start: Posture
    velocity: np.ndarray  # (nv)
    goal: Posture
    duration: float  # s
    again: float | None = None  # s

    def motion(self, setup: BlockSetup) -> PlannedMotion:
        """The motion as a function of the run's time."""
        scenario, coordinates = setup.scenario, setup.coordinates
        retreat = PolynomialMotion(
            coordinates=coordinates,
            start=self.start,
            target=self.goal,
            blend=Blend(scenario.reference, self.duration),
            base_rotation="eigenaxis",
            sample_time=scenario.sample_time,
            velocity=self.velocity,
        )
        again = None if self.again is None else make_motion(scenario, coordinates)
        turn = self.first + retreat.end if self.again is None else self.again
        return _Retrying(
            retreat, again, first=self.first, turn=turn, sample_time=scenario.sample_time
        )

    def __call__(self, setup: BlockSetup) -> Diagram:
        """The block."""
        motion = self.motion(setup)
        return reference_from([motion], [], setup.coordinates, sample_time=setup.sample_time)
