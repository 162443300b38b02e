"""The force of a held payload whose mass properties are not the nominal ones.

It is linear in the errors of mass, first moment and inertia about the nominal centre of mass
(Khalil and Dombre, Modeling, Identification and Control of Robots, section 9.4).
"""

import numpy as np

from ffsm_drake.common.so3 import skew
from ffsm_drake.scenario import MassProperties

_OFF = 0.2  # uncertain share of the payload's radius of gyration (centre) and moments
_WIDER = 0.25  # widening of the interval between light and heavy payloads, as a share of it
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_UNIT_INERTIAS = np.zeros((3, 3, len(_PAIRS)))  # rows, columns, pairs
for _at, (_i, _j) in enumerate(_PAIRS):
    _UNIT_INERTIAS[_i, _j, _at] = _UNIT_INERTIAS[_j, _i, _at] = 1.0
_CROSS = skew(np.eye(3)).reshape(3, 9)
NUM_ERRORS = 4 + len(_PAIRS)


def intervals(held: MassProperties, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest errors (10): of mass, kg, first moment, kg m, and inertia, kg m^2.

    Args: nominal payload; largest factor between true and nominal mass or inertia.
    """
    more = _WIDER * (factor - 1.0 / factor)
    up, down = factor - 1.0 + more, 1.0 - 1.0 / factor + more
    inertia = np.abs(np.array(held.inertia[:3], dtype=float))
    half = 0.5 * inertia.sum()
    offset = np.full(3, _OFF * np.sqrt(held.mass * half) * (1.0 + up))
    product = np.full(3, _OFF * half * (1.0 + up))
    high = np.concatenate([[up * held.mass], offset, up * inertia, product])
    low = np.concatenate([[-down * held.mass], -offset, -down * inertia, -product])
    return low, high


def force_by_errors(jacobian: np.ndarray, twist: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Generalized forces (n, nv, 10) that errors of one unit each need.

    Args: Jacobian of the payload's centre of mass, in the axes of its body (n, 6, nv); its twist in
    these axes (n, 6), and the rate of change of the numbers of the twist (n, 6).
    """
    turn, spin = twist[:, :3], change[:, :3]
    line = change[:, 3:] + np.cross(turn, twist[:, 3:])
    crossing = _crossing(turn)
    wrench = np.zeros((len(twist), 6, NUM_ERRORS))  # torque and force
    wrench[:, 3:, 0] = line
    wrench[:, 3:, 1:4] = _crossing(spin) + crossing @ crossing
    wrench[:, :3, 1:4] = -_crossing(line)
    momenta = np.tensordot(np.stack([spin, turn]), _UNIT_INERTIAS, axes=1)
    wrench[:, :3, 4:] = momenta[0] + crossing @ momenta[1]
    forces: np.ndarray = jacobian.swapaxes(1, 2) @ wrench
    return forces


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of a x (.)."""
    found: np.ndarray = (vectors @ _CROSS).reshape(*vectors.shape, 3)
    return found
