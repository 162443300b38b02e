"""The requirements of a design, and the ranking of designs."""

import dataclasses
from collections.abc import Collection, Mapping

import numpy as np

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.design.stability.boundaries import (
    LARGEST_DELAY,
    LARGEST_FACTOR,
    Boundaries,
    probed_radius,
    variations,
)
from ffsm_drake.plugins.design.stability.prediction import Prediction
from ffsm_drake.plugins.design.stability.rehearsal import Rehearsal
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.controllers import complete_gains

# Criteria that a design may trade off.
TRADES = ("accuracy", "effort", "margins")
# Factor by which a figure may be worse than the given one.
TOLERANCE = 1.02
# Standard deviations of the noise's force that limited actuators shall give beside the motion's.
ROOM = 3.0
_MARGINS = {
    "nominal_payload": "factor on the nominal payload",
    "sample_time": "factor on the control period",
    "delay": "delay of the sensors",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class DesignPoint:
    """A scenario and its prediction."""

    scenario: Scenario
    prediction: Prediction  # with the actuators' part of the error, where these are rehearsed
    radius_by_mass: Mapping[float, float]  # true payload mass in kg -> spectral radius
    is_by_axis: bool = True  # whether its loop consists of axes (``adaptation.axis_law``)
    # with limited base actuators, if all other requirements are met
    rehearsal: Rehearsal | None = None
    # whether its run without noise was made; else the prediction is that of perfect tracking
    is_run: bool = True
    lost_margin: str = ""  # the margin that is worse than it was, one line
    alarm: str = ""  # predicted obstacle to its mission, one line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Baseline:
    """The given gains, and what may be worse than with them."""

    point: DesignPoint
    boundaries: Boundaries  # boundaries of its scenario
    time: float  # s, the posture of the boundaries
    trade: Collection[str] = ()  # a subset of TRADES

    def worse_error(self, point: DesignPoint) -> str:
        """The first group with a larger error than it had, one line; empty if there is none."""
        if "accuracy" in self.trade:
            return ""
        for name, (after, before) in self.errors(point).items():
            if after > TOLERANCE * before:
                return f"less accurate in {name}: rms error {after:.3g}, current gains {before:.3g}"
        return ""

    def errors(self, point: DesignPoint) -> dict[str, tuple[float, float]]:
        """The rms errors after and before by group, rad or m."""
        before = self.point.prediction.by_group()
        return {name: (after, before[name]) for name, after in point.prediction.by_group().items()}

    def worse_margin(self, boundaries: Boundaries) -> str:
        """The first margin that is smaller than it was, one line; empty if there is none."""
        found = {} if "margins" in self.trade else self.margins(boundaries)
        for name, (before, after) in found.items():
            if not after * TOLERANCE >= before:
                return f"smaller margin: {name} up to {after:.3g}, current gains {before:.3g}"
        return ""

    def margins(self, boundaries: Boundaries | None) -> dict[str, tuple[float, float]]:
        """The given margins and those of other boundaries (None: the same): name -> (given,
        other).
        """
        after = (boundaries or self.boundaries).values
        before = self.boundaries.values
        return {_label(name): (value, after[name]) for name, value in before.items()}

    def margin_lost_by(self, scenario: Scenario) -> str:
        """The first margin violated by another scenario, one line; empty if all are kept.

        Costs a fraction of ``find_boundaries``: one evaluation at each of the given margins.
        """
        if "margins" in self.trade:
            return ""
        known = self.boundaries.values
        for name, vary in variations(complete_gains(scenario)).items():
            size = min(known[name], LARGEST_FACTOR / 1.4) / TOLERANCE
            if name == "delay":
                size = min(known[name], LARGEST_DELAY)
            if not self._is_stable(vary(size)):
                return f"smaller margin than with the current gains: {_label(name)}"
        return ""

    def _is_stable(self, scenario: Scenario) -> bool:
        try:
            return probed_radius(scenario, [self.time], adapted=False) < 1.0
        except ModelError:  # a part outweighs its carrier: as in ``find_boundaries``
            return True


def _label(parameter: str) -> str:
    return _MARGINS.get(parameter, f"factor on the {parameter}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """Limits on a design."""

    budget: float  # largest ISV
    limit: np.ndarray  # (nv,) of the actuators, N m or N; infinite: none
    # (nv) largest standard deviation of the noise's force for which limited base actuators have
    # room beside the motion, N m or N; infinite: they are not limited
    room: np.ndarray
    # None: the given gains are unusable; any usable result is better
    baseline: Baseline | None = None

    def violated(self, point: DesignPoint) -> str:
        """The requirement that a point does not meet, one line; empty if it meets all."""
        return self.failed(point) or self._over_budget(point) or self.worse(point)

    def failed(self, point: DesignPoint) -> str:
        """The requirement apart from effort and comparison that is not met, one line."""
        prediction = point.prediction
        unstable = [mass for mass, radius in point.radius_by_mass.items() if not radius < 1.0]
        if unstable:
            return (
                f"unstable for a true payload of {' or '.join(f'{mass:g}' for mass in unstable)} kg"
            )
        if not np.isfinite(prediction.isv):
            return "it diverges"
        if (excess := prediction.peak_effort > self.limit).any():
            i = int(np.argmax(excess))
            peak, limit = prediction.peak_effort[i], self.limit[i]
            name = prediction.coordinates.names[i]
            return f"{name} needs {peak:.3g}, more than its actuation.limit of {limit:g}"
        if point.rehearsal is not None and point.rehearsal.share_diverged > 0.0:
            return f"with its actuators it {point.rehearsal}"
        return point.alarm

    def _over_budget(self, point: DesignPoint) -> str:
        if point.prediction.isv > self.budget:
            return f"ISV {number(point.prediction.isv)} exceeds the budget of {number(self.budget)}"
        return ""

    def worse(self, point: DesignPoint) -> str:
        """The criterion that is worse than with the given gains, one line; empty: none."""
        if self.baseline is None or point is self.baseline.point:
            return ""
        return self.baseline.worse_error(point) or point.lost_margin

    def crowding(self, prediction: Prediction) -> np.ndarray:
        """(nv) the noise's force relative to the actuators' reserve for it, 1 at the limit.

        Beyond it they saturate so often that a disturbance or a grasp may overload an integral;
        linear errors do not show this.
        """
        return np.maximum(1.0, prediction.noise_force / self.room)

    def score(self, point: DesignPoint) -> float:
        """Accuracy, worse by what the actuators have no room for; smaller is better."""
        return point.prediction.mean_log_error + float(
            np.log(self.crowding(point.prediction).max())
        )

    def rank(self, point: DesignPoint) -> tuple[int, float]:
        """Smaller is better: requirements first, then the score, or effort over budget."""
        if self.failed(point):
            return 3, float(max(point.radius_by_mass.values()))
        if self.worse(point):
            return 2, self.score(point)
        if self._over_budget(point):
            return 1, point.prediction.isv
        return 0, self.score(point)
