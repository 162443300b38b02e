"""Accuracy and effort of a scenario, predicted from its wired closed loop.

The mean is the run without noise. Around it the loop is linear, so the sensors' noise adds a
stationary part (``LinearLoop.noise_response``). Errors and efforts add as squares. Every
controller, estimator, delay and block is covered; actuator limits are not: compare
``peak_effort``.
"""

import dataclasses
from collections.abc import Mapping
from typing import Self

import numpy as np

from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linear_loop import at_rest
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.stability.outputs import Group
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.registry import Factory

# Fractions of the planned motion over which noise responses are averaged.
_POSTURES = (0.0, 0.5, 1.0)
# Largest of about 2000 Gaussian samples, in standard deviations.
_PEAK = 3.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted figures of a run; infinite where it would diverge."""

    coordinates: Coordinates
    groups: Mapping[str, Group]  # of the outputs of the law
    spectral_radius: float  # the largest along the plan
    rms_error: np.ndarray  # of the outputs, after the settling time, rad or m
    noise_error: np.ndarray  # the noise's part of it, rad or m
    noise_force: np.ndarray  # (nv,) standard deviation, N m or N
    isv_by_coordinate: np.ndarray  # (nv,)
    peak_effort: np.ndarray  # (nv,) N m or N

    def with_mean(
        self, error: np.ndarray, force: np.ndarray, *, period: float, settled_after: float = 5.0
    ) -> Self:
        """With the errors of the outputs (n, size) and the force (n, nv) of the run without noise,
        sampled every period (s).
        """
        if not np.isfinite(force).all():  # it diverges without noise, too
            error, force = np.full_like(error, np.inf), np.full_like(force, np.inf)
        settled = np.arange(len(error)) * period > settled_after
        settled[-1] = True  # last error of a shorter run
        of_noise = len(force) * self.noise_force**2
        return dataclasses.replace(
            self,
            rms_error=np.sqrt((error[settled] ** 2).mean(axis=0) + self.noise_error**2),
            isv_by_coordinate=((force**2).sum(axis=0) + of_noise) * period,
            peak_effort=np.abs(force).max(axis=0) + _PEAK * self.noise_force,
        )

    @property
    def isv(self) -> float:
        """Effort of all coordinates."""
        return float(self.isv_by_coordinate.sum())

    def by_group(self) -> dict[str, float]:
        """Root mean square error over each group of outputs."""
        return {
            name: float(np.sqrt(np.mean(self.rms_error[group.errors] ** 2)))
            for name, group in self.groups.items()
        }

    def isv_of(self, group: Group) -> float:
        """Effort of a group of outputs; the groups of a frame share the effort of the joints."""
        return group.share * float(self.isv_by_coordinate[group.forces].sum())

    @property
    def mean_log_error(self) -> float:
        """Mean over the groups of log(rms error in rad or m), a single figure of accuracy; infinite
        where it would diverge.
        """
        return float(np.mean(np.log(list(self.by_group().values()))))


def predict(
    scenario: Scenario, *, settled_after: float = 5.0, blocks: Mapping[str, Factory] | None = None
) -> Prediction:
    """Predict a run; takes about as long as one, longer with slow sensors.

    Args:
      scenario: the scenario; K_s is held at its largest expected value, sign terms are left out.
      settled_after: s; the rms error counts from here on.
      blocks: see ``simulate``.

    Raises: the errors of ``Linearizer`` and ``Linearizer.at``.
    """
    with Linearizer(scenario, blocks=blocks) as linearizer:
        held = expected_gains(linearizer)
        noise = predict_noise(linearizer, held)
        return noise.with_mean(
            *linearizer.follow(held=held),
            period=scenario.sample_time,
            settled_after=settled_after,
        )


def predict_noise(linearizer: Linearizer, held: Mapping[str, np.ndarray]) -> Prediction:
    """The noise's part of a prediction, at a fraction of its cost; ``held``: see
    ``Linearizer.at``.
    """
    scenario, coordinates = linearizer.given, linearizer.coordinates
    loops = at_rest(linearizer.along(_POSTURES, held=held))
    loops = [linearizer.outputs.seen(loop) for loop in loops]
    responses = [loop.noise_response(scenario.num_control_periods) for loop in loops]
    names = ("error", "frame_error") if linearizer.tracks_frame else ("error",)
    of_outputs = [np.concatenate([response[name] for name in names]) for response in responses]
    error, force = (
        np.sqrt(np.mean(np.square(each), axis=0))
        for each in (of_outputs, [response["force"] for response in responses])
    )
    return Prediction(
        coordinates=coordinates,
        groups=linearizer.outputs.groups,
        spectral_radius=max(loop.spectral_radius for loop in loops),
        rms_error=error,
        noise_error=error,
        noise_force=force,
        isv_by_coordinate=scenario.num_control_periods * force**2 * scenario.sample_time,
        peak_effort=_PEAK * force,
    )
