"""Starting gains of the shipped controllers for a spacecraft, from one natural frequency w per coordinate group."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates

# Natural frequencies to start from, rad/s.
OMEGA = {"base_rotation": 15.0, "base_position": 10.0, "joints": 20.0}
_PD_PLUS_FACTOR = 2.0  # on the natural frequencies: PD+ estimates no disturbance, so it is stiffer


def starting_gains(
    omega: Mapping[str, float], *, coordinates: Coordinates, mass_matrices: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Gains of every shipped controller: controller -> gain -> value by coordinate.

    Args:
      omega: natural frequency of each group, rad/s.
      mass_matrices: of the true spacecraft along the motion (m, nv, nv).
    """

    def per_group(factor: float, power: int = 1) -> dict[str, float]:
        return {group: rounded(factor * w**power) for group, w in omega.items()}

    def linear() -> dict[str, Any]:
        return {"k_d": per_group(2.0), "k_p": per_group(1.0, 2)}

    def adaptive() -> dict[str, Any]:
        return {**linear(), "k_s_initial": per_group(1.0), "k_s_max": per_group(2.0)}

    return {
        "tdc": linear(),
        "asmc": {"k_d": per_group(1.0), "k_s": per_group(2.0)},
        "aismc": adaptive(),
        "tde_aismc": {**adaptive(), "g_max": 2e-3},
        "computed_torque": linear(),
        "pd_plus": _pd_plus(_PD_PLUS_FACTOR * coordinates.vector(omega, key="omega"), coordinates, mass_matrices),
    }


def _pd_plus(omega: np.ndarray, coordinates: Coordinates, mass_matrices: np.ndarray) -> dict[str, dict[str, float]]:
    """Forces per error: K_P = w^2 m and K_D = 2 w m with the smallest inertia m of each coordinate along the motion.

    PD+ does not decouple the coordinates, so that m is less than the effective inertia: with A = H^-1, it is
    1 / sum_j |A_ij| sqrt(A_ii / A_jj). Then no eigenvalue of H^-1 K_D exceeds the largest 2 w (sums over the rows of
    the scaled matrix), and the sampled loop is stable for 2 w L < 2.
    """
    inertia = np.full(omega.size, np.inf)
    for mass_matrix in mass_matrices:
        inverse = np.linalg.inv(mass_matrix)
        scale = np.sqrt(np.diagonal(inverse))
        inertia = np.minimum(inertia, 1.0 / (scale * (np.abs(inverse) / scale).sum(axis=1)))
    return {
        name: dict(zip(coordinates.names, map(rounded, values), strict=True))
        for name, values in (("k_d", 2.0 * omega * inertia), ("k_p", omega**2 * inertia))
    }


def effective_inertia(mass_matrix: np.ndarray) -> np.ndarray:
    """Force per acceleration of each coordinate (nv), the others free to react, kg m^2 or kg."""
    return 1.0 / np.diagonal(np.linalg.inv(mass_matrix))


def rounded(value: float) -> float:
    """A number with three digits, for files that people read."""
    return float(f"{value:.3g}")
