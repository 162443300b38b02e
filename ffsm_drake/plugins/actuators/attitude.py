"""The base's attitude some time ahead."""

import math
from typing import Any

import numpy as np

from ffsm_drake.common.choice import is_known


def attitude_ahead(quaternion: np.ndarray, angular_velocity: np.ndarray, time: float) -> np.ndarray:
    """R_WB (9, by rows) after a time, s, at a constant angular velocity w_WB (3, rad/s) from
    (w, x, y, z).
    """
    half = 0.5 * time * angular_velocity  # of the rotation vector
    if not is_known(quaternion):
        return np.concatenate(_turned(np.split(quaternion, 4), np.split(half, 3), np))
    return np.array(_turned(quaternion.tolist(), half.tolist()))


def _turned(quaternion: list[Any], half: list[Any], module: Any = math) -> tuple[Any, ...]:
    """A rotation matrix (9, by rows): that of a quaternion of any length, turned by twice a
    rotation vector. On few numbers, with Python's ``math``, it is faster than arrays, and than
    Drake's classes.
    """
    bw, bx, by, bz = quaternion
    norm = module.sqrt(bw * bw + bx * bx + by * by + bz * bz)
    bw, bx, by, bz = bw / norm, bx / norm, by / norm, bz / norm
    x, y, z = half
    angle = module.sqrt(x * x + y * y + z * z)
    if module is np:
        sinc = np.sinc(angle / np.pi)
    else:
        sinc = math.sin(angle) / angle if angle > 0.0 else 1.0
    aw, ax, ay, az = module.cos(angle), sinc * x, sinc * y, sinc * z
    w = (aw * bw - ay * by) - (az * bz + ax * bx)
    x = (aw * bx + ay * bz) - (az * by - ax * bw)
    y = (aw * by + ay * bw) + (az * bx - ax * bz)
    z = (aw * bz - ay * bx) + (az * bw + ax * by)
    xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
    xy, xz, yz = 2.0 * y * x, 2.0 * z * x, 2.0 * z * y
    wx, wy, wz = 2.0 * x * w, 2.0 * y * w, 2.0 * z * w
    return (
        *(1.0 - (yy + zz), xy - wz, xz + wy),
        *(xy + wz, 1.0 - (xx + zz), yz - wx),
        *(xz - wy, yz + wx, 1.0 - (xx + yy)),
    )
