"""The report's section on the grasp of a moving target: what it did, and the momentum on both sides
of it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.common.numbers import number
from ffsm_drake.plugins.capture.momentum import momentum_lines
from ffsm_drake.plugins.capture.tables import facts_of
from ffsm_drake.show.page import Section, render
from ffsm_drake.show.results import Result

_LEDGER = (
    ("linear_momentum", "Linear momentum", "N s"),
    ("angular_momentum", "Angular momentum about the world's origin", "N m s"),
    ("spin", "Angular momentum about the centre of mass", "N m s"),
)


def grasp_section(results: Sequence[Result]) -> Section | None:
    """The grasps of the runs; None without any."""
    grasps = [grasp for result in results if (grasp := grasp_of(result)) is not None]
    if not grasps:
        return None
    content = {"grasps": grasps, "several": len(results) > 1}
    html = render("grasp.html.j2", content, package="ffsm_drake.plugins.capture")
    return Section(html=html)


def grasp_of(result: Result) -> dict[str, Any] | None:
    """The sentence and the tables of a run's grasp; None for a run without."""
    grasp, record = result.record.grasp, result.record
    if grasp is None:
        return None
    before, after = grasp["before"], grasp["after"]
    rows = []
    for key, title, unit in _LEDGER:
        change = float(np.linalg.norm(np.subtract(after[key], before[key])))
        rows.append(
            [f"{title} [{unit}]", _vector(before[key]), _vector(after[key]), number(change, 2)]
        )
    if stored := grasp.get("stored_momentum"):
        rows.append(
            ["Stored in actuators, in addition [N m s]", _vector(stored), _vector(stored), "0"]
        )
    lost = before["kinetic_energy"] - after["kinetic_energy"]
    rows.append(
        [
            "Kinetic energy [J]",
            number(before["kinetic_energy"]),
            number(after["kinetic_energy"]),
            number(lost),
        ]
    )
    rates = [
        [f"{name} [{result.units[name]}/s]", number(rate), number(after["velocity"][name])]
        for name, rate in before["velocity"].items()
    ]
    sentence = "; ".join(facts_of(grasp))
    return {
        "result": result,
        "sentence": sentence[:1].upper() + sentence[1:],
        "budget": [
            line[:1].upper() + line[1:] for line in momentum_lines(grasp.get("momentum_budget"))
        ],
        "ledger": rows,
        "rates": rates,
        "phases": _phases(record.metrics.get("phases", {})),
    }


def _vector(values: list[float]) -> str:
    return ", ".join(number(value) for value in values)


def _phases(phases: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """Accuracy and effort by phase, a row each."""
    groups = ("base_position", "base_rotation", "joints")
    return [
        [name, number(figures["isv"])]
        + [
            number(figures[key][group], 3)
            for key in ("peak_effort", "final_error")
            for group in groups
        ]
        for name, figures in phases.items()
    ]
