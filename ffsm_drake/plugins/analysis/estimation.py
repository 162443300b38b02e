"""Bound of the error of time-delay estimation, computed after the run."""

from typing import Any

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence
from ffsm_drake.plugins.analysis.findings import Evaluated


def tde_error_bound(run: Evidence) -> Evaluated:
    """The largest errors, by coordinate and group."""
    bounds = {"bound": run.bound, "bound_late": run.late_bound}
    run.add(tde_error=run.tde_error, tde_error_bound=run.bound, tde_error_bound_late=run.late_bound)
    worst = int(run.bound.argmax())
    numbers: dict[str, Any] = {
        "start_up_time": run.start_up_time,
        "worst_coordinate": run.coordinates.names[worst],
        "time_of_bound": run.time[np.abs(run.tde_error[:, worst]).argmax()],
    }
    for name, values in bounds.items():
        numbers |= {name: values.max(), **run.grouped(name, values), **run.named(name, values)}
    late = "; after the first {start_up_time:g} s, {bound_late:.3g}" * run.outlasts_start_up
    statement = (
        "N* = {bound:.3g} ({worst_coordinate} at {time_of_bound:.3g} s)"
        + late
        + " (rad/s^2 or m/s^2)."
    )
    return "measured", statement, numbers
