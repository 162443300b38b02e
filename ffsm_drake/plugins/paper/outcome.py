"""The first screen of the pages: reproduced and missed claims of Table 2, and choices made here.

The figures belong to the setting ``euler``, the known part of the paper's simulation.
"""

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.common.numbers import rounded_up
from ffsm_drake.plugins.paper import paper
from ffsm_drake.plugins.paper.runs import CONTROLLERS, DISTURBANCES, STUDY
from ffsm_drake.plugins.paper.table import METRICS
from ffsm_drake.plugins.paper.wording import (
    DISTURBANCE_NAMES,
    NAMES,
    between,
    listed,
    named,
    percent,
    span,
)

# open points of the paper: point, choice, use of ISV for it
CHOICES: list[list[str]] = [
    [each["what"], each["chosen"], each["isv"]] for each in STUDY["choices"]
]
CHOICES_HEADER = ["left open by the paper", "chosen here", "was ISV used to choose it?"]


def outcome(rows: pd.DataFrame) -> dict[str, list[str]]:
    """Sentences on the ``reproduced`` and ``not reproduced`` figures of a table's rows."""
    shown = rows[rows["setting"] == "euler"]
    checks = [check(metric, shown) for metric in METRICS for check in (_values, _ranking)]
    found: dict[str, list[str]] = {"reproduced": [], "not reproduced": []}
    for holds, sentence in (*checks, _differences(shown)):
        found["reproduced" if holds else "not reproduced"].append(sentence)
    return found


def outcome_text(rows: pd.DataFrame) -> str:
    """The outcome and the choices, as plain text."""
    lines = list[str]()
    for kind, sentences in outcome(rows).items():
        lines += [f"{kind.capitalize()}:", *(f"  {each}" for each in sentences)]
    lines += ["Chosen here:"]
    lines += [f"  {what}: {chosen} (ISV used: {isv})" for what, chosen, isv in CHOICES]
    return "\n".join(lines)


def _values(metric: str, rows: pd.DataFrame) -> tuple[bool, str]:
    """Whether the values are the paper's, and how far they are from them."""
    ratios = rows[f"{metric}_ratio"]
    off = (ratios - 1.0).abs().max(skipna=False)
    if off <= paper.REPRODUCED:  # false for NaN, where a run diverged
        return (
            True,
            f"{METRICS[metric]}: all {len(ratios)} values within {percent(rounded_up(off, 2))}.",
        )
    return False, f"{METRICS[metric]}: the values are {span(ratios, 2)} times the paper's."


def _ranking(metric: str, rows: pd.DataFrame) -> tuple[bool, str]:
    """Whether the order of the controllers is the paper's, and who changes places where."""
    ours, printed = rows[f"{metric}_rank"], rows[f"{metric}_paper_rank"]
    moved = rows[ours != printed].groupby("disturbance", sort=False)["controller"]
    label = METRICS[metric]
    everywhere = f"all {len(DISTURBANCES)} disturbances"
    if not moved.ngroups:
        many = f"the {len(CONTROLLERS)} controllers"
        return True, f"{label}: the ranking of {many}, under {everywhere}."
    alike: dict[str, list[str]] = {}
    for disturbance, names in moved:
        alike.setdefault(listed(names.map(NAMES)), []).append(DISTURBANCE_NAMES[disturbance])
    parts = [
        f"{names} change places under "
        + (everywhere if len(places) == len(DISTURBANCES) else listed(places))
        for names, places in alike.items()
    ]
    return False, f"{label}: the ranking; {'; '.join(parts)}."


def beyond_tdc(rows: pd.DataFrame, figure: str) -> dict[str, list[float]]:
    """ISV minus that of TDC, by controller, under each disturbance; ``figure``: mean or paper."""
    isv = rows.pivot(index="disturbance", columns="controller", values=f"isv_{figure}")
    return {name: list(isv[name] - isv["tdc"]) for name in CONTROLLERS if name != "tdc"}


def differences_text(by_controller: dict[str, list[float]]) -> str:
    """``beyond_tdc`` in words."""
    return named(by_controller, _signed)


def _signed(values: list[float]) -> str:
    return between(values, "{:+.1f}".format)


def _differences(rows: pd.DataFrame) -> tuple[bool, str]:
    """Whether the efforts beyond TDC's are the paper's, by controller."""
    ours, printed = (beyond_tdc(rows, figure) for figure in ("mean", "paper"))
    holds = all(
        np.allclose(values, printed[name], rtol=paper.REPRODUCED, atol=0.0)
        for name, values in ours.items()
    )
    texts = {
        name: f"{_signed(values)} (paper: {_signed(printed[name])})"
        for name, values in ours.items()
    }
    return holds, f"ISV minus the ISV of TDC: {named(texts, str)}."
