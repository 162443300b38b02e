"""Faults of wheels: a momentum that does not follow the commanded torque."""

from collections.abc import Iterator, Sequence

import numpy as np

from ffsm_drake.plugins.actuators.wheel_set import WheelSet

_SPEED, _SHARE = 0.2, 0.3  # rad/s and share of the commanded impulse: tolerance of a wheel


def stopped(blocks: np.ndarray, windows: Sequence[int], wheels: WheelSet) -> Iterator[str]:
    """Names of wheels that have stopped.

    Args:
      blocks: commanded impulses, then momenta that wheels did not take (m, 2 n), N m s: sums since
        the start, at the ends of blocks.
      windows: numbers of blocks over which the sums are compared.
      wheels: the wheels (n).
    """
    ago = -1 - np.array(windows, dtype=int)
    told, beyond = np.split(np.abs(blocks[-1] - blocks[ago]), 2, axis=1)
    are_off = (beyond > _SHARE * told + _SPEED * wheels.inertia).any(axis=0)
    return (wheels.names[index] for index in np.flatnonzero(are_off))
