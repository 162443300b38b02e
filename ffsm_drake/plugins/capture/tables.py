"""Lines below the table of results: grasps, and the momentum after them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ffsm_drake.common.numbers import short
from ffsm_drake.plugins.capture.momentum import momentum_lines


def grasp_lines(grasps: Sequence[tuple[str, Mapping[str, Any]]]) -> Iterator[str]:
    """Lines for each grasp (``RunRecord.grasp``), after the words that name its run, and lines on
    the momentum of the plan, common to all.
    """
    yield from (words + line for words, grasp in grasps for line in facts_of(grasp))
    for _, grasp in grasps[:1]:
        yield from momentum_lines(grasp.get("momentum_budget"))


def facts_of(grasp: Mapping[str, Any]) -> list[str]:
    """Return the grasp of a run (``RunRecord.grasp``) in one or two lines."""
    size = {key: math.hypot(*grasp[key]) for key in ("impulse", "angular_impulse")}
    before, after = (grasp[side]["kinetic_energy"] for side in ("before", "after"))
    brakes = max(map(abs, grasp["brake_impulse"].values()), default=0.0)
    miss, compliant = grasp["miss"], grasp["compliant"]
    found = [
        f"grasp at t = {grasp['time']:g} s: impulse {short(size['impulse'])} N s and "
        f"{short(size['angular_impulse'])} N m s"
        + (f", brake at most {short(brakes)} N m s" if brakes else "")
        + f", kinetic energy {short(before, 4)} to {short(after, 4)} J; error "
        f"{short(1e3 * miss['position'], 2)} mm, {short(1e3 * miss['angle'], 2)} mrad, "
        f"{short(1e3 * miss['velocity'], 2)} mm/s, "
        f"{short(1e3 * miss['angular_velocity'], 2)} mrad/s"
    ]
    if compliant:
        found.append(
            f"largest load of the gripper: {short(compliant['peak_force'])} N and "
            f"{short(compliant['peak_torque'])} N m, within {short(1e3 * compliant['time'])} ms"
        )
    return found
