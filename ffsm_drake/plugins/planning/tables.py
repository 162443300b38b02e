"""A plan as plain text, and its figures as plain data."""

import dataclasses
from typing import Any

from ffsm_drake.common.numbers import NONE, number, percent
from ffsm_drake.plugins.planning.planned_report import PlannedMotionReport
from ffsm_drake.show.tables import aligned


def plan_table(found: PlannedMotionReport) -> str:
    """Duration and effort of a plan, and its margin to each limit, as plain text."""
    plan = found.plan
    after = f", and {plan.settle:g} s more for the remaining rates" if plan.settle > 0.0 else ""
    lines = [
        f"At rest after {plan.duration:.3f} s{after}; {found.evaluations} evaluations in "
        f"{found.solve_time:.1f} s",
        f"Angular momentum about the centre of mass: {number(found.angular_momentum)} N m s at "
        "the start, "
        f"{number(found.momentum_left)} at {plan.duration:.3f} s"
        + (
            f"; base torque alone takes at least {found.least_by_torque:.2f} s"
            if found.least_by_torque > 0.0
            else ""
        ),
        f"Integral of the squared force (ISV): {number(found.effort)}; impulses: base torque "
        f"{number(found.impulse['base_rotation'])} N m s, base force "
        f"{number(found.impulse['base_position'])} N s, "
        f"joints {number(found.impulse['joints'])}",
        *(
            []
            if found.base_turn is None
            else [f"Momentum turns the base by up to {number(found.base_turn)} rad"]
        ),
        "",
    ]
    rows = [["", "nearest to the limit", "limit", "used", "at"]]
    for margin in found.margins:
        share = (
            NONE
            if margin.quantity in ("clearance", "position")
            else percent(abs(margin.value / margin.limit))
        )
        rows.append(
            [
                f"{margin.quantity} {margin.name}", f"{margin.value:.4g} {margin.unit}",
                f"{margin.limit:.4g} {margin.unit}", share, f"{margin.time:.2f} s",
            ]
        )  # fmt: skip
    return "\n".join(lines + aligned(rows))


def plan_data(found: PlannedMotionReport) -> dict[str, Any]:
    """Return the text of the plan as plain data."""
    return {
        "duration": found.plan.duration,
        "settle": found.plan.settle,
        "solve_time": found.solve_time,
        "evaluations": found.evaluations,
        "isv": found.effort,
        "impulse": found.impulse,
        "angular_momentum": found.angular_momentum,
        "angular_momentum_left": found.momentum_left,
        "least_by_torque": found.least_by_torque,
        "base_turn": found.base_turn,
        "margins": [dataclasses.asdict(margin) | {"kept": margin.kept} for margin in found.margins],
    }
