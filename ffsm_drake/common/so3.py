"""Rotations: quaternions (w, x, y, z), rotation vectors, attitude motions with exact derivatives.

All vectors are in the world frame.

Sola et al. 2018, "A micro Lie theory for state estimation in robotics".
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # axes
_VANISHES = 1e-15  # part of a unit quaternion that is only rounding


def quaternion_of(vector: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of rotation vectors (..., 3), rad."""
    half = 0.5 * np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def composed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of R(first) R(second); of one with many, too."""
    a, u, b, v = first[..., :1], first[..., 1:], second[..., :1], second[..., 1:]
    scalar = a * b - (u * v).sum(axis=-1, keepdims=True)
    return np.concatenate([scalar, a * v + b * u + np.cross(u, v)], axis=-1)


def turned_by(vector: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Quaternions (..., 4) of attitudes, quaternions (..., 4), turned by rotation vectors (..., 3);
    of one attitude (4) turned by many, too.
    """
    return composed(quaternion_of(vector), first)


def turning_matrix(vector: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) that turns quaternions by a rotation vector (3), rad."""
    return product_matrix(quaternion_of(vector))


def product_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) of the products q (.) with a quaternion q (4)."""
    w, x, y, z = quaternion.tolist()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def matrix_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of any norm; of one with plain floats,
    because control updates need it, with the bits that it has among others.
    """
    if quaternion.ndim == 1 and quaternion.dtype != object and quaternion.any():
        return np.array(_rotation_matrix(*quaternion.tolist()))
    rows = _rotation_matrix(*np.moveaxis(quaternion, -1, 0))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _rotation_matrix(w: Any, x: Any, y: Any, z: Any) -> tuple[tuple[Any, Any, Any], ...]:
    """Return the rows of a rotation matrix, from numbers or arrays."""
    twice = 2.0 / (w * w + x * x + y * y + z * z)
    xx, yy, zz = twice * x * x, twice * y * y, twice * z * z
    xy, xz, yz = twice * x * y, twice * x * z, twice * y * z
    wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
    return (
        (1.0 - (yy + zz), xy - wz, xz + wy),
        (xy + wz, 1.0 - (xx + zz), yz - wx),
        (xz - wy, yz + wx, 1.0 - (xx + yy)),
    )


def skew(vector: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) of a x (.)."""
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def times_conjugate(first: Iterable[Any], second: Iterable[Any]) -> tuple[Any, Any, Any, Any]:
    """Return the product first * conjugate(second) of quaternions, of numbers or arrays."""
    dw, dx, dy, dz = first
    w, x, y, z = second
    return (
        dw * w + dx * x + dy * y + dz * z,
        dx * w - dw * x - dy * z + dz * y,
        dy * w - dw * y - dz * x + dx * z,
        dz * w - dw * z - dx * y + dy * x,
    )


def rotation_error(quaternion_d: np.ndarray, quaternion: np.ndarray) -> tuple[float, float, float]:
    """Rotation vector, in the world frame, from R(quaternion) to R(quaternion_d): log(R_d R^T),
    rad.

    Quaternions are (w, x, y, z); their norms do not matter. Plain floats, because this runs in
    every controller update.
    """
    ew, ex, ey, ez = times_conjugate(quaternion_d.tolist(), quaternion.tolist())
    if ew < 0.0:  # the shorter rotation
        ew, ex, ey, ez = -ew, -ex, -ey, -ez
    sine = math.sqrt(ex * ex + ey * ey + ez * ez)
    factor = 2.0 * math.atan2(sine, ew) / sine if sine > 0.0 else 0.0
    return factor * ex, factor * ey, factor * ez


