"""Faults of wheels: a momentum that does not follow the commanded torque."""

from collections.abc import Iterable, Iterator

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WheelSet

_SPEED, _SHARE = 0.2, 0.3  # rad/s and share of the commanded impulse: tolerance of a wheel


def stopped(blocks: np.ndarray, windows: Iterable[int], wheels: WheelSet) -> Iterator[str]:
    """Names of wheels that have stopped.

    Args:
      blocks: commanded impulses, then momenta that wheels did not take (m, 2 n), N m s: sums since
        the start, at the ends of blocks.
      windows: numbers of blocks over which the sums are compared.
      wheels: the wheels (n).
    """
    for window in windows:
        told, beyond = np.abs(blocks[-1] - blocks[-1 - window]).reshape(2, -1)
        for index in np.flatnonzero(beyond > _SHARE * told + _SPEED * wheels.inertia):
            yield wheels.names[index]
