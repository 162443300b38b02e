"""The planned motion: a fifth-order polynomial from one posture to another, with exact rates and accelerations.

Position and joints follow q(t) = q_0 + (q_T - q_0) s(t/T); the base's roll, pitch and yaw do the same, and its angular
velocity and acceleration follow from them exactly. With zero boundary rates and accelerations the blend is
s(x) = 10 x^3 - 15 x^4 + 6 x^5 (Section 4 of the paper; peak speed 1.875 D/T, peak acceleration 5.7735 D/T^2).
"""

import math

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, OutputPort

from ffsm_drake.coordinates import Coordinates
from ffsm_drake.scenario import Posture, Scenario

Triple = tuple[float, float, float]


def quintic_blend(time: float, duration: float) -> Triple:
    """The blend s in [0, 1] with its first (1/s) and second (1/s^2) derivative; constant outside [0, duration]."""
    if time <= 0.0:
        return 0.0, 0.0, 0.0
    if time >= duration:
        return 1.0, 0.0, 0.0
    x = time / duration
    return (
        x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        30.0 * x * x * (1.0 + x * (x - 2.0)) / duration,
        60.0 * x * (1.0 + x * (2.0 * x - 3.0)) / (duration * duration),
    )


def rpy_motion(rpy: Triple, rate: Triple, acceleration: Triple) -> tuple[tuple[float, ...], Triple, Triple]:
    """Quaternion (w, x, y, z) of R_WB, angular velocity w_WB_W (rad/s) and acceleration alpha_WB_W (rad/s^2).

    Args:
      rpy: roll, pitch, yaw (rad), R_WB = R_z(yaw) R_y(pitch) R_x(roll).
      rate, acceleration: their time derivatives.
    """
    r, p, y = rpy
    dr, dp, dy = rate
    ddr, ddp, ddy = acceleration
    sp, cp, sy, cy = math.sin(p), math.cos(p), math.sin(y), math.cos(y)
    omega = (cp * cy * dr - sy * dp, cp * sy * dr + cy * dp, dy - sp * dr)
    alpha = (
        cp * cy * ddr - sy * ddp - (sp * cy * dp + cp * sy * dy) * dr - cy * dy * dp,
        cp * sy * ddr + cy * ddp - (sp * sy * dp - cp * cy * dy) * dr - sy * dy * dp,
        ddy - sp * ddr - cp * dp * dr,
    )
    sr2, cr2 = math.sin(0.5 * r), math.cos(0.5 * r)
    sp2, cp2 = math.sin(0.5 * p), math.cos(0.5 * p)
    sy2, cy2 = math.sin(0.5 * y), math.cos(0.5 * y)
    quaternion = (
        cr2 * cp2 * cy2 + sr2 * sp2 * sy2,
        sr2 * cp2 * cy2 - cr2 * sp2 * sy2,
        cr2 * sp2 * cy2 + sr2 * cp2 * sy2,
        cr2 * cp2 * sy2 - sr2 * sp2 * cy2,
    )
    return quaternion, omega, alpha


class QuinticReference(LeafSystem):
    """Source of the planned motion, a function of time alone.

    Outputs:
      desired_state: [q_d; v_d] (nq + nv).
      desired_acceleration: time derivative of v_d (nv).
    """

    def __init__(self, *, coordinates: Coordinates, start: Posture, target: Posture, duration: float) -> None:
        """Args: start and target posture (SI units), duration in s; the target is held afterwards."""
        super().__init__()
        self._duration = duration
        rpy_0, rpy_t = start.base_rpy, target.base_rpy
        linear_0, linear_t = (
            [*posture.base_position, *coordinates.vector(posture.joints, key="joints", default=0.0)[6:].tolist()]
            for posture in (start, target)
        )
        # (start, change) of each coordinate, as floats: NumPy is slower on so few numbers.
        self._rpy = [(a, b - a) for a, b in zip(rpy_0, rpy_t, strict=True)]
        self._linear = [(a, b - a) for a, b in zip(linear_0, linear_t, strict=True)]
        num_velocities = len(coordinates.names)
        self.DeclareVectorOutputPort("desired_state", 2 * num_velocities + 1, self._calc_state, {self.time_ticket()})
        self.DeclareVectorOutputPort(
            "desired_acceleration", num_velocities, self._calc_acceleration, {self.time_ticket()}
        )

    def get_desired_state_output_port(self) -> OutputPort:
        return self.GetOutputPort("desired_state")

    def get_desired_acceleration_output_port(self) -> OutputPort:
        return self.GetOutputPort("desired_acceleration")

    def evaluate(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q_d (nq), v_d (nv) and dv_d/dt (nv) at a time in s."""
        state = np.array(self._state(time))
        num_positions = len(self._linear) + 4
        return state[:num_positions], state[num_positions:], np.array(self._acceleration(time))

    def _state(self, time: float) -> list[float]:
        s, ds, dds = quintic_blend(time, self._duration)
        quaternion, omega, _ = self._base_rotation(s, ds, dds)
        return [*quaternion, *[a + s * d for a, d in self._linear], *omega, *[ds * d for _, d in self._linear]]

    def _acceleration(self, time: float) -> list[float]:
        s, ds, dds = quintic_blend(time, self._duration)
        _, _, alpha = self._base_rotation(s, ds, dds)
        return [*alpha, *[dds * d for _, d in self._linear]]

    def _base_rotation(self, s: float, ds: float, dds: float) -> tuple[tuple[float, ...], Triple, Triple]:
        (r, dr), (p, dp), (y, dy) = self._rpy
        return rpy_motion(
            (r + s * dr, p + s * dp, y + s * dy), (ds * dr, ds * dp, ds * dy), (dds * dr, dds * dp, dds * dy)
        )

    def _calc_state(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._state(context.get_time()))

    def _calc_acceleration(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._acceleration(context.get_time()))


def make_reference(scenario: Scenario, coordinates: Coordinates) -> QuinticReference:
    """The planned motion of a scenario."""
    return QuinticReference(
        coordinates=coordinates,
        start=scenario.initial_posture,
        target=scenario.target_posture,
        duration=scenario.reference.duration,
    )
