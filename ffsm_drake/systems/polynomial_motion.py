"""Polynomials in the coordinates: from one posture to another, or of a frame from pose to pose."""

import dataclasses

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
from ffsm_drake.systems.planned_motion import PathMotion


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class BlendedPath:
    """start + change s(t) + velocity g(t), with the blend's progress s and its stop g.

    The first three of the n entries are a rotation, the next three a position; world axes, rad, m,
    s.
    """

    # quaternion (4; w, x, y, z) of the first attitude, from which the rotation is a rotation
    # vector; None: roll, pitch, yaw
    first: np.ndarray | None
    start: np.ndarray  # (n)
    change: np.ndarray  # (n)
    velocity: np.ndarray  # (n) at the start; zero for roll, pitch, yaw
    blend: Blend

    @property
    def end(self) -> float:
        """Time at which the motion comes to rest, s."""
        return self.blend.duration

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[quaternion (w, x, y, z), others; w, rates of the others; alpha, accelerations] at times
        (m,), s: (m, 3 n + 1); at rest outside the motion.
        """
        s, ds, dds = (column[:, None] for column in self.blend.blend(times))
        moved = [self.start + s * self.change, ds * self.change, dds * self.change]
        if self.velocity.any():
            stop = self.blend.stop(times)
            moved = [each + g[:, None] * self.velocity for each, g in zip(moved, stop, strict=True)]
        rotation = [each[:, :3] for each in moved]
        if self.first is None:
            turn = rpy_motion(*rotation)
        elif self.velocity.any():
            turn = rotation_vector_motion(self.first, *rotation)
        else:
            turn = eigenaxis_motion(self.first, self.change[:3], (s, ds, dds))
        others = [each[:, 3:] for each in moved]
        return np.hstack([part for both in zip(turn, others, strict=True) for part in both])


class PolynomialMotion(PathMotion):
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
        postures = (start, target or start)
        joints = (coordinates.vector(p.joints, key="joints", default=0.0)[6:] for p in postures)
        begin, end = (
            np.concatenate([posture.base_rpy, posture.base_position, own])
            for posture, own in zip(postures, joints, strict=True)
        )
        velocity, change = np.zeros(begin.size) if velocity is None else velocity, end - begin
        first: np.ndarray | None = None
        if base_rotation == "eigenaxis":
            first, last = (RollPitchYaw(p.base_rpy).ToQuaternion().wxyz() for p in postures)
            begin[:3], change[:3] = 0.0, rotation_error(last, first)
        if target is None and velocity.any():
            change = blend.stopping_time * velocity
        path = BlendedPath(first=first, start=begin, change=change, velocity=velocity, blend=blend)
        super().__init__(path, coordinates=coordinates, sample_time=sample_time)
