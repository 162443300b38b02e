"""The force of a held payload whose mass properties are not the nominal ones.

It is linear in the errors of mass, first moment and inertia about the nominal centre of mass
(Khalil and Dombre, Modeling, Identification and Control of Robots, section 9.4).
"""

import numpy as np

from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.scenario import MassProperties
from ffsm_drake.spacecraft.nominal import PlantModel

_OFF = 0.2  # uncertain share of the payload's radius of gyration (centre) and moments
_WIDER = 0.25  # widening of the interval between light and heavy payloads, as a share of it
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_TENSORS = np.zeros((len(_PAIRS), 3, 3))
for _at, (_i, _j) in enumerate(_PAIRS):
    _TENSORS[_at, _i, _j] = _TENSORS[_at, _j, _i] = 1.0
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


def place(model: PlantModel, body: str, centre: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Jacobian (6 nv) and bias acceleration (6) of the centre of mass, and the rotation matrix (9)
    of the payload, in a state (nq + nv) of the nominal model.

    Args: also its body's name and its centre of mass (3) in that body's frame, m.
    """
    q, v = np.split(state, [len(state) // 2 + 1])
    jacobian = np.array(model.calc_jacobian(q, body))
    bias = np.array(model.calc_bias_acceleration(q, v, body))
    rotation = matrix_of(model.calc_frame_pose(q, body)[:4])
    arm, turn = rotation @ centre, jacobian[:3] @ v
    jacobian[3:] += np.cross(jacobian[:3].T, arm).T
    bias[3:] += np.cross(bias[:3], arm) + np.cross(turn, np.cross(turn, arm))
    return np.concatenate([jacobian.ravel(), bias, rotation.ravel()])


def force_by_errors(
    places: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    """Generalized forces (n, nv, 10) that errors of one unit each need.

    Args: n places as ``place`` returns them; velocities and accelerations (n, nv).
    """
    nv = velocity.shape[1]
    jacobian = places[:, : 6 * nv].reshape(-1, 6, nv)
    rotation = places[:, -9:].reshape(-1, 3, 3)
    turn = np.einsum("nij,nj->ni", jacobian[:, :3], velocity)
    moved = np.einsum("nij,nj->ni", jacobian, acceleration) + places[:, 6 * nv : -9]
    spin, line = moved[:, :3], moved[:, 3:]
    wrench = np.zeros((len(places), 6, NUM_ERRORS))
    wrench[:, 3:, 0] = line
    axes = rotation.swapaxes(1, 2)  # (n, 3 axes, 3)
    spins, turns = spin[:, None], turn[:, None]
    wrench[:, 3:, 1:4] = (np.cross(spins, axes) + np.cross(turns, np.cross(turns, axes))).swapaxes(
        1, 2
    )
    wrench[:, :3, 1:4] = np.cross(axes, line[:, None]).swapaxes(1, 2)
    tensors = rotation[:, None] @ _TENSORS @ axes[:, None]  # (n, 6, 3, 3)
    momentum = tensors @ turn[:, None, :, None]
    torque = (tensors @ spin[:, None, :, None])[..., 0] + np.cross(turns, momentum[..., 0])
    wrench[:, :3, 4:] = torque.swapaxes(1, 2)
    forces: np.ndarray = np.einsum("nij,nik->njk", jacobian, wrench)
    return forces
