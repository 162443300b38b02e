"""The grasp by a compliant gripper, in a fixed configuration."""

from collections.abc import Sequence

import numpy as np

from ffsm_drake.spacecraft.grasp import CompliantGrasp


def compliant_grasp(
    *,
    mass_matrix: np.ndarray,
    jacobian: np.ndarray,
    target_inertia: np.ndarray,
    velocity: np.ndarray,
    target_velocity: np.ndarray,
    stiffness: np.ndarray,
    damping: np.ndarray,
    braked: Sequence[int] = (),
) -> CompliantGrasp:
    """Peak force and duration of a grasp by a compliant gripper.

    The offset d between target and gripper, with rate d' = V - J v, follows in a fixed
    configuration d'' = -(M_T^-1 + J M_s^-1 J^T) (K d + D d'). Braked joints do not move.

    Args: as ``plastic_grasp``, but with P at the gripper, and
      stiffness, damping: diagonals of K (6; N m/rad, N/m) and D (6; N m s/rad, N s/m), world axes;
        > 0.
    """
    free = np.setdiff1d(np.arange(velocity.size), braked)
    alone = (mass_matrix - jacobian.T @ target_inertia @ jacobian)[np.ix_(free, free)]
    J = jacobian[:, free]
    mobility = np.linalg.inv(target_inertia) + J @ np.linalg.solve(alone, J.T)
    start = target_velocity - J @ velocity[free]
    a = np.zeros((12, 12))
    a[:6, 6:], a[6:, :6], a[6:, 6:] = np.eye(6), -mobility * stiffness, -mobility * damping
    rates, modes = np.linalg.eig(a)
    weights = np.linalg.solve(modes, np.concatenate([np.zeros(6), start]))
    times = np.concatenate(
        [[0.0], np.geomspace(1e-3 / np.abs(rates).max(), 20.0 / -rates.real.max(), 4000)]
    )
    offset, speed = np.split((modes @ (weights[:, None] * np.exp(np.outer(rates, times)))).real, 2)
    force = stiffness[:, None] * offset + damping[:, None] * speed
    reduced = np.linalg.inv(mobility)
    energy = 0.5 * (
        (speed * (reduced @ speed)).sum(axis=0) + (stiffness[:, None] * offset**2).sum(axis=0)
    )
    over = np.flatnonzero(energy > 1e-2 * energy[0])
    return CompliantGrasp(
        peak_force=float(np.linalg.norm(force[3:], axis=0).max()),
        peak_torque=float(np.linalg.norm(force[:3], axis=0).max()),
        peak_stretch=float(np.linalg.norm(offset[3:], axis=0).max()),
        time=float(times[over[-1] + 1]) if over.size else 0.0,
        impulse=-reduced @ start,
    )
