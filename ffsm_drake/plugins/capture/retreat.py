"""The planned motion after a target that was not captured: away from it, and to it again."""

import dataclasses

import numpy as np
from pydrake.systems.framework import Diagram

from ffsm_drake.scenario import Posture, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import InTurn, PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion, reference_from
from ffsm_drake.systems.setup import BlockSetup


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
        return InTurn(motions, begin=begin, end=end, sample_time=scenario.sample_time)

    def __call__(self, setup: BlockSetup) -> Diagram:
        """The block."""
        motion = self.motion(setup)
        return reference_from([motion], [], setup.coordinates, sample_time=setup.sample_time)
