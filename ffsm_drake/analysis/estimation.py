"""Time-delay estimation, judged after the run: its error, its bound, and the condition (8) that is said to bound it."""

import dataclasses

import numpy as np

from ffsm_drake.design.stability.sampled_loop import inertia_ratios
from ffsm_drake.spacecraft.nominal import PlantModel


def mass_matrices(model: PlantModel, positions: np.ndarray) -> np.ndarray:
    """The mass matrix at each of the configurations (n, nq): (n, nv, nv)."""
    size = len(model.coordinates.names)
    return np.array([model.calc_mass_matrix(q) for q in positions]).reshape(-1, size, size)


def commanded_acceleration(
    *, effort: np.ndarray, measured_velocity: np.ndarray, nominal_mass_matrix: np.ndarray, period: float
) -> np.ndarray:
    """The injected dynamics u_k (n, nv) that gave the recorded force, from equation (6) solved for u, per s^2.

    u_k = (v_k - v_{k-1}) / L + Hhat_k^-1 (tau_k - tau_{k-1}). As in the controller, the first sample has no past: its
    acceleration and the force before it are zero.

    Args:
      effort: tau held from t_k (n, nv).
      measured_velocity: v as the controller reads it (n, nv).
      nominal_mass_matrix: Hhat at the measured configurations (n, nv, nv).
      period: L, s.
    """
    change = np.diff(effort, axis=0, prepend=np.zeros_like(effort[:1]))
    acceleration = np.diff(measured_velocity, axis=0, prepend=measured_velocity[:1]) / period
    return acceleration + np.linalg.solve(nominal_mass_matrix, change[..., None])[..., 0]


def estimation_error(*, velocity: np.ndarray, commanded: np.ndarray, period: float) -> np.ndarray:
    """TDE error Ntilde = N - Nhat (n - 1, nv) of each period: the mean true acceleration minus the commanded one.

    From (2), (5) and (6), N - Nhat = q'' - u, which is what equation (7) calls the disturbance of ds/dt.

    Args:
      velocity: true v (n, nv).
      commanded: u of ``commanded_acceleration`` (n, nv).
      period: L, s.
    """
    return np.diff(velocity, axis=0) / period - commanded[:-1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class InertiaMatch:
    """How well Hhat matches H at one posture or at several (leading axis n)."""

    eta: np.ndarray  # eigenvalues of H^-1 Hhat, ascending (n, nv): free of units; > 1 is an over-estimated inertia
    norm: np.ndarray  # ||E - H^-1 Hhat||_2 of equation (8), for the given unit of length (n)

    @property
    def norm_in_h(self) -> np.ndarray:
        """The same norm in the metric of H, sup |(E - H^-1 Hhat) x|_H / |x|_H = max |1 - eta|: free of units (n)."""
        return np.abs(1.0 - self.eta).max(axis=-1, initial=0.0)


def match_inertia(
    true: np.ndarray, nominal: np.ndarray, *, is_length: np.ndarray, unit_of_length: float = 1.0
) -> InertiaMatch:
    """Compare mass matrices H and Hhat (n, nv, nv).

    Args:
      is_length: which coordinates are lengths rather than angles (nv); equation (8) depends on their unit.
      unit_of_length: the unit, in m, that lengths are expressed in for the norm of (8).
    """
    size = true.shape[-1]
    eta = [inertia_ratios(actual, believed) for actual, believed in zip(true, nominal, strict=True)]
    # A length of x metres is x / unit in the new unit.
    scale = np.where(is_length, 1.0 / unit_of_length, 1.0)
    difference = np.eye(size) - np.linalg.solve(true, nominal)
    norm = np.linalg.norm(difference * scale[:, None] / scale, ord=2, axis=(1, 2))
    return InertiaMatch(eta=np.array(eta).reshape(-1, size), norm=norm)


def start_up_time(period: float) -> float:
    """How long the start-up transient is taken to last, s: 0.1 s, or ten samples where those are longer.

    At the first sample the controller has no past, so that Nhat is 0 whatever N is; with the published gains the
    slowest pole this excites is about -0.74 per sample, which ten samples bring down to 5 %.
    """
    return max(0.1, 10.0 * period)
