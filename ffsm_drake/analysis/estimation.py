"""Error of time-delay estimation and its bound, computed after the run."""

from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.analysis.findings import Finding, finding, not_applicable
from ffsm_drake.spacecraft.nominal import PlantModel

if TYPE_CHECKING:
    from ffsm_drake.analysis.evidence import Evidence


def mass_matrices(model: PlantModel, positions: np.ndarray) -> np.ndarray:
    """Mass matrices (n, nv, nv), apparent with hidden coordinates, at configurations (n, nq)."""
    size = len(model.coordinates.names)
    return np.array([model.calc_apparent_mass_matrix(q) for q in positions]).reshape(-1, size, size)


def commanded_acceleration(
    *,
    effort: np.ndarray,
    measured_velocity: np.ndarray,
    nominal_mass_matrix: np.ndarray,
    period: float,
) -> np.ndarray:
    """Injected dynamics u_k (n, nv) behind the recorded force: equation (6) solved for u, per s^2.

    u_k = (v_k - v_{k-1}) / L + Hhat_k^-1 (tau_k - tau_{k-1}). As in the controller, the first
    sample has no past: its acceleration and previous force are zero. ``effort`` is tau held from
    t_k (n, nv), ``measured_velocity`` v as the controller reads it (n, nv), ``nominal_mass_matrix``
    Hhat at the measured configurations (n, nv, nv).
    """
    change = np.diff(effort, axis=0, prepend=np.zeros_like(effort[:1]))
    acceleration = np.diff(measured_velocity, axis=0, prepend=measured_velocity[:1]) / period
    return acceleration + np.linalg.solve(nominal_mass_matrix, change[..., None])[..., 0]


def estimation_error(*, velocity: np.ndarray, commanded: np.ndarray, period: float) -> np.ndarray:
    """TDE error Ntilde = N - Nhat (n - 1, nv) of each period.

    That is the mean true acceleration minus the commanded one.

    From (2), (5) and (6), N - Nhat = q'' - u, which is what equation (7) calls the disturbance of
    ds/dt. ``velocity`` is the true v (n, nv), ``commanded`` the u of ``commanded_acceleration`` (n,
    nv).
    """
    return np.diff(velocity, axis=0) / period - commanded[:-1]


def start_up_time(period: float) -> float:
    """Duration of the start-up transient, s: 0.1 s or ten samples, whichever is longer.

    At the first sample the controller has no past, so Nhat is 0 whatever N is. With the published
    gains this excites a pole of about -0.74 per sample at the slowest, which decays to 5 % within
    ten samples.
    """
    return max(0.1, 10.0 * period)


def findings(run: "Evidence") -> list[Finding]:
    """``tde_error_bound``."""
    if run.too_short:
        return not_applicable(run.too_short, "tde_error_bound")
    bounds = {"bound": run.bound, "bound_late": run.late_bound}
    run.add(tde_error=run.tde_error, tde_error_bound=run.bound, tde_error_bound_late=run.late_bound)
    worst = int(run.bound.argmax())
    numbers: dict[str, float | str] = {
        "start_up_time": start_up_time(run.period),
        "worst_coordinate": run.coordinates.names[worst],
        "time_of_bound": float(run.time[np.abs(run.tde_error[:, worst]).argmax()]),
    }
    for name, values in bounds.items():
        numbers |= {
            name: float(values.max()),
            **run.grouped(name, values),
            **run.named(name, values),
        }
    statement = (
        "N* = {bound:.3g} ({worst_coordinate} at {time_of_bound:.3g} s)"
        + (
            "; after the first {start_up_time:g} s, {bound_late:.3g}"
            if run.outlasts_start_up
            else ""
        )
        + " (rad/s^2 or m/s^2)."
    )
    return [finding("tde_error_bound", statement, numbers)]
