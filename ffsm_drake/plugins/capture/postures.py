"""Postures of configurations, at which motions of a capture begin."""

import numpy as np

from ffsm_drake.scenario import Posture
from ffsm_drake.spacecraft.coordinates import (
    NUM_BASE_POSITIONS,
    NUM_BASE_VELOCITIES,
    Coordinates,
)
from ffsm_drake.spacecraft.plant import base_rpy


def posture_of(q: np.ndarray, coordinates: Coordinates) -> Posture:
    """Return the posture of a configuration q (nq)."""
    joints = zip(coordinates.names[NUM_BASE_VELOCITIES:], q[NUM_BASE_POSITIONS:], strict=True)
    return Posture(
        base_position=q[4:NUM_BASE_POSITIONS].tolist(),
        base_rpy=base_rpy(q).tolist(),
        joints={name: float(angle) for name, angle in joints},
    )
