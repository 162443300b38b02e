"""A polynomial in the coordinates, from one posture to another."""

import numpy as np
from pydrake.math import RollPitchYaw

from ffsm_drake.common.so3 import (
    eigenaxis_motion,
    rotation_error,
    rotation_vector_motion,
    rpy_motion,
)
from ffsm_drake.scenario import Posture
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.blend import Blend
from ffsm_drake.systems.planned_motion import PlannedMotion


class PolynomialMotion(PlannedMotion):
    """A polynomial from one posture to another, or to rest at the least cost."""

    def __init__(
        self,
        *,
        coordinates: Coordinates,
        start: Posture,
        target: Posture | None,
        blend: Blend,
        base_rotation: str,
        sample_time: float,
        velocity: np.ndarray | None = None,
    ) -> None:
        """Args: start and target posture (SI units); the reference; the target is held afterwards.

        Without a target it ends where the integral of the squared acceleration (before shaping), in
        any constant metric, is least. ``velocity`` (nv) at the start defaults to zero;
        ``base_rotation`` "rpy" allows no other.
        """
        self._blend = blend
        vectors = [
            np.concatenate(
                [
                    posture.base_rpy,
                    posture.base_position,
                    coordinates.vector(posture.joints, key="joints", default=0.0)[6:],
                ]
            )
            for posture in (start, target or start)
        ]
        # Roll, pitch, yaw, position, joints; for an eigenaxis turn the angles are replaced by a
        # rotation vector from the first attitude, world frame.
        self._start, self._change = vectors[0], vectors[1] - vectors[0]
        self._velocity = velocity if velocity is not None and velocity.any() else None
        self._first: np.ndarray | None = None  # the first attitude, a quaternion
        if base_rotation == "eigenaxis":
            self._first, end = (
                RollPitchYaw(posture.base_rpy).ToQuaternion().wxyz()
                for posture in (start, target or start)
            )
            self._start[:3], self._change[:3] = 0.0, rotation_error(end, self._first)
        if target is None and self._velocity is not None:
            self._change = blend.stopping_time * self._velocity
        super().__init__(coordinates=coordinates, sample_time=sample_time, end=blend.duration)

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        s, ds, dds = (column[:, None] for column in self._blend.blend(times))
        value, rate, acceleration = (
            self._start + s * self._change,
            ds * self._change,
            dds * self._change,
        )
        if self._velocity is not None:
            g, dg, ddg = (column[:, None] for column in self._blend.stop(times))
            value += g * self._velocity
            rate += dg * self._velocity
            acceleration += ddg * self._velocity
        if self._first is None:
            quaternion, omega, alpha = rpy_motion(value[:, :3], rate[:, :3], acceleration[:, :3])
        elif self._velocity is None:
            quaternion, omega, alpha = eigenaxis_motion(self._first, self._change[:3], (s, ds, dds))
        else:
            quaternion, omega, alpha = rotation_vector_motion(
                self._first, value[:, :3], rate[:, :3], acceleration[:, :3]
            )
        return np.hstack([quaternion, value[:, 3:], omega, rate[:, 3:], alpha, acceleration[:, 3:]])
