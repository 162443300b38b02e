"""Services for the core: warnings before a run, and what ``ffsm validate`` says of a mission."""

import dataclasses
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from ffsm_drake.common.errors import ModelError
from ffsm_drake.plugins.capture.momentum import momentum_budget, momentum_lines
from ffsm_drake.plugins.design.remarks import plan_clearance, plan_remarks
from ffsm_drake.runs.simulate import LimitWarning, StabilityWarning
from ffsm_drake.scenario import Scenario


def preflight(scenario: Scenario, *, predicts: bool) -> Iterator[Warning]:
    """Warnings before a run: those of ``plan_remarks`` and, if it ``predicts``, of the ``verdict``
    without a rehearsal; errors as theirs.
    """
    yield from map(LimitWarning, plan_remarks(scenario))
    if predicts:
        from ffsm_drake.plugins.design.verdict import verdict  # SciPy is slow

        yield from map(StabilityWarning, verdict(scenario, rehearsal=False).warnings)


def mission(scenario: Scenario, *, rehearsal: bool) -> tuple[dict[str, Any], list[str]]:
    """The clearance of the plan, the momentum after a grasp, the verdict and all warnings: as plain
    data, and in lines without the warnings; errors as ``verdict``.
    """
    from ffsm_drake.plugins.design.verdict import verdict

    closest, budget = [], momentum_budget(scenario)
    with suppress(ModelError):  # already among the remarks
        closest = plan_clearance(scenario)
    remarks, found = plan_remarks(scenario), verdict(scenario, rehearsal=rehearsal)
    momentum = {} if budget is None else {"momentum_budget": dataclasses.asdict(budget)}
    data = {
        "nearest": [dataclasses.asdict(each) for each in closest],
        **momentum,
        "mission": found.as_data(),
        "warnings": [*remarks, *found.warnings],
    }
    return data, [*found.lines, found.conclusion, *momentum_lines(momentum.get("momentum_budget"))]
