"""The grasped payload's ten inertial parameters, in which forces and momentum are linear.

With theta = [m; m c; I], I = (xx, yy, zz, xy, xz, yz) about the origin of the payload's frame, in
its axes, the payload adds Y theta to the force H a_r + C(q, v) v_r, and W theta to the momentum.

C is the one of the Levi-Civita connection: v_s^T (dH/dt - 2 C) v_s = 0 for every v_s. With Drake's
bias term b(v) = C(q, v) v, and the base's angular velocity w, whose components are no rates of
coordinates,

    C(q, v) v_r = (b(v + v_r) - b(v - v_r)) / 4 + H [w_r x w; 0] / 2.
"""

import dataclasses
from typing import Self

import numpy as np
from pydrake.multibody.tree import Frame

from ffsm_drake.common.so3 import cross_of, matrix_of, skew
from ffsm_drake.spacecraft.inertia import SIX
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.spacecraft.plant import find_body
from ffsm_drake.systems.setup import BlockSetup

SIZE = 10  # parameters
_I, _J = SIX


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Payload:
    """The payload's frame in the whole plant with the nominal payload."""

    model: PlantModel
    frame: Frame

    @classmethod
    def from_setup(cls, setup: BlockSetup) -> Self:
        """The scenario's payload. Raises ModelError: there is no such body."""
        given = setup.nominal
        model = given
        if given.coordinates.undriven:  # the whole model, not the reduced one that laws get
            model = PlantModel(
                plant=given.plant, context=given.context, coordinates=given.coordinates
            )
        body = find_body(given.plant, setup.scenario.payload.body, key="payload.body")
        return cls(model=model, frame=body.body_frame())

    def force_regressor(
        self, q: np.ndarray, v: np.ndarray, v_r: np.ndarray, a_r: np.ndarray
    ) -> np.ndarray:
        """Y (nv, 10) of the force H a_r + C(q, v) v_r, for one configuration q (nq)."""
        jacobian = self.model.calc_jacobian(q, self.frame)
        rates = self.model.calc_bias_acceleration(
            q, v + v_r, self.frame
        ) - self.model.calc_bias_acceleration(q, v - v_r, self.frame)
        acceleration = jacobian @ _with_turn(v, v_r, a_r) + 0.25 * rates
        R_WB = self._rotation(q)
        w, w_r = R_WB.T @ (jacobian[:3] @ v), R_WB.T @ (jacobian[:3] @ v_r)
        alpha, a = R_WB.T @ acceleration[:3], R_WB.T @ acceleration[3:]
        turning, turning_r = skew(w), skew(w_r)
        y = np.zeros_like(jacobian, shape=(6, SIZE))
        y[:3, 1:4] = -skew(a)
        y[:3, 4:] = _turned(alpha) + 0.5 * (turning @ _turned(w_r) + turning_r @ _turned(w))
        y[3:, 0] = a
        y[3:, 1:4] = skew(alpha) + 0.5 * (turning @ turning_r + turning_r @ turning)
        own = np.concatenate([R_WB.T @ jacobian[:3], R_WB.T @ jacobian[3:]])
        return own.T @ y

    def momentum_regressor(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """W (6, 10) of the momentum [angular about the world's origin; linear] of v (nv)."""
        R_WB, twist = self._rotation(q), self.model.calc_jacobian(q, self.frame) @ v
        p_WB = self.model.calc_frame_pose(q, self.frame)[4:]
        w, velocity = R_WB.T @ twist[:3], R_WB.T @ twist[3:]
        own = np.zeros_like(twist, shape=(6, SIZE))  # about the frame's origin, its axes
        own[:3, 1:4] = -skew(velocity)
        own[:3, 4:] = _turned(w)
        own[3:, 0] = velocity
        own[3:, 1:4] = skew(w)
        linear = R_WB @ own[3:]
        return np.concatenate([R_WB @ own[:3] + skew(p_WB) @ linear, linear])

    def added_mass_matrix(self, q: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """The share of theta (10) in the mass matrix (nv, nv)."""
        jacobian, R_WB = self.model.calc_jacobian(q, self.frame), self._rotation(q)
        own = np.concatenate([R_WB.T @ jacobian[:3], R_WB.T @ jacobian[3:]])
        inertia = np.zeros_like(theta, shape=(3, 3))
        inertia[_I, _J] = inertia[_J, _I] = theta[4:]
        first = skew(theta[1:4])
        return own.T @ np.block([[inertia, first], [-first, theta[0] * np.eye(3)]]) @ own

    def _rotation(self, q: np.ndarray) -> np.ndarray:
        return matrix_of(self.model.calc_frame_pose(q, self.frame)[:4])


def force_of(
    model: PlantModel, q: np.ndarray, v: np.ndarray, v_r: np.ndarray, a_r: np.ndarray
) -> np.ndarray:
    """H a_r + C(q, v) v_r (nv) of a plant, N m and N."""
    bias = model.calc_bias(q, v + v_r) - model.calc_bias(q, v - v_r)
    return model.calc_mass_matrix(q) @ _with_turn(v, v_r, a_r) + 0.25 * bias


def _with_turn(v: np.ndarray, v_r: np.ndarray, a_r: np.ndarray) -> np.ndarray:
    """a_r + [w_r x w; 0] / 2 (nv)."""
    result = a_r.copy()
    result[:3] += 0.5 * cross_of(v_r[:3], v[:3])
    return result


def _turned(w: np.ndarray) -> np.ndarray:
    """L (3, 6) with L (xx, yy, zz, xy, xz, yz) = I w."""
    x, y, z = w
    return np.array(
        [
            [x, 0.0, 0.0, y, z, 0.0],
            [0.0, y, 0.0, x, 0.0, z],
            [0.0, 0.0, z, 0.0, x, y],
        ]
    )
