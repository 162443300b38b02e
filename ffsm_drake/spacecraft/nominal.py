"""The model of a spacecraft, for computations outside a simulation."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context

from ffsm_drake.common.memo import each_once
from ffsm_drake.common.products import applied, condensed
from ffsm_drake.scenario import HELD, Grip
from ffsm_drake.spacecraft.coordinates import Coordinates, StateSplit, joints_of, tracking_errors
from ffsm_drake.spacecraft.plant import find_frame, flexible_parts

Calc = TypeVar("Calc", bound=Callable[..., np.ndarray])


def stacked(calc: Calc) -> Calc:
    """Return a method of one configuration (and velocity), made to take arrays (..., nq) of many,
    too.
    """

    @functools.wraps(calc)
    def calc_each(model: "PlantModel", q: np.ndarray, *rest: Any) -> np.ndarray:
        if q.ndim == 1:
            return calc(model, q, *rest)
        velocities = [item for item in rest if isinstance(item, np.ndarray)]
        frame = rest[len(velocities) :]
        return np.stack(each_once(lambda *state: calc_each(model, *state, *frame), q, *velocities))

    return cast("Calc", calc_each)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlantModel:
    """A spacecraft model with a payload, for computations outside of a simulation.

    ``context`` belongs to this object and is used for intermediate values. Every method sets its
    own inputs in it.

    Example:
      >>> import numpy as np
      >>> from ffsm_drake import load_scenario, make_nominal_plant
      >>> model = make_nominal_plant(load_scenario("postcapture"))
      >>> mass = model.calc_mass_matrix(np.array([1.0, *np.zeros(11)]))
      >>> mass.shape, bool(np.allclose(mass, mass.T))
      ((11, 11), True)
    """

    plant: MultibodyPlant
    context: Context
    coordinates: Coordinates
    # not trivial with flexible parts only
    split: StateSplit = dataclasses.field(default_factory=StateSplit)
    grip: Grip = HELD  # what holds the payload

    def calc_tracking_errors(
        self, desired: np.ndarray, actual: np.ndarray, num_positions: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """``coordinates.tracking_errors`` of the law's states."""
        return tracking_errors(desired, actual, num_positions)

    @stacked
    def calc_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix H (..., nv, nv) in configurations q (..., nq)."""
        self._set_state(q)
        return self.plant.CalcMassMatrix(self.context)

    def calc_whole_velocity(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Velocities of all coordinates (..., nv) for v; v itself but in a closed chain."""
        return v

    def calc_apparent_mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the apparent mass matrix (nv, nv) of the known coordinates at high frequency,
        before the springs of the hidden ones act, at q (nq).

        Without flexible parts it is H itself. Deflections are zero.
        """
        split = self.split
        whole = PlantModel.calc_mass_matrix(self, split.whole_positions(q))
        return condensed(whole, split.known, split.hidden) if split.names else whole

    def modes(self, q: np.ndarray) -> list[Any]:
        """Return modes of vibration (``VibrationMode``) at rest in configuration q (nq), slowest
        first.
        """
        if not self.split.names:
            return []
        self._set_state(self.split.whole_positions(q))
        return flexible_parts().modes_of(self.plant, self.context, self.split)

    @stacked
    def calc_bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the Coriolis and centrifugal term C (..., nv) of H dv/dt + C = tau + tau_d, N m
        and N.
        """
        self._set_state(q, v)
        return self.plant.CalcBiasTerm(self.context)

    def calc_acceleration(self, q: np.ndarray, v: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return dv/dt (nv) under a generalized force (nv), N m and N, with springs and dampers."""
        self._set_state(q, v)
        self.plant.get_applied_generalized_force_input_port().FixValue(self.context, force)
        return np.array(self.plant.get_generalized_acceleration_output_port().Eval(self.context))

    @stacked
    def calc_jacobian(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """Return the Jacobian J (..., 6, nv) of a frame F in configurations q (..., nq): [w_WF;
        v_WF] = J v, world axes.

        v_WF is the velocity of F's origin.

        Args:
          q: (..., nq).
          frame: the frame, or its scoped name, such as ``servicer::end_effector`` or, for a body's
            frame, ``debris::debris``.
          seen_from: a frame in place of the world, whose axes are used then.

        Raises ModelError if there is no such frame.
        """
        self._set_state(q)
        world = seen_from or self.plant.world_frame()
        return self.plant.CalcJacobianSpatialVelocity(
            self.context, JacobianWrtVariable.kV, self._frame(frame), np.zeros(3), world, world
        )

    @stacked
    def calc_bias_acceleration(
        self, q: np.ndarray, v: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """J' v (..., 6) of a frame F: its [alpha_WF; a_WF] at constant v (..., nv), rad/s^2, m/s^2.

        a_WF is the acceleration of F's origin; world axes. Args and errors as ``calc_jacobian``.
        Drake takes the default pose of F on its body, so F must not be displaced in the context.
        """
        self._set_state(q, v)
        world = seen_from or self.plant.world_frame()
        bias = self.plant.CalcBiasSpatialAcceleration(
            self.context, JacobianWrtVariable.kV, self._frame(frame), np.zeros(3), world, world
        )
        return np.array(bias.get_coeffs())

    @stacked
    def calc_frame_pose(
        self, q: np.ndarray, frame: Frame | str, seen_from: Frame | None = None
    ) -> np.ndarray:
        """[quaternion (w, x, y, z) of R_WF; p_WF] (..., 7) of a frame F; p_WF in m.

        Args and errors as ``calc_jacobian``.
        """
        self._set_state(q)
        X_WF = self._frame(frame).CalcPose(self.context, seen_from or self.plant.world_frame())
        return np.concatenate([X_WF.rotation().ToQuaternion().wxyz(), X_WF.translation()])

    def calc_frame_rotation(self, q: np.ndarray, frame: Frame | str) -> np.ndarray:
        """R_WF (3, 3) of a frame F at q (nq). Args and errors as ``calc_jacobian``."""
        self._set_state(q)
        pose = self._frame(frame).CalcPoseInWorld(self.context)
        return np.ascontiguousarray(pose.rotation().matrix())

    def calc_frame_twist(self, q: np.ndarray, v: np.ndarray, frame: Frame | str) -> np.ndarray:
        """[w_WF; v_WF] (6) of a frame F at q (nq), v (nv), world axes, rad/s, m/s. Args and errors
        as ``calc_jacobian``.
        """
        # Drake's velocity of a frame ignores a pose that is set in a context
        return self.calc_jacobian(q, frame) @ v

    def calc_point_jacobian(
        self, q: np.ndarray, frame: Frame | str, point: np.ndarray
    ) -> np.ndarray:
        """Jacobian (6, nv) of a point of a frame F (3; m, F's axes), in F's axes, at q (nq). Args
        and errors as ``calc_jacobian``.
        """
        self._set_state(q)
        own = self._frame(frame)
        return self.plant.CalcJacobianSpatialVelocity(
            self.context, JacobianWrtVariable.kV, own, point, self.plant.world_frame(), own
        )

    def calc_frame_motion(
        self, q: np.ndarray, v: np.ndarray, a: np.ndarray, frame: Frame | str
    ) -> np.ndarray:
        """Return a frame's pose, twist, acceleration (..., 19) for q, v, dv/dt.

        [``calc_frame_pose``; w_WF; v_WF; alpha_WF; a_WF], world axes. Args and errors as
        ``calc_jacobian``.
        """
        pose, jacobian = self.calc_frame_pose(q, frame), self.calc_jacobian(q, frame)
        acceleration = applied(jacobian, a) + self.calc_bias_acceleration(q, v, frame)
        return np.concatenate([pose, applied(jacobian, v), acceleration], axis=-1)

    def calc_inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the force H a + C (..., nv) that gives accelerations a (..., nv), N m and N."""
        return applied(self.calc_mass_matrix(q), a) + self.calc_bias(q, v)

    def calc_tracking_force(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the actuator force (..., nv) along a motion: inverse dynamics and the joints'
        damping.
        """
        return self.calc_inverse_dynamics(q, v, a) + damping_of(self.plant) * v

    def _frame(self, frame: Frame | str) -> Frame:
        return find_frame(self.plant, frame, key="frame") if isinstance(frame, str) else frame

    def _set_state(self, q: np.ndarray, v: np.ndarray | None = None) -> None:
        if not math.isfinite(q.dot(q)):  # Drake would end the process
            raise ValueError("the configuration q is not finite")
        self.plant.SetPositions(self.context, q)
        if v is not None:
            if not math.isfinite(v.dot(v)):
                raise ValueError("the velocity v is not finite")
            self.plant.SetVelocities(self.context, v)


def damping_of(plant: MultibodyPlant) -> np.ndarray:
    """Return the joints' damping (nv), N m s or N s/m."""
    damping = np.zeros(plant.num_velocities())
    for joint in joints_of(plant):
        damping[joint.velocity_start()] = joint.default_damping()
    return damping