def rotation_error_rate(
    error: tuple[float, float, float], w_d: np.ndarray, w: np.ndarray
) -> tuple[float, float, float]:
    """Return the rate of ``rotation_error``, rad/s, for an error e and angular velocities w_d and w
    (3,), all in the world frame.

    e' = J_l(e)^-1 w_d - J_r(e)^-1 w = (w_d - w) - 1/2 e x (w_d + w) + c e x (e x (w_d - w)), with
    the left and right Jacobians of SO(3) and c = (1 - a/2 cot a/2) / a^2, a = |e| (Sola et al.
    2018, "A micro Lie theory for state estimation in robotics", equations (146) and (147)). Plain
    floats, as in ``rotation_error``.
    """
    ex, ey, ez = error
    dx, dy, dz = w_d.tolist()
    x, y, z = w.tolist()
    sx, sy, sz = 0.5 * (dx + x), 0.5 * (dy + y), 0.5 * (dz + z)
    dx, dy, dz = dx - x, dy - y, dz - z
    square = ex * ex + ey * ey + ez * ez
    if square < 1e-2:  # the next term of the series is below 1e-12
        c = 1.0 / 12.0 + square * (1.0 / 720.0 + square / 30240.0)
    else:
        half = 0.5 * math.sqrt(square)
        c = (1.0 - half / math.tan(half)) / square
    # e x (c e x (w_d - w) - 1/2 (w_d + w))
    cx = c * (ey * dz - ez * dy) - sx
    cy = c * (ez * dx - ex * dz) - sy
    cz = c * (ex * dy - ey * dx) - sz
    return dx + ey * cz - ez * cy, dy + ez * cx - ex * cz, dz + ex * cy - ey * cx


