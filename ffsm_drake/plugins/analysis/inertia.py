"""Condition (8): how well the nominal mass matrix matches the true one."""

import dataclasses

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence, mass_matrices
from ffsm_drake.plugins.analysis.findings import Evaluated, NotApplicable
from ffsm_drake.spacecraft.inertia import inertia_ratios

POSTURE_INTERVAL = 0.1  # s, between the postures where inertias are compared
UNITS_OF_LENGTH = {"centimetres": 0.01, "decimetres": 0.1, "metres": 1.0, "decametres": 10.0}


@dataclasses.dataclass(frozen=True, kw_only=True)
class InertiaMatch:
    """Match of Hhat and H at n configurations."""

    # eigenvalues of H^-1 Hhat, ascending (n, nv): dimensionless; > 1 if inertia is over-estimated
    eta: np.ndarray
    norm: np.ndarray  # ||E - H^-1 Hhat||_2 of equation (8), for the given unit of length (n)

    @property
    def norm_in_h(self) -> np.ndarray:
        """The norm of (8) in the metric of H, dimensionless (n).

        sup |(E - H^-1 Hhat) x|_H / |x|_H = max |1 - eta|.
        """
        return np.abs(1.0 - self.eta).max(axis=-1, initial=0.0)


def match_inertia(
    true: np.ndarray,
    nominal: np.ndarray,
    *,
    is_length: np.ndarray | None = None,
    unit_of_length: float = 1.0,
) -> InertiaMatch:
    """Compare mass matrices H and Hhat (n, nv, nv).

    Args:
      is_length: mask (nv) of the coordinates that are lengths, not angles; equation (8) depends on
        their unit, which is the metre without a mask.
      unit_of_length: unit of lengths in the norm of (8), in m.
    """
    size = true.shape[-1]
    eta = [inertia_ratios(*pair) for pair in zip(true, nominal, strict=True)]
    # A length of x metres is x / unit in the new unit.
    scale = np.ones(size) if is_length is None else np.where(is_length, 1.0 / unit_of_length, 1.0)
    difference = np.eye(size) - np.linalg.solve(true, nominal)
    norm = np.linalg.norm(difference * scale[:, None] / scale, ord=2, axis=(1, 2))
    return InertiaMatch(eta=np.array(eta).reshape(-1, size), norm=norm)


def condition_8(run: Evidence) -> Evaluated:
    """The match at postures POSTURE_INTERVAL apart, and at the last one."""
    if not run.time.size:
        raise NotApplicable("the record has no finite sample")
    every = max(1, round(POSTURE_INTERVAL / run.period))
    picked = np.union1d(np.arange(0, run.time.size, every), [run.time.size - 1])
    postures = run.values("position")[picked]
    true, nominal = mass_matrices(run.true, postures), mass_matrices(run.nominal, postures)
    is_length = np.array([unit == "m" for unit in run.coordinates.units])
    matches = {
        name: match_inertia(true, nominal, is_length=is_length, unit_of_length=metres)
        for name, metres in UNITS_OF_LENGTH.items()
    }
    match = matches["metres"]
    run.axes["posture_time"] = run.time[picked]
    run.axes["rank"] = np.arange(1, match.eta.shape[1] + 1)
    run.add(eta=match.eta, condition_8=match.norm, condition_8_in_h=match.norm_in_h)
    numbers = {
        "norm_min": match.norm.min(),
        "norm_max": match.norm.max(),
        "time_of_norm_max": run.time[picked][match.norm.argmax()],
        "eta_min": match.eta.min(),
        "eta_max": match.eta.max(),
        "norm_in_h_max": match.norm_in_h.max(),
        "postures": picked.size,
        **{f"norm_max_in.{name}": one.norm.max() for name, one in matches.items()},
    }
    statement = (
        "||E - H^-1 Hhat||_2 is at most {norm_max:.4g} in metres and radians, where 1 is the "
        "limit; the eigenvalues of "
        "H^-1 Hhat lie in [{eta_min:.4g}, {eta_max:.4g}]."
    )
    return bool(match.norm.max() < 1.0), statement, numbers
