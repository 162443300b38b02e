"""Compliant contact of a round tip with a square, in a plane, with Coulomb friction."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, kw_only=True)
class Surface:
    """Contact of tip and target; the defaults are those of the air-bearing experiments of the Space
    Robotics Laboratory at Tohoku University.
    """

    stiffness: float = 800.0  # N/m
    damping: float = 2.0  # N s/m
    friction: float = 0.3
    slip: float = 5e-3  # m/s; up to this speed of sliding the friction is viscous

    def force(self, *, depth: float, normal: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Force (2; N) on the target. ``normal`` (2) points out of it, ``velocity`` (2; m/s) is the
        tip's at the contact relative to the target's; the two only push on each other.
        """
        closing = -float(normal @ velocity)
        push = max(0.0, self.stiffness * depth + self.damping * closing)
        along = velocity + closing * normal
        size = float(np.linalg.norm(along))
        found: np.ndarray = -push * normal
        if size > 0.0:
            found = found + self.friction * push * np.tanh(size / self.slip) / size * along
        return found


def depth_in_square(p: np.ndarray, *, width: float, radius: float) -> tuple[float, np.ndarray]:
    """Depth (m) of a disc with its centre at ``p`` (2; m, in the axes of the square about its
    centre), negative outside, and the normal (2) of the nearest side or corner.
    """
    half = 0.5 * width
    nearest = np.clip(p, -half, half)
    away = p - nearest
    distance = float(np.linalg.norm(away))
    if distance > 0.0:
        return radius - distance, away / distance
    axis = int(np.argmax(np.abs(p)))  # the centre is inside
    normal = np.zeros(2)
    normal[axis] = 1.0 if p[axis] >= 0.0 else -1.0
    return radius + half - abs(float(p[axis])), normal
