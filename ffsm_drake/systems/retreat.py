"""The planned motion after a target that was not captured: away from it, and to it again."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import Diagram

from ffsm_drake.scenario import Posture, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion, reference_from
from ffsm_drake.systems.setup import BlockSetup


class _InTurn(PlannedMotion):
    """Motions that begin at given times of the run, each where the one before it ends."""

    def __init__(
        self,
        motions: Sequence[tuple[float, PlannedMotion]],
        *,
        begin: float,
        end: float,
        sample_time: float,
    ) -> None:
        self._motions, coordinates = motions, motions[-1][1].coordinates
        super().__init__(coordinates=coordinates, sample_time=sample_time, begin=begin, end=end)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        (first, motion), *later = self._motions
        rows = motion.rows(times - first)
        for begin, motion in later:
            rows = np.where((times > begin - 1e-9)[:, None], motion.rows(times - begin), rows)
        return rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class Move:
    """A motion from one posture to rest in another, that begins at a time of the run."""

    begin: float  # s
    duration: float  # s
    start: Posture
    goal: Posture
    velocity: np.ndarray | None = None  # (nv) at the start

    def motion(self, scenario: Scenario, coordinates: Coordinates) -> PolynomialMotion:
        """As a function of the time since its begin."""
        return PolynomialMotion(
            coordinates=coordinates,
            start=self.start,
            target=self.goal,
            blend=Blend(scenario.reference, self.duration),
            base_rotation="eigenaxis",
            sample_time=scenario.sample_time,
            velocity=self.velocity,
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RetreatReference:
    """A reference that moves from a desired state to rest, and on, and then, from ``again`` on,
    goes through the scenario's own motion, which begins there.
    """

    moves: tuple[Move, ...]
    again: float | None = None  # s

    def motion(self, setup: BlockSetup) -> PlannedMotion:
        """The motion as a function of the run's time."""
        scenario, coordinates = setup.scenario, setup.coordinates
        motions: list[tuple[float, PlannedMotion]] = [
            (move.begin, move.motion(scenario, coordinates)) for move in self.moves
        ]
        last = self.moves[-1]
        begin = end = last.begin + last.duration
        if self.again is not None:
            own = make_motion(scenario, coordinates)
            motions.append((self.again, own))
            begin, end = self.again + own.begin, self.again + own.end
        return _InTurn(motions, begin=begin, end=end, sample_time=scenario.sample_time)

    def __call__(self, setup: BlockSetup) -> Diagram:
        """The block."""
        motion = self.motion(setup)
        return reference_from([motion], [], setup.coordinates, sample_time=setup.sample_time)
