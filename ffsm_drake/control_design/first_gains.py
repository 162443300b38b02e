"""Starting gains of the shipped controllers for a spacecraft, from one natural frequency w per coordinate group."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ffsm_drake.spacecraft.coordinates import Coordinates

# Natural frequencies to start from, rad/s.
OMEGA = {"base_rotation": 15.0, "base_position": 10.0, "joints": 20.0}
# Largest k_d L of PD+ in the coupled loop; at 2 the sampled loop is unstable.
_PD_PLUS_DAMPING = 0.8


def starting_gains(
    omega: Mapping[str, float], *, coordinates: Coordinates, mass_matrices: np.ndarray, sample_time: float
) -> dict[str, dict[str, Any]]:
    """Gains of every shipped controller: controller -> gain -> value by coordinate.

    For accelerations K_P = w^2 and K_D = 2 w, for PD+ these times the inertia of each coordinate.

    Args:
      omega: natural frequency of each group, rad/s.
      mass_matrices: of the true spacecraft along the motion (m, nv, nv).
      sample_time: L, s.
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
        "pd_plus": _pd_plus(coordinates.vector(omega, key="omega"), coordinates, mass_matrices, sample_time),
    }


def _pd_plus(
    omega: np.ndarray, coordinates: Coordinates, mass_matrices: np.ndarray, sample_time: float
) -> dict[str, dict[str, float]]:
    """Forces per error. PD+ does not decouple the coordinates, so w falls until the coupled loop is well damped."""
    inertia = np.min([effective_inertia(each) for each in mass_matrices], axis=0)
    rates = [np.linalg.eigvals(np.linalg.solve(each, np.diag(2.0 * omega * inertia))).real for each in mass_matrices]
    omega = omega * min(1.0, _PD_PLUS_DAMPING / (sample_time * np.max(rates)))
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