def quaternion_rate(quaternion: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Return the rate (4, ...) of a quaternion (4, ...; w, x, y, z) of R_WB, for w_WB_W (3, ...),
    rad/s.
    """
    (w, x, y, z), (a, b, c) = quaternion, 0.5 * omega
    return np.array(
        [
            -a * x - b * y - c * z,
            a * w + b * z - c * y,
            b * w + c * x - a * z,
            c * w + a * y - b * x,
        ]
    )


def attitude_motion(
    phi: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotation matrices exp(phi) (3, 3, n), angular velocities and accelerations (3, n), world
    frame.

    w = phi' + b phi x phi' + c phi x (phi x phi') with b = (1 - cos a)/a^2, c = (a - sin a)/a^3, a
    = |phi|: the left Jacobian of SO(3) (Sola et al. 2018, equation (145)); the acceleration is its
    exact derivative. Complex arrays pass.

    Args:
      phi, rate, acceleration: rotation vectors (3, n), rad, and their time derivatives.
    """
    square = (phi * phi).sum(axis=0)
    small = np.abs(square) < 1e-4
    safe = np.where(small, 1.0, square)
    angle = np.sqrt(safe)
    a = np.where(small, 1 - square / 6 + square**2 / 120, np.sin(angle) / angle)
    b = np.where(small, 0.5 - square / 24 + square**2 / 720, (1 - np.cos(angle)) / safe)
    c = np.where(
        small, 1 / 6 - square / 120 + square**2 / 5040, (angle - np.sin(angle)) / (safe * angle)
    )
    # by the square
    db = np.where(small, -1 / 24 + square / 360 - square**2 / 13440, (a - 2 * b) / (2 * safe))
    dc = np.where(small, -1 / 120 + square / 2520 - square**2 / 120960, (b - 3 * c) / (2 * safe))
    growth = 2 * (phi * rate).sum(axis=0)  # growth of the square
    once = cross(phi, rate)
    twice = cross(phi, once)
    w = rate + b * once + c * twice
    turned = cross(phi, acceleration)
    alpha = (
        acceleration
        + b * turned
        + c * (cross(phi, turned) + cross(rate, once))
        + growth * (db * once + dc * twice)
    )
    identity = np.eye(3)[:, :, None]
    turning = np.moveaxis(skew(phi.T), 0, -1)
    rotation = identity + a * turning + b * (phi[:, None] * phi[None] - square * identity)
    return rotation, w, alpha


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b for arrays (3, ...)."""
    return a[_NEXT] * b[_LAST] - a[_LAST] * b[_NEXT]


def cross_of(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b (..., 3); several times as fast as NumPy's."""
    return a[..., _NEXT] * b[..., _LAST] - a[..., _LAST] * b[..., _NEXT]


def eigenaxis_motion(
    first: np.ndarray, rotation: np.ndarray, blend: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4; w, x, y, z) of R_WB, angular velocities w_WB_W (n, 3) and accelerations
    alpha_WB_W (n, 3).

    Args:
      first: quaternion (4,) of the first attitude.
      rotation: rotation vector (3,) from the first attitude to the last, in the world frame, rad.
      blend: s, its first and its second derivative, (n, 1) each.
    """
    s, ds, dds = blend
    return turned_by(s * rotation, first), ds * rotation, dds * rotation


def rotation_vector_motion(
    first: np.ndarray, vector: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4) of R_WB, angular velocities w_WB_W (n, 3) and accelerations alpha_WB_W (n,
    3).

    Args:
      first: quaternion (4,) of the first attitude.
      vector: rotation vector from the first attitude (n, 3), rad.
      rate, acceleration: its time derivatives (n, 3).
    """
    _, omega, alpha = attitude_motion(vector.T, rate.T, acceleration.T)
    return turned_by(vector, first), omega.T, alpha.T


def rpy_motion(
    rpy: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4; w, x, y, z) of R_WB, angular velocities w_WB_W (n, 3) and accelerations
    alpha_WB_W (n, 3).

    Args:
      rpy: roll, pitch, yaw (n, 3), rad, R_WB = R_z(yaw) R_y(pitch) R_x(roll).
      rate, acceleration: their time derivatives (n, 3).
    """
    r, p, y = rpy.T
    dr, dp, dy = rate.T
    ddr, ddp, ddy = acceleration.T
    sp, cp, sy, cy = np.sin(p), np.cos(p), np.sin(y), np.cos(y)
    omega = (cp * cy * dr - sy * dp, cp * sy * dr + cy * dp, dy - sp * dr)
    alpha = (
        cp * cy * ddr - sy * ddp - (sp * cy * dp + cp * sy * dy) * dr - cy * dy * dp,
        cp * sy * ddr + cy * ddp - (sp * sy * dp - cp * cy * dy) * dr - sy * dy * dp,
        ddy - sp * ddr - cp * dp * dr,
    )
    sr2, cr2 = np.sin(0.5 * r), np.cos(0.5 * r)
    sp2, cp2 = np.sin(0.5 * p), np.cos(0.5 * p)
    sy2, cy2 = np.sin(0.5 * y), np.cos(0.5 * y)
    quaternion = (
        cr2 * cp2 * cy2 + sr2 * sp2 * sy2,
        sr2 * cp2 * cy2 - cr2 * sp2 * sy2,
        cr2 * sp2 * cy2 + sr2 * cp2 * sy2,
        cr2 * cp2 * sy2 - sr2 * sp2 * cy2,
    )
    return np.stack(quaternion, axis=1), np.stack(omega, axis=1), np.stack(alpha, axis=1)


def rpy_of(quaternions: np.ndarray) -> np.ndarray:
    """Return roll, pitch, yaw (..., 3), rad, of quaternions (..., 4) of any norm, as in
    ``rpy_motion``.

    Half the sum and half the difference of yaw and roll are the angles of two vectors, of which one
    vanishes at a pitch of +-90 degrees: then only the other counts, and this one's is zero.
    """
    unit = quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    of_sum, of_difference = (x + z, w - y), (z - x, w + y)
    lengths = [np.hypot(*each) for each in (of_sum, of_difference)]
    half_sum, half_difference = (
        np.where(length < _VANISHES, 0.0, np.arctan2(*each))
        for length, each in zip(lengths, (of_sum, of_difference), strict=True)
    )
    pitch = 2.0 * np.arctan2(lengths[1], lengths[0]) - 0.5 * np.pi
    roll, yaw = half_sum - half_difference, half_sum + half_difference
    turns = 2.0 * np.pi
    return np.stack(
        [roll - turns * np.round(roll / turns), pitch, yaw - turns * np.round(yaw / turns)], axis=-1
    )


def in_body_axes(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors in world axes (n, 3) in those of bodies with attitudes (w, x, y, z) (n, 4)."""
    w, u = quaternions[:, :1], -quaternions[:, 1:]
    twice = 2.0 * np.cross(u, vectors)
    turned: np.ndarray = w * twice + np.cross(u, twice)
    return vectors + turned / (quaternions**2).sum(axis=1)[:, None]


def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) d, in the first's axes, with R(second) = R(first) exp([d]x)."""
    return vector_of(composed(first * [1.0, -1.0, -1.0, -1.0], second))


def vector_of(quaternion: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) of quaternions (..., 4), of the shorter rotation, rad."""
    turn = np.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    sine = np.linalg.norm(turn[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[..., :1])
    return turn[..., 1:] * (angle / np.maximum(sine, 1e-300))
