"""The planned motion after a target that was not captured: away from it, and to it again."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from ffsm_drake.scenario import Grip, Posture, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import InTurn, PlannedMotion
from ffsm_drake.systems.polynomial_motion import PolynomialMotion
from ffsm_drake.systems.reference import make_motion


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


def along(
    moves: Sequence[Move],
    plan: Scenario,
    coordinates: Coordinates,
    grip: Grip,
    *,
    again: float | None,
) -> PlannedMotion:
    """Along moves, and from the time ``again`` (s) on, if it is given, along a scenario's plan."""
    motions: list[tuple[float, PlannedMotion]] = [
        (move.begin, move.motion(plan, coordinates)) for move in moves
    ]
    begin = end = moves[-1].begin + moves[-1].duration
    if again is not None:
        own = make_motion(plan, coordinates, grip)
        motions.append((again, own))
        begin, end = again + own.begin, again + own.end
    return InTurn(motions, begin=begin, end=end, sample_time=plan.sample_time)
