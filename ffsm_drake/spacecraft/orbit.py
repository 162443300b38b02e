"""The circular orbit whose point the world frame W falls with; W's axes do not turn."""

import dataclasses
import math
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from ffsm_drake.scenario import Environment

EARTH_GRAVITY = 3.986004418e14  # m^3/s^2; gravitational parameter of the Earth (EGM2008)
EARTH_RADIUS = 6378136.3  # m; at the equator (EGM2008)


def mean_motion(settings: Environment) -> float:
    """Angular rate n of the circular orbit, rad/s."""
    if settings.mean_motion is not None:
        return settings.mean_motion
    return math.sqrt(EARTH_GRAVITY / (EARTH_RADIUS + (settings.altitude or 0.0)) ** 3)


def turned_axes(first: np.ndarray, rate: Any, time: Any) -> np.ndarray:
    """Hill's axes in the world frame at a time in s: rows r, t, h (3, 3).

    Args: the axes at the start, the mean motion in rad/s, and the time.
    """
    c, s = np.cos(rate * time), np.sin(rate * time)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ first


@dataclasses.dataclass(frozen=True, kw_only=True)
class Orbit:
    """Hill's axes, and what gravity does to a free body to first order in its distance from W."""

    rate: np.ndarray  # () n, rad/s
    first: np.ndarray  # (3, 3) Hill's axes at the start, rows
    tidal: bool
    gravity_gradient: bool

    @classmethod
    def of(cls, settings: Environment) -> "Orbit":
        """The orbit of an environment."""
        return cls(
            rate=np.array(mean_motion(settings)),
            first=RollPitchYaw(settings.hill_rpy).ToRotationMatrix().matrix().T,
            tidal=settings.tidal,
            gravity_gradient=settings.gravity_gradient,
        )

    def axes(self, time: float) -> np.ndarray:
        """Hill's axes in the world frame at a time in s: rows r, t, h (3, 3)."""
        return turned_axes(self.first, self.rate, time)

    def _up(self, time: float | np.ndarray) -> np.ndarray:
        """Hill's first axis (..., 3), from the Earth's centre outwards, at times (...)."""
        angle = np.stack([self.rate * time], axis=-1)
        return np.cos(angle) * self.first[0] + np.sin(angle) * self.first[1]

    def tide(self, position: np.ndarray, time: float | np.ndarray) -> np.ndarray:
        """Acceleration (..., 3) at positions (..., 3) from W's origin, m/s^2."""
        if not self.tidal:
            return np.zeros_like(position)
        up = self._up(time)
        along = (position * up).sum(axis=-1, keepdims=True) * up
        return self.rate**2 * (3.0 * along - position)

    def gradient(self, R: np.ndarray, inertia: np.ndarray, time: float | np.ndarray) -> np.ndarray:
        """Torque (..., 3) in the axes of bodies with attitudes R (..., 3, 3) by their inertia in
        these axes (..., 3, 3), N m for kg m^2.
        """
        if not self.gravity_gradient:
            return np.zeros(R.shape[:-1])
        up = (self._up(time)[..., None, :] @ R)[..., 0, :]
        return 3.0 * self.rate**2 * np.cross(up, (inertia @ up[..., None])[..., 0])
