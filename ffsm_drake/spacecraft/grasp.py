"""The grasp of a moving target in numbers; the capture's plug-in computes it."""

import dataclasses

import numpy as np

from ffsm_drake.spacecraft.coordinates import StateSplit


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grasp:
    """Effect of a grasp; world axes, rad, m, s, N s, N m s, J."""

    velocity: np.ndarray  # (nv) v+ of the servicer that holds the target
    impulse: np.ndarray  # (6) on the target: angular about the frame's origin P, then linear
    brake_impulse: np.ndarray  # (nv) of the brakes on the coordinates; zero without brakes
    energy_before: float
    energy_after: float
    momentum_before: np.ndarray  # (6) of both: angular about the base's origin, then linear
    momentum_after: np.ndarray


def shift_moment(momentum_or_impulse: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Return a momentum or impulse (6; angular, linear) about a point ``offset`` (3, m) away."""
    shifted = momentum_or_impulse.copy()
    shifted[:3] -= np.cross(offset, momentum_or_impulse[3:])
    return shifted


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompliantGrasp:
    """A grasp through springs and dampers, in a fixed configuration."""

    peak_force: float  # N
    peak_torque: float  # N m
    peak_stretch: float  # m; of the gripper
    # s; until 1 % of the lost energy is left between gripper and target
    time: float
    # (6) on the target, about the gripper's point: angular, linear; as in the plastic grasp
    impulse: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Contact:
    """A grasp, with the motion before and after it; world axes, SI units.

    q and v are the plant's own and include its flexible parts.
    """

    q: np.ndarray  # (nq)
    velocity: np.ndarray  # (nv) of the servicer before the grasp
    target_velocity: np.ndarray  # (6) of the target's frame P before: angular, linear
    grasp: Grasp
    # (6) on the target, angular about the hand's origin, then linear, N m s and N s
    impulse: np.ndarray
    # (6) of both, angular about the world's origin, then linear, N m s and N s
    momentum_before: np.ndarray
    momentum_after: np.ndarray
    spin_before: np.ndarray  # (3) angular momentum of both about their centre of mass, N m s
    spin_after: np.ndarray
    compliant: CompliantGrasp | None  # with a compliance of the gripper
    split: StateSplit


def plastic_impact(
    mass_matrix: np.ndarray, constraints: np.ndarray, velocity: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The velocity v+ (nv) just after constraints A v+ = 0 act, M v+ = M v + A' lambda, and the
    impulses lambda (m).

    Args: M (nv, nv); A (m, nv); v (nv).
    """
    inverse = np.linalg.solve(mass_matrix, constraints.T)
    impulses = np.linalg.solve(constraints @ inverse, -constraints @ velocity)
    return velocity + inverse @ impulses, impulses
