"""Inertia matrices: as Drake's types, and how two of them compare."""

import numpy as np
from pydrake.multibody.tree import RotationalInertia, SpatialInertia, UnitInertia

# Indices of Ixx, Iyy, Izz, Ixy, Ixz, Iyz in a matrix.
SIX = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
ROUNDING = 1e-9  # relative; an excess of the largest principal moment below it is no fault
_EXACT = 1e-15  # relative; below the tolerance of Drake


def without_rounding(matrix: np.ndarray) -> np.ndarray:
    """A symmetric matrix (3, 3) with the least principal moment raised where the largest exceeds
    the sum of the others by no more than ROUNDING.
    """
    moments, axes = np.linalg.eigh(matrix)
    excess = moments[2] - moments[1] - moments[0]
    if _EXACT < excess / max(moments[2], 1e-300) <= ROUNDING:
        matrix = matrix + excess * np.outer(axes[:, 0], axes[:, 0])
    return matrix


def rotational_inertia(matrix: np.ndarray) -> RotationalInertia:
    """The inertia of a symmetric matrix (3, 3), kg m^2. Raises RuntimeError: it is not physical."""
    return RotationalInertia(*without_rounding(matrix)[SIX])


def spatial_inertia_about(mass: float, center: np.ndarray, matrix: np.ndarray) -> SpatialInertia:
    """M_PPo from the mass, kg, the centre of mass p_PoPcm (3), m, and the inertia about Po (3, 3).

    Raises RuntimeError: it is not physical.
    """
    return SpatialInertia(
        mass=mass, p_PScm_E=center, G_SP_E=UnitInertia(rotational_inertia(matrix) / mass)
    )


def inertia_ratios(true_mass_matrix: np.ndarray, nominal_mass_matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues eta of H^-1 Hhat, ascending (nv); above 1 the inertia is over-estimated.

    They have no units, since both matrices have the same.
    """
    scale = np.linalg.inv(np.linalg.cholesky(true_mass_matrix))
    return np.linalg.eigvalsh(scale @ nominal_mass_matrix @ scale.T)
