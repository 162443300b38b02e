"""The chosen gains, and what there is to say about the choice."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.design.gains.axis_search import FrontPoint
from ffsm_drake.plugins.design.gains.requirement import ROOM, DesignPoint, Requirement
from ffsm_drake.plugins.design.limit import Limit
from ffsm_drake.plugins.design.stability.prediction import Prediction, predict
from ffsm_drake.scenario import Estimator

_KINDS = {
    "kalman": "Kalman estimate",
    "coupled": "Coupled Kalman estimate",
    "one_sample": "One-sample estimate",
    "varied": "Gains varied by group",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """The chosen gains and the candidates."""

    chosen: DesignPoint
    given: DesignPoint  # the given scenario
    found: Mapping[str, DesignPoint]  # the best of each kind: of estimate, or "varied" gains
    kept: bool  # whether the given gains are the chosen ones
    active_constraint: str  # the constraint that limits the chosen gains, one line
    front: tuple[FrontPoint, ...]  # with the chosen estimate; empty if none was traced
    limit: Limit  # limit for the chosen gains
    ideal_isv: float
    requirement: Requirement
    # name -> (given, chosen); empty if not evaluated
    margins: Mapping[str, tuple[float, float]]
    adapts: bool  # whether adaptation can change K_s, at whose start the margins hold
    ended_by: str = ""  # reason for an early end of the search

    @functools.cached_property
    def with_defaults(self) -> Prediction | None:
        """The prediction with the law's default gains and the default estimator; None if the
        defaults do not fit the spacecraft.
        """
        default = dataclasses.replace(self.given.scenario, controllers={}, estimator=Estimator())
        try:
            return predict(default)
        except ScenarioError:
            return None

    @property
    def remarks(self) -> list[str]:
        """The comparison and the active constraint, a sentence each."""
        after, before = self.chosen.prediction, self.given.prediction
        factor = float(np.exp(before.mean_log_error - after.mean_log_error))
        violated = self.requirement.violated(self.given)
        if self.kept and violated:
            remarks = [
                "The current gains are kept, because the search found no better gains. They do not "
                f"meet the requirements: {violated}."
            ]
        elif self.kept:
            remarks = [
                "The current gains are kept, because the search found no better gains that meet "
                "the requirements."
            ]
        elif violated:
            remarks = [f"The current gains do not meet the requirements: {violated}."]
            if factor < 1.0:
                remarks.append(f"Apart from that they are {1.0 / factor:.3g} times as accurate.")
        else:
            falls = "falls" if factor >= 1.0 else "grows"
            remarks = [
                f"The rms error {falls} by a factor of {max(factor, 1.0 / factor):.3g} (geometric "
                "mean over the groups)."
            ]
        was, now = (self.requirement.crowding(each).max() for each in (before, after))
        if max(was, now) > 1.0:
            remarks.append(
                f"{ROOM:g} standard deviations of the force from noise are {now:.3g} times the "
                f"reserve of the actuators (current gains: {was:.3g} times; limit: 1)."
            )
        if self.ended_by:
            remarks.append(
                f"The search was ended by {self.ended_by}; this is the best result so far."
            )
        for kind, point in self.found.items():
            error = np.exp(point.prediction.mean_log_error)
            verdict = self.requirement.violated(point) or f"ISV {number(point.prediction.isv)}"
            remarks.append(f"{_KINDS[kind]}: mean rms error {error:.3g}, {verdict}.")
        remarks.append(f"Active constraint: {self.active_constraint}.")
        if np.isfinite(self.limit.distance):
            remarks.append(
                f"The error is {self.limit.distance:.3g} times the least of any linear controller "
                "at this effort (LQG, same noise and demand)."
            )
        return remarks
