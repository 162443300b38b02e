"""Checks of the theory on a recorded run, for any controller.

``analyze(record)`` analyses a run that ended early up to its last finite sample. Nothing here runs
during a simulation.
"""

from typing import TYPE_CHECKING

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.analysis.findings import TITLES, Analysis, Finding

if TYPE_CHECKING:
    from ffsm_drake.runs.record import RunRecord

__all__ = ["Analysis", "Finding", "analyze"]


@step("checking the theory")
def analyze(record: "RunRecord") -> Analysis:
    """Evaluate every finding of the theory on a run, also on a run that ended early.

    A finding that does not apply has the reason.

    Example:
      >>> from ffsm_drake import analyze, load_scenario, simulate
      >>> record = simulate(load_scenario("postcapture", ["duration=0.5"]))
      >>> [each.key for each in analyze(record).findings if "momentum" in each.key]
      ['momentum_balance']
    """
    # slow to import, and the command's help needs none of them
    from ffsm_drake.plugins.analysis import (
        balances,
        chattering,
        estimation,
        inertia,
        lyapunov,
        sliding_mode,
    )
    from ffsm_drake.plugins.analysis.evidence import Evidence

    run = Evidence(record)
    subjects = (inertia, estimation, sliding_mode, lyapunov, chattering, balances)
    found = {finding.key: finding for subject in subjects for finding in subject.findings(run)}
    return Analysis(findings=tuple(found[key] for key in TITLES), series=run.dataset())
