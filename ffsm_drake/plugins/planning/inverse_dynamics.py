"""Inverse dynamics of many states at once, with derivatives, for optimization.

A base attitude is a rotation vector phi from a fixed attitude R_0, in the world frame: R_WB =
exp(phi) R_0. So a motion is a curve in R^nv without a constraint, z = [phi, p_WB, joints], in the
order of v. It is unique while |phi| < pi.

Drake's own inverse dynamics takes one state at a time, about 1 ms each with automatic
differentiation. Here the plug-in ``equations`` evaluates all states of a motion at once, with
complex-step derivatives. No gravity.
"""

from collections.abc import Callable

import numpy as np
from pydrake.math import RotationMatrix

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.plugins.equations.equations import inverse_dynamics
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.nominal import PlantModel

_STEP = 1e-30  # complex step: its truncation error is below rounding
_AT_ORIGIN = [1.0, *[0.0] * 6]  # pose of a base
_COLUMNS = 600  # states in one pass: as many as fit the processor's cache


def complex_step(
    calc: Callable[..., np.ndarray],
    motion: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: list[tuple[int, int]],
) -> tuple[np.ndarray, np.ndarray]:
    """calc(z, rate, acceleration) (m, n) of a motion (size, n each), and derivatives (3, m, size,
    n; row, column).

    Args: a function of complex arrays, column by column; the variables to differentiate by, (order,
    index), other derivatives being zero.
    """
    size, count = motion[0].shape
    share = max(1, _COLUMNS // count)
    value, derivative = np.empty(0), np.empty(0)
    for start in range(0, len(wanted), share):
        some = wanted[start : start + share]
        given = [np.repeat(part[:, None].astype(complex), len(some), axis=1) for part in motion]
        for column, (which, i) in enumerate(some):
            given[which][i, column] += 1j * _STEP
        found = calc(*(part.reshape(size, -1) for part in given)).reshape(-1, len(some), count)
        if not derivative.size:
            derivative = np.zeros((3, len(found), size, count))
        for column, (which, i) in enumerate(some):
            derivative[which, :, i] = found[:, column].imag / _STEP
        value = found[:, 0].real
    return value, derivative


class InverseDynamics:
    """Generalized force tau = H dv/dt + C + d v of a motion, d being the joints' damping."""

    turns = False  # True if the base's rotation is a coordinate of the motion

    def __init__(self, model: PlantModel, first: RotationMatrix) -> None:
        """Args:
          model: the plant with its payload.
          first: the attitude R_0, the origin of rotation vectors.

        Raises ModelError: a joint is neither revolute nor prismatic.
        """
        try:
            reader = Reader(model.plant)
        except NotCovered as error:
            raise ModelError(f"the motion cannot be planned: {error}") from error
        self._tree, self._own = reader.tree, reader.parameters(model.context).tolist()
        self._first = first.matrix()

    @property
    def mass(self) -> float:
        """Mass of the whole spacecraft, kg."""
        bodies = range(len(self._tree.links) + 1)
        return sum(self._own[self._tree.inertia_rows(body)][0] for body in bodies)

    def force(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """tau (nv, n), world axes, for z and its time derivatives (nv, n)."""
        tree, own, joints = self._tree, self._own, slice(NUM_BASE_VELOCITIES, None)
        turned, w, alpha = attitude_motion(z[:3], rate[:3], acceleration[:3])
        R_WB = np.einsum("ijn,jk->ikn", turned, self._first)
        base = np.array([[w, rate[3:6]], [alpha, acceleration[3:6]]])
        v, a = np.einsum("jin,abjn->abin", R_WB, base).reshape(2, NUM_BASE_VELOCITIES, -1)
        # in the base's axes, as if it were the world's
        found = inverse_dynamics(
            tree, [*_AT_ORIGIN, *z[joints]], [*v, *rate[joints]], [*a, *acceleration[joints]], own
        )
        for body, link in enumerate(tree.links, start=1):
            found[link.velocity] += own[tree.joint_rows(body)][0] * rate[link.velocity]
        tau = np.array(found)
        on_base = tau[:NUM_BASE_VELOCITIES].reshape(2, 3, -1)
        tau[:NUM_BASE_VELOCITIES] = np.einsum("ijn,ajn->ain", R_WB, on_base).reshape(6, -1)
        return tau

    def linearized(
        self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """tau (nv, n), and its derivatives by z, rate and acceleration (3, nv, nv, n; row,
        column).
        """
        size = len(z)
        # the force does not depend on position and its rate
        inner = [i for i in range(size) if not 3 <= i < NUM_BASE_VELOCITIES]
        wanted = [(0, i) for i in inner] + [(1, i) for i in inner] + [(2, i) for i in range(size)]
        return complex_step(self.force, (z, rate, acceleration), wanted)
