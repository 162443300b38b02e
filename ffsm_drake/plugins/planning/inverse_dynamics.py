"""Inverse dynamics of many states at once, with derivatives, for optimization.

A base attitude is a rotation vector phi from a fixed attitude R_0, in the world frame: R_WB =
exp(phi) R_0. So a motion is a curve in R^nv without a constraint, z = [phi, p_WB, joints], in the
order of v. It is unique while |phi| < pi.

Drake's own inverse dynamics takes one state at a time, about 1 ms each with automatic
differentiation. Here the plug-in ``equations`` evaluates all states of a motion at once, with
complex-step derivatives. No gravity.

With undriven coordinates the driven ones alone are planned for: the others follow by conservation
of momentum. With the whole base undriven and no angular momentum, force and the base's rates in its
own axes depend on the joints alone, wherever it is. So a motion of the joints is planned without
the base, whose attitude is the product of its small rotations.
"""

import itertools
from collections.abc import Callable
from typing import Protocol

import numpy as np
from pydrake.math import RotationMatrix

from ffsm_drake.common.errors import ModelError
from ffsm_drake.common.so3 import attitude_motion
from ffsm_drake.plugins.equations.equations import inverse_dynamics
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.plugins.tape.programs import Program
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.spacecraft.coordinates import NUM_BASE_VELOCITIES
from ffsm_drake.spacecraft.nominal import PlantModel, damping_of

_BASE = slice(0, NUM_BASE_VELOCITIES)
_STEP = 1e-30  # complex step: its truncation error is below rounding
_AT_ORIGIN = [1.0, *[0.0] * 6]  # pose of a base
_COLUMNS = 600  # states in one pass: as many as fit the processor's cache


