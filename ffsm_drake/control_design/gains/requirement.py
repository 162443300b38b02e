"""The requirements of a design, and the ranking of designs."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.control_design.stability.prediction import Prediction
from ffsm_drake.control_design.stability.rehearsal import Rehearsal
from ffsm_drake.scenario import Scenario


@dataclasses.dataclass(frozen=True, kw_only=True)
class DesignPoint:
    """A scenario and its prediction."""

    scenario: Scenario
    prediction: Prediction
    radius_by_mass: Mapping[float, float]  # true payload mass in kg -> spectral radius
    is_by_axis: bool = True  # whether its loop consists of axes (``adaptation.axis_law``)
    # with limited base actuators, if all other requirements are met
    rehearsal: Rehearsal | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Requirement:
    """Limits on a design."""

    budget: float  # largest ISV
    limit: np.ndarray  # (nv,) of the actuators, N m or N; infinite: none

    def violated(self, point: DesignPoint) -> str:
        """The requirement that a point does not meet, one line; empty where it meets all."""
        prediction = point.prediction
        if not np.isfinite(prediction.isv):
            return "it diverges"
        unstable = [mass for mass, radius in point.radius_by_mass.items() if radius >= 1.0]
        if unstable:
            return (
                f"unstable for a true payload of {' or '.join(f'{mass:g}' for mass in unstable)} kg"
            )
        if (excess := prediction.peak_effort > self.limit).any():
            i = int(np.argmax(excess))
            peak, limit = prediction.peak_effort[i], self.limit[i]
            name = prediction.coordinates.names[i]
            return f"{name} needs {peak:.3g}, more than its actuation.limit of {limit:g}"
        if prediction.isv > self.budget:
            return f"ISV {prediction.isv:.1f} is over the budget of {self.budget:.1f}"
        if point.rehearsal is not None and point.rehearsal.share_diverged > 0.0:
            return f"with its actuators it diverges: {point.rehearsal}"
        return ""

    def rank(self, point: DesignPoint) -> tuple[int, float]:
        """Smaller is better: requirements first, then error, or effort over budget."""
        prediction, violated = point.prediction, self.violated(point)
        if not violated:
            return 0, prediction.mean_log_error
        severe = not violated.startswith("ISV")
        return (2, float(max(point.radius_by_mass.values()))) if severe else (1, prediction.isv)
