"""The planned motion, with exact rates and accelerations: a plan from a file, or a fifth-order polynomial.

Position and joints follow q(t) = q_0 + (q_T - q_0) s(t/T). The base turns about the eigenaxis, the fixed axis of the
rotation from its first to its last attitude, by an angle that follows the same blend; or, as in the paper, its roll,
pitch and yaw follow it. Angular velocity and acceleration are exact either way. With zero boundary rates and
accelerations the blend is s(x) = 10 x^3 - 15 x^4 + 6 x^5 (Section 4 of the paper; peak speed 1.875 D/T, peak
acceleration 5.7735 D/T^2).
"""

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Demultiplexer

from ffsm_drake.common.lifetime import untie, weak_callback
from ffsm_drake.scenario import Posture, Reference, Scenario
from ffsm_drake.spacecraft.coordinates import Coordinates, rotation_error
from ffsm_drake.systems.plan import Plan, load_plan

_BLOCK = 256  # control samples that are computed together: NumPy takes little longer for them than for one


def quintic_blend(time: np.ndarray | float, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The blend s in [0, 1] with its first (1/s) and second (1/s^2) derivative; constant outside [0, duration]."""
    x = np.minimum(np.maximum(np.asarray(time) / duration, 0.0), 1.0)
    return (
        x * x * x * (10.0 + x * (6.0 * x - 15.0)),
        30.0 * x * x * (1.0 + x * (x - 2.0)) / duration,
        60.0 * x * (1.0 + x * (2.0 * x - 3.0)) / (duration * duration),
    )


def eigenaxis_motion(
    first: np.ndarray, rotation: np.ndarray, blend: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4; w, x, y, z) of R_WB, angular velocities w_WB_W (n, 3) and accelerations alpha_WB_W (n, 3).

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


def rpy_motion(
    rpy: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions (n, 4; w, x, y, z) of R_WB, angular velocities w_WB_W (n, 3) and accelerations alpha_WB_W (n, 3).

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


class Motion:
    """A planned motion as a function of time. At control samples it is read from a precomputed block."""

    def __init__(self, coordinates: Coordinates, sample_time: float) -> None:
        """Args: of the spacecraft; the control period, s."""
        self.coordinates, self._sample_time = coordinates, sample_time
        self._first_sample, self._block = 0, np.empty((0, 0))  # a cache: the motion from this control sample on

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        raise NotImplementedError

    def evaluate(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q_d (nq), v_d (nv) and dv_d/dt (nv) at a time in s."""
        num_positions, num_velocities = len(self.coordinates.position_names), len(self.coordinates.names)
        q_d, v_d, a_d = np.split(self.row(time).copy(), [num_positions, num_positions + num_velocities])
        return q_d, v_d, a_d

    def row(self, time: float) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (nq + 2 nv) at a time in s; must not be changed in place."""
        sample = round(time / self._sample_time)
        if sample * self._sample_time != time:  # between the control samples
            return self.rows(np.array([time]))[0]
        if not 0 <= sample - self._first_sample < len(self._block):
            self._first_sample = sample
            self._block = self.rows(self._sample_time * np.arange(sample, sample + _BLOCK))
        return self._block[sample - self._first_sample]


class PlannedMotion(Motion):
    """The motion of a plan."""

    def __init__(self, plan: Plan, coordinates: Coordinates, sample_time: float) -> None:
        """Args: the plan; as for ``Motion``."""
        super().__init__(coordinates, sample_time)
        self._plan = plan

    def rows(self, times: np.ndarray) -> np.ndarray:
        """As for ``Motion``."""
        return self._plan.rows(times)


class QuinticMotion(Motion):
    """A fifth-order polynomial from one posture to another."""

    def __init__(
        self,
        *,
        coordinates: Coordinates,
        start: Posture,
        target: Posture,
        reference: Reference,
        sample_time: float,
    ) -> None:
        """Args: start and target posture (SI units), how to move between them; the target is held afterwards."""
        super().__init__(coordinates, sample_time)
        self._duration = reference.duration
        self._eigenaxis: tuple[np.ndarray, np.ndarray] | None = None  # first attitude, rotation vector to the last
        if reference.base_rotation == "eigenaxis":
            base, end = (RollPitchYaw(posture.base_rpy).ToQuaternion().wxyz() for posture in (start, target))
            self._eigenaxis = base, np.array(rotation_error(end, base))
        # Roll, pitch, yaw, position, joints.
        first, last = (
            np.concatenate(
                [
                    posture.base_rpy,
                    posture.base_position,
                    coordinates.vector(posture.joints, key="joints", default=0.0)[6:],
                ]
            )
            for posture in (start, target)
        )
        self._start, self._change = first, last - first

    def rows(self, times: np.ndarray) -> np.ndarray:
        """[q_d; v_d; dv_d/dt] (n, nq + 2 nv) at times (n,)."""
        s, ds, dds = (column[:, None] for column in quintic_blend(times, self._duration))
        value, rate, acceleration = self._start + s * self._change, ds * self._change, dds * self._change
        if self._eigenaxis is None:
            quaternion, omega, alpha = rpy_motion(value[:, :3], rate[:, :3], acceleration[:, :3])
        else:
            quaternion, omega, alpha = eigenaxis_motion(*self._eigenaxis, (s, ds, dds))
        return np.hstack([quaternion, value[:, 3:], omega, rate[:, 3:], alpha, acceleration[:, 3:]])


class _MotionSource(LeafSystem):
    """[q_d; v_d; dv_d/dt] in one output: two would be two calls from Drake in every sample."""

    def __init__(self, motion: Motion) -> None:
        super().__init__()
        self._motion = motion
        size = motion.row(0.0).size
        self.DeclareVectorOutputPort("motion", size, weak_callback(self._calc_motion), {self.time_ticket()})
        untie(self)

    def _calc_motion(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._motion.row(context.get_time()))


def make_motion(scenario: Scenario, coordinates: Coordinates) -> Motion:
    """The planned motion of a scenario. Raises ScenarioError when its plan cannot be read."""
    if scenario.reference.kind == "optimal":
        plan = load_plan(scenario.reference.plan or "", coordinates)
        return PlannedMotion(plan, coordinates, scenario.sample_time)
    return QuinticMotion(
        coordinates=coordinates,
        start=scenario.initial_posture,
        target=scenario.target_posture,
        reference=scenario.reference,
        sample_time=scenario.sample_time,
    )


def make_reference(scenario: Scenario, coordinates: Coordinates) -> Diagram:
    """A source of the planned motion, a function of time alone.

    Outputs:
      desired_state: [q_d; v_d] (nq + nv).
      desired_acceleration: time derivative of v_d (nv).
    """
    builder = DiagramBuilder()
    motion = builder.AddNamedSystem("motion", _MotionSource(make_motion(scenario, coordinates)))
    num_positions, num_velocities = len(coordinates.position_names), len(coordinates.names)
    parts = builder.AddNamedSystem("parts", Demultiplexer([num_positions + num_velocities, num_velocities]))
    builder.Connect(motion.get_output_port(), parts.get_input_port())
    builder.ExportOutput(parts.get_output_port(0), "desired_state")
    builder.ExportOutput(parts.get_output_port(1), "desired_acceleration")
    reference = builder.Build()
    reference.set_name("reference")
    return reference