def complex_step(
    calc: Callable[..., np.ndarray],
    motion: np.ndarray,
    wanted: list[tuple[int, int]] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """calc(z, rate, acceleration) (m, n) of a motion (3, size, n), and derivatives (3, m, size,
    n; row, column).

    Args: a function of complex arrays, column by column; the motion; the variables to differentiate
    by, (order, index), other derivatives being zero; None: all.
    """
    _, size, count = motion.shape
    wanted = list(np.ndindex(3, size)) if wanted is None else wanted
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


def in_base_axes(
    first: np.ndarray, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_WB (3, 3, n), and the base's velocity and acceleration (6, n) in its own axes, as if they
    were the world's. Args: R_0 (3, 3); z and its time derivatives, which begin with the base's.
    """
    turned, w, alpha = attitude_motion(z[:3], rate[:3], acceleration[:3])
    R_WB = np.einsum("ijn,jk->ikn", turned, first)
    base = np.array([[w, rate[3:6]], [alpha, acceleration[3:6]]])
    v, a = np.einsum("jin,abjn->abin", R_WB, base).reshape(2, NUM_BASE_VELOCITIES, -1)
    return R_WB, v, a


def in_world_axes(R_WB: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Forces (nv, n) on the base's axes as forces on the world's, in place."""
    on_base = tau[:NUM_BASE_VELOCITIES].reshape(2, 3, -1)
    tau[:NUM_BASE_VELOCITIES] = np.einsum("ijn,ajn->ain", R_WB, on_base).reshape(6, -1)
    return tau


class Dynamics(Protocol):
    """Forces of motions of z."""

    turns: bool  # whether the base's rotation follows, by conservation of momentum
    extra: int  # rows after the forces whose sizes are at most 1
    joints: slice | None  # rows of all joints; None: the last ones of z

    def calc(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """The rows (n columns), first forces, for z and its time derivatives (size, n).

        Complex arrays pass.
        """
        ...


class InverseDynamics:
    """Generalized force tau = H dv/dt + C + d v of a motion, d being the joints' damping."""

    turns = False
    extra = 0
    joints: slice | None = None

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
        tree, own = reader.tree, reader.parameters(model.context)
        self._damping = damping_of(model.plant)[:, None]
        tape, nv = Tape(), tree.num_velocities
        joints, v, a = (
            inputs(tape, name, (size,))
            for name, size in (("joints", nv - NUM_BASE_VELOCITIES), ("v", nv), ("a", nv))
        )
        q = np.concatenate([_AT_ORIGIN, joints])
        self._program = Program(tape, inverse_dynamics(tree, q, v, a, own))
        self._first = first.matrix()

    def calc(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """tau (nv, n), world axes, for z and its time derivatives (nv, n). Complex arrays pass."""
        joints = slice(NUM_BASE_VELOCITIES, None)
        R_WB, v, a = in_base_axes(self._first, z, rate, acceleration)
        found = self._program.run(
            {"joints": z[joints], "v": [*v, *rate[joints]], "a": [*a, *acceleration[joints]]}
        )
        return in_world_axes(R_WB, np.array(found) + self._damping * rate)


class FreeDynamics:
    """Force on driven coordinates z_a: joints, perhaps after the base's rotation vector."""

    def __init__(self, dynamics: Dynamics, driven: np.ndarray, size: int, mass: float) -> None:
        """Args: of all z, which begins with the base; indices in z of what is driven; the size of
        z; the mass of the whole, kg.
        """
        self._dynamics, self._driven, self._size, self._mass = dynamics, driven, size, mass
        self._undriven = np.setdiff1d(np.arange(size), driven)
        self.turns, self.extra = 0 not in driven, dynamics.extra
        self.joints = joints = dynamics.joints
        if joints is not None:
            fewer = self._undriven.size
            self.joints = slice(joints.start - fewer, joints.stop - fewer)

    def calc(self, z: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """The rows without forces on what is not driven, for z_a and its time derivatives (na, n).

        Where the base's rotation follows, below them w_WB and alpha_WB (6, n), in axes that go
        with the base and are the world's when its attitude is R_0. Complex arrays pass.
        """
        count = z.shape[1]
        whole, moving, speeding = (np.zeros((self._size, count), dtype=z.dtype) for _ in range(3))
        whole[self._driven], moving[self._driven], speeding[self._driven] = z, rate, acceleration
        force = self._dynamics.calc
        if not self.turns:
            speeding[3:NUM_BASE_VELOCITIES] = -force(whole, moving, speeding)[3:NUM_BASE_VELOCITIES]
            speeding[3:NUM_BASE_VELOCITIES] /= self._mass
            return np.delete(force(whole, moving, speeding), self._undriven, axis=0)
        # The momentum of unit rates about each axis, and of the joints' rates: forces of such
        # accelerations at rest.
        units = np.zeros((self._size, 4, count), dtype=z.dtype)
        units[[0, 1, 2], [0, 1, 2]] = 1.0
        units[self._driven, 3] = rate
        still = np.zeros((self._size, 4 * count), dtype=z.dtype)
        momentum = force(np.tile(whole, 4), still, units.reshape(self._size, -1))[_BASE].reshape(
            6, 4, count
        )
        inertia = np.zeros((count, 6, 6), dtype=z.dtype)  # H_uu
        inertia[:, :, :3] = momentum[:, :3].transpose(2, 0, 1)
        inertia[:, :3, 3:] = inertia[:, 3:, :3].transpose(0, 2, 1)
        inertia[:, [3, 4, 5], [3, 4, 5]] = self._mass
        moving[:3] = -np.linalg.solve(inertia, momentum[:, 3].T[..., None])[:, :3, 0].T
        wrench = force(whole, moving, speeding)[_BASE]
        speeding[_BASE] = -np.linalg.solve(inertia, wrench.T[..., None])[..., 0].T
        found = np.delete(force(whole, moving, speeding), self._undriven, axis=0)
        return np.vstack([found, moving[:3], speeding[:3]])


def turned(
    w: np.ndarray, alpha: np.ndarray, by: np.ndarray, steps: np.ndarray, by_steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations of a body since the first of some instants, and how they change.

    Each step is a rotation by h/2 (w_0 + w_1) + h^2/12 (alpha_0 - alpha_1 + w_0 x w_1), of fourth
    order.

    Args:
      w, alpha: (n, 3), rad/s and rad/s^2, in the body's axes.
      by: derivatives of both (n, 6, unknowns).
      steps, by_steps: h (n - 1,), s, and its derivatives (n - 1, unknowns).

    Returns: rotation matrices (n, 3, 3) in the first axes, and the small rotations from there, in
    those axes too, by the unknowns (n, 3, unknowns).
    """
    first, last, half = w[:-1], w[1:], 0.5 * steps[:, None]
    bend = (alpha[:-1] - alpha[1:] + np.cross(first, last)) / 3.0
    vectors = half * (first + last + half * bend)
    by_bend = by[:-1, 3:] - by[1:, 3:]
    by_bend += np.cross(first[..., None], by[1:, :3], axis=1)
    by_bend -= np.cross(last[..., None], by[:-1, :3], axis=1)
    half = half[..., None]
    slope = half * (by[:-1, :3] + by[1:, :3] + half * by_bend / 3.0)
    slope += (0.5 * (first + last) + half[..., 0] * bend)[..., None] * by_steps[:, None]
    none = np.zeros_like(vectors.T)
    small = attitude_motion(vectors.T, none, none)[0]
    # The left Jacobian, whose columns are the angular velocities of unit rates of the vector.
    left = [attitude_motion(vectors.T, none + axis[:, None], none)[1] for axis in np.eye(3)]
    rotation = np.array(
        list(itertools.accumulate(small.transpose(2, 0, 1), np.matmul, initial=np.eye(3)))
    )
    steps = rotation[:-1] @ np.array(left).transpose(2, 1, 0) @ slope
    return rotation, np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
