"""Inertia matrices: as Drake's types, and how two of them compare."""

import math
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.multibody.tree import RotationalInertia, SpatialInertia, UnitInertia

from ffsm_drake.spacecraft.checked_urdf import number, require

# Indices of Ixx, Iyy, Izz, Ixy, Ixz, Iyz in a matrix.
SIX = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
ROUNDING = 1e-9  # relative; an excess of the largest principal moment below it is no fault
_EXACT = 1e-15  # relative; below the tolerance of Drake
MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def without_rounding(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix (3, 3) with the least principal moment raised where the largest
    exceeds the sum of the others by no more than ROUNDING.
    """
    moments, axes = np.linalg.eigh(matrix)
    excess = moments[2] - moments[1] - moments[0]
    if _EXACT < excess / max(moments[2], 1e-300) <= ROUNDING:
        matrix = matrix + excess * np.outer(axes[:, 0], axes[:, 0])
    return matrix


def mended_moments(inertia: Element, place: str) -> dict[str, str]:
    """Moments of an <inertia> that change when their rounding is removed (``without_rounding``)."""
    matrix = _matrix_of(inertia, place)
    if not np.isfinite(matrix).all():
        return {}
    both = (each[SIX].tolist() for each in (matrix, without_rounding(matrix)))
    moments = zip(MOMENTS, *both, strict=True)
    return {key: repr(value) for key, old, value in moments if value != old}


def mend(root: Element) -> bool:
    """Remove the rounding from the inertias of a URDF; whether there was any."""
    found = False
    for link in root.findall("link"):
        for inertia in link.findall("inertial/inertia"):
            moments = mended_moments(inertia, _place_of(link))
            inertia.attrib |= moments
            found |= bool(moments)
    return found


def read_inertia(link: Element) -> np.ndarray:
    """Inertia matrix (3, 3) of a link about its centre of mass, kg m^2; zero without <inertia>."""
    inertia = link.find("inertial/inertia")
    return _matrix_of(Element("inertia") if inertia is None else inertia, _place_of(link))


def _matrix_of(inertia: Element, place: str) -> np.ndarray:
    """Return the matrix (3, 3) of an <inertia>; zero for what it does not say."""
    matrix = np.zeros((3, 3))
    matrix[SIX] = matrix.T[SIX] = [number(inertia, key, place, "0") for key in MOMENTS]
    return matrix


def _place_of(link: Element) -> str:
    return f"link '{link.get('name', '')}'"


def read_mass(link: Element) -> float:
    """Mass of a link, kg; zero without <inertial>. Raises ModelError for a non-physical inertia."""
    place = _place_of(link)
    mass_element, matrix = link.find("inertial/mass"), read_inertia(link)
    mass = 0.0 if mass_element is None else number(mass_element, "value", place)
    require(0.0 <= mass < math.inf, f"{place}: mass {mass:g} kg must be positive")
    require(np.isfinite(matrix).all(), f"{place}: its inertia must be finite")
    require(
        mass or not matrix.any(),
        f"{place}: has inertia but no mass; give it both, or remove its <inertial>",
    )
    principal = np.linalg.eigvalsh(matrix)
    require(
        principal[0] + principal[1] >= principal[2] * (1.0 - ROUNDING),
        f"{place}: no body has the principal moments {', '.join(f'{p:.4g}' for p in principal)} kg "
        "m^2 (one is negative, or exceeds the sum of the others); correct its <inertia>",
    )
    return mass


def rotational_inertia(matrix: np.ndarray) -> RotationalInertia:
    """Return the inertia of a symmetric matrix (3, 3), kg m^2. Raises RuntimeError: it is not
    physical.
    """
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
