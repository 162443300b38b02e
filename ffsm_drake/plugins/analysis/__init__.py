"""Checks of the theory on a recorded run, for any controller.

``analyze(record)`` analyses a run that ended early up to its last finite sample. Nothing here runs
during a simulation.
"""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

from ffsm_drake.common.steps import step
from ffsm_drake.plugins.analysis.findings import TITLES, Analysis, Evaluated, Finding, evaluated

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
    functions: dict[str, Callable[[Evidence], Evaluated]] = {
        "condition_8": inertia.condition_8,
        "tde_error_bound": estimation.tde_error_bound,
        "reaching_law": sliding_mode.reaching_law,
        "lyapunov_derivative": lyapunov.derivative,
        "ultimate_bound": lyapunov.ultimate,
        "direct_bound": sliding_mode.direct,
        "lemma_1_premise": lyapunov.premise,
        "lemma_1_conclusion": lyapunov.conclusion,
        "switching_gain_bound": sliding_mode.switching_gain,
        "chattering": chattering.chattering,
        "momentum_balance": balances.momentum,
        "energy_balance": balances.energy,
    }
    found = [evaluated(key, functools.partial(functions[key], run)) for key in TITLES]
    return Analysis(findings=tuple(found), series=run.dataset())
