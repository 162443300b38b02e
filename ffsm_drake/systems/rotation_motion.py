"""An attitude that moves: quaternions, angular velocities and accelerations of a path and its exact
derivatives.
"""

import math

import numpy as np


def quaternion_rate(quaternion: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Rate (4, ...) of a quaternion (4, ...; w, x, y, z) of R_WB, of an angular velocity w_WB_W (3,
    ...), rad/s.
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
    half = 0.5 * float(np.linalg.norm(rotation)) * s
    w, v = np.cos(half), 0.5 * s * np.sinc(half / np.pi) * rotation  # of the rotation made so far
    scalar = w * first[0] - (v * first[1:]).sum(axis=1, keepdims=True)
    vector = w * first[1:] + first[0] * v + np.cross(v, first[1:])
    return np.hstack([scalar, vector]), ds * rotation, dds * rotation


# Of (1 - cos h)/h^2 and (h - sin h)/h^3 in powers of -h^2, highest first: they converge for every
# h, and with so many terms are exact to rounding for h up to a full turn.
_A, _B = (np.array([1.0 / math.factorial(2 * k + n) for k in range(24, -1, -1)]) for n in (2, 3))


def rotation_vector_motion(
    first: np.ndarray, vector: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4; w, x, y, z) of R_WB, angular velocities w_WB_W (n, 3) and accelerations
    alpha_WB_W (n, 3).

    R_WB = exp(p) R_first has w = p' + a p x p' + b p x (p x p') with a = (1 - cos h)/h^2, b = (h -
    sin h)/h^3, h = |p|: the left Jacobian of SO(3) (Sola et al. 2018, equation (145)).

    Args:
      first: quaternion (4,) of the first attitude.
      vector: rotation vector p from the first attitude (n, 3), world frame, rad; its size up to a
        full turn.
      rate, acceleration: its time derivatives (n, 3).
    """
    square = -(vector * vector).sum(axis=1, keepdims=True)
    square_rate = -2.0 * (vector * rate).sum(axis=1, keepdims=True)
    a, b = np.polyval(_A, square), np.polyval(_B, square)
    a_rate, b_rate = (np.polyval(np.polyder(of), square) * square_rate for of in (_A, _B))
    turn, turn_rate = np.cross(vector, rate), np.cross(vector, acceleration)
    twice = np.cross(vector, turn)
    twice_rate = np.cross(rate, turn) + np.cross(vector, turn_rate)
    omega = rate + a * turn + b * twice
    alpha = acceleration + a_rate * turn + a * turn_rate + b_rate * twice + b * twice_rate
    half = 0.5 * np.sqrt(-square)
    w, v = np.cos(half), 0.5 * np.sinc(half / np.pi) * vector
    scalar = w * first[0] - (v * first[1:]).sum(axis=1, keepdims=True)
    return np.hstack([scalar, w * first[1:] + first[0] * v + np.cross(v, first[1:])]), omega, alpha


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
