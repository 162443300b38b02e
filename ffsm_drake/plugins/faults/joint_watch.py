"""Faults of joints: at rest under a force beyond all bounds, for any payload mass.

The mean over a window of a force within +-D, by any weights, is within +-D at any frequency.
"""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.plugins.faults.windows import between, times_of
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES

_STILL, _LEAST = 2e-5, 0.05  # rad or m; N m or N beyond all bounds


def stand(moved: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Mask of the joints that stand still.

    Args: positions (m, nv) of blocks, and how far noise alone moves each (nv).
    """
    still: np.ndarray = (np.ptp(moved, axis=0) < _STILL + noise)[NUM_BASE_VELOCITIES:]
    return still


def jammed(
    left: np.ndarray,
    mass: Sequence[np.ndarray],
    *,
    bound: np.ndarray,
    noise: np.ndarray,
    threshold: float,
    step: float,
) -> np.ndarray:
    """Mask of the joints with a force beyond its bound.

    Args:
      left: unexplained velocities of blocks (m, models nv), rad/s and m/s.
      mass: mass matrix (nv, nv) of each model.
      bound: the largest force (nv) that is neither reported nor a fault, N m and N.
      noise: standard deviation (nv) of the noise of a block's velocities.
      threshold: standard deviations of noise that are no fault.
      step: time between blocks, s.
    """
    time = times_of(len(left), step)
    slopes = (time @ left / (time @ time)).reshape(len(mass), -1)
    forces = np.array([each @ slope for each, slope in zip(mass, slopes, strict=True)])
    low, high = between(forces)
    of_noise = threshold * np.sqrt(mass[0] ** 2 @ noise**2 / (time @ time))
    beyond: np.ndarray = np.maximum(low, -high) - bound - of_noise > _LEAST
    return beyond[NUM_BASE_VELOCITIES:]
