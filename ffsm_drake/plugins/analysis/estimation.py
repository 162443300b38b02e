"""Bound of the error of time-delay estimation, computed after the run."""

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence
from ffsm_drake.plugins.analysis.findings import Finding, finding, not_applicable


def findings(run: Evidence) -> list[Finding]:
    """``tde_error_bound``."""
    if run.too_short:
        return not_applicable(run.too_short, "tde_error_bound")
    bounds = {"bound": run.bound, "bound_late": run.late_bound}
    run.add(tde_error=run.tde_error, tde_error_bound=run.bound, tde_error_bound_late=run.late_bound)
    worst = int(run.bound.argmax())
    numbers: dict[str, float | str] = {
        "start_up_time": run.start_up_time,
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
