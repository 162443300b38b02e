"""How far the hidden coordinates of a run move, and what is left of it once the planned motion is
over.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ffsm_drake.runs.rollout import RunLog
    from ffsm_drake.runs.table import Labelled

_AT_REST = 1e-9  # rad/s or m/s; below any planned motion


def deflection_metrics(dataset: "Labelled") -> dict[str, Any]:
    """How far the hidden coordinates moved, as plain numbers by name; empty for a run without.

    Keys:
      peak: the largest deflection of each, rad or m.
      residual_since: s; when the reference comes to rest, None where it does not before the run's
        last sample.
      residual_rms, residual_amplitude: of each from then on, rad or m: the root of the mean square
        about the mean, and half the distance from the least to the largest; None where the
        reference does not come to rest.
    """
    if "hidden_position" not in dataset:
        return {}
    names = dataset["hidden_coordinate"].values.astype(str).tolist()
    time, deflection = dataset["time"].values, dataset["hidden_position"].values
    first = first_at_rest(dataset["desired_velocity"].values)
    residual, ends = deflection[first:], first < time.size - 1

    def by_name(values: np.ndarray) -> dict[str, float]:
        return dict(zip(names, values.tolist(), strict=True))

    return {
        "peak": by_name(np.abs(deflection).max(axis=0)),
        "residual_since": float(time[first]) if ends else None,
        "residual_rms": by_name(residual.std(axis=0)) if ends else None,
        "residual_amplitude": by_name(np.ptp(residual, axis=0) / 2.0) if ends else None,
    }


def largest_deflections(log: "RunLog", unit: str) -> tuple[float, float]:
    """Of a run's hidden coordinates with a unit: the largest deflection, and the largest residual
    amplitude.

    NaN where there is none: of the second where the reference does not come to rest before the last
    sample.
    """
    members = [i for i, other in enumerate(log.hidden.units) if other == unit]
    if not members:
        return np.nan, np.nan
    deflection = log.series["hidden_state"][:, members]
    first = first_at_rest(log.series["desired_state"][:, len(log.coordinates.position_names) :])
    residual = deflection[first:]
    left = float(np.ptp(residual, axis=0).max() / 2.0) if len(residual) > 1 else np.nan
    return float(np.abs(deflection).max()), left


def first_at_rest(velocity: np.ndarray) -> int:
    """The sample from which a reference's velocity (n, nv) stays zero; n where it does not."""
    moving = np.flatnonzero((np.abs(velocity) > _AT_REST).any(axis=1))
    return int(moving[-1]) + 1 if moving.size else 0


def deflection_units(kinds: Sequence[str]) -> tuple[str, ...]:
    """The units of the hidden coordinates of parts of these kinds (``Flexible.kind``)."""
    return tuple(dict.fromkeys("m" if kind in ("mass", "beam") else "rad" for kind in kinds))
