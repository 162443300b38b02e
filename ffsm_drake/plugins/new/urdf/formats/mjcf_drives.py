"""What the actuators of a MuJoCo model add to its joints: limits of force, and rotors."""

import copy
import itertools
from typing import Any

import mujoco
import numpy as np

_FAR = (1e8, 1e9)  # controls, lengths and rates, in their units; MuJoCo refuses 1e10
_UNLIMITED = np.array([-np.inf, np.inf])
_KNOWN = {  # kinds with a steady force that is linear in the control, or grows with the motion
    "gaintype": (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE),
    "biastype": (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE),
    "dyntype": (
        mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_INTEGRATOR, mujoco.mjtDyn.mjDYN_FILTER,
        mujoco.mjtDyn.mjDYN_FILTEREXACT,
    ),
}  # fmt: skip


def rotors(m: Any, dofs: list[int]) -> list[float | None]:
    """Return the inertia (kg m^2 or kg) that drives add to degrees of freedom, from the mass matrix
    with and without armature; None: the inertia acts on several.
    """
    bare = copy.copy(m)
    bare.dof_armature[:] = bare.actuator_armature[:] = 0.0
    whole, found = _mass_matrix(m), list[float | None]()
    extra = whole - _mass_matrix(bare)
    tolerance = 1e-12 * float(np.abs(whole).max(initial=0.0))
    for k in dofs:
        is_own = np.abs(np.delete(extra[k], k)).max(initial=0.0) <= tolerance
        own = float(m.dof_armature[k])
        size = own if abs(extra[k, k] - own) <= tolerance else float(extra[k, k])
        found.append(size if is_own else None)
    return found


def _mass_matrix(m: Any) -> np.ndarray:
    """The mass matrix (nv, nv) in the reference configuration."""
    data, matrix = mujoco.MjData(m), np.zeros((m.nv, m.nv))
    mujoco.mj_forward(m, data)
    mujoco.mj_fullM(m, data, matrix)
    return matrix


class Efforts:
    """The limits of the forces of joints, as MuJoCo computes them at extremes of control, length
    and rate of the actuators. A force that grows with these extremes has no limit.
    """

    def __init__(self, m: Any) -> None:
        self._m, self._control = _steady(m)
        self._data = mujoco.MjData(self._m)
        self._moments, other = self._moment(0), self._moment(1)
        self._varies = ~np.isclose(self._moments, other, rtol=1e-9, atol=1e-12)
        states = np.array([*itertools.product((-1.0, 1.0), repeat=3)])
        self._states = np.repeat(states[:, None], len(self._moments), axis=1)

    def _moment(self, seed: int) -> np.ndarray:
        """Force of each degree of freedom per force of each actuator (n, nv), in a configuration
        that is drawn.
        """
        m, data = self._m, self._data
        rates = np.random.default_rng(seed).normal(size=m.nv)
        data.qpos[:] = m.qpos0
        mujoco.mj_integratePos(m, data.qpos, rates, 1.0)
        for compute in (
            mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_tendon, mujoco.mj_transmission,
        ):  # fmt: skip
            compute(m, data)
        rows = data.moment_rownnz, data.moment_rowadr, data.moment_colind
        dense = np.zeros((len(rows[0]), m.nv))
        if dense.size:
            mujoco.mju_sparse2dense(dense, data.actuator_moment, *rows)
        return dense[m.actuator_outadr]

    def _act(self, states: np.ndarray, far: float) -> None:
        """Compute forces for the signs of control, length and rate of each actuator (n, 3)."""
        m, data, (low, high) = self._m, self._data, np.clip(self._control, -far, far).T
        data.ctrl[m.actuator_ctrladr] = np.where(states[:, 0] > 0.0, high, low)
        data.actuator_length[m.actuator_outadr] = far * states[:, 1]
        data.actuator_velocity[m.actuator_outadr] = far * states[:, 2]
        mujoco.mj_fwdActuation(m, data)

    def of(self, joint: int) -> np.ndarray:
        """Return the least and the greatest force (2) of a joint, N m or N; infinite: not limited,
        or no actuator acts.
        """
        m, dof = self._m, int(self._m.jnt_dofadr[joint])
        if self._varies[:, dof].any():
            total = _UNLIMITED
        else:
            near, total = (self._extremes(dof, far) for far in _FAR)
            total = np.where(np.isclose(near, total, rtol=1e-6, atol=0.0), total, _UNLIMITED)
        if not total.any():
            total = _UNLIMITED
        return np.clip(total, *m.jnt_actfrcrange[joint]) if m.jnt_actfrclimited[joint] else total

    def _extremes(self, dof: int, far: float) -> np.ndarray:
        """Return the least and the greatest force (2) of a degree of freedom."""
        forces, found, each = list[np.ndarray](), list[float](), np.arange(len(self._moments))
        for states in self._states:
            self._act(states, far)
            force = self._data.actuator_force[self._m.actuator_outadr]
            forces.append(force * self._moments[:, dof])
        for choose in (np.argmin, np.argmax):
            self._act(self._states[choose(forces, axis=0), each], far)
            found.append(float(self._data.qfrc_actuator[dof]))
        return np.array(found)


def _steady(m: Any) -> tuple[Any, np.ndarray]:
    """Return a model whose actuators have the force of their steady state at once, and the ranges
    of their controls (n, 2). Other kinds (muscles) push with any force within their range.
    """
    m, clamps = copy.copy(m), not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    control = np.tile(_UNLIMITED, (len(m.actuator_trntype), 1))
    for k, at in enumerate(m.actuator_ctrladr):
        integrates = int(m.actuator_dyntype[k]) == mujoco.mjtDyn.mjDYN_INTEGRATOR
        if m.actuator_ctrllimited[at] and clamps and not integrates:
            control[k] = m.actuator_ctrlrange[at]
        if m.actuator_dyntype[k] and m.actuator_actlimited[k]:
            control[k] = np.clip(control[k], *m.actuator_actrange[k])
        kinds = {key: getattr(m, f"actuator_{key}") for key in _KNOWN}
        if not all(int(kinds[key][k]) in known for key, known in _KNOWN.items()):
            for each in kinds.values():
                each[k] = 0
            m.actuator_gainprm[k][0], control[k] = 1.0, _UNLIMITED
    m.actuator_dyntype[:] = m.actuator_ctrllimited[:] = m.actuator_actnum[:] = 0
    m.actuator_actadr[:] = -1  # the force follows the control
    return m, control
