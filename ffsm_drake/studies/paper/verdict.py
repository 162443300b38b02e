"""The form of a verdict on a claim, and what the claims have in common: ``Claim = f(results) -> Verdict``.

Every figure in a verdict is computed from the results, and so is the verdict itself. The setting ``euler`` is the
paper's own simulation, ``bounded`` the exactly integrated plant with the proposed controller's K_s bounded
(``runs.SETTINGS``).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

from ffsm_drake.studies.paper.runs import (
    CONTROLLERS,
    DISTURBANCES,
    Results,
)
from ffsm_drake.studies.paper.table import Row, make_table

Kind = Literal["holds", "holds only", "does not hold", "not reproduced"]
Topic = Literal["Accuracy", "Effort and chattering", "Comparison of the schemes", "Stability and robustness", "Theory"]

# What the paper's adverbs are taken to mean.
NEARLY_TENFOLD = 5.0  # "nearly one order of magnitude": at least this factor
SLIGHTLY = 0.05  # "slightly larger": by at most this share
NOTICEABLE = 0.02  # an effect below this share is none
REPRODUCED = 0.03  # a table's values are reproduced within this share
LOCALLY = 0.5  # "only locally": in less than this share of time and coordinates
PRECISELY = 1e-5  # "high precision": errors at the end below this, rad and m
ACCURATELY = 0.1  # "accurately estimated": within this share


@dataclasses.dataclass(frozen=True, kw_only=True)
class Verdict:
    """One claim and what became of it."""

    topic: Topic
    claim: str  # in our words
    place: str  # section, equation or table of the paper
    measured: str  # sentences with the figures
    kind: Kind
    condition: str = ""  # completes "holds only", such as "under explicit Euler integration"

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        return f"{self.kind} {self.condition}".strip()


Claim = Callable[[Results], Verdict]

_EULER_ONLY = "under explicit Euler integration at the control period"
_EXACT_ONLY = "on the exactly integrated plant"


def in_both(euler: bool, exact: bool) -> dict[str, Any]:
    """The verdict on a claim that can be told in both settings."""
    if euler and exact:
        return {"kind": "holds"}
    if euler or exact:
        return {"kind": "holds only", "condition": _EULER_ONLY if euler else _EXACT_ONLY}
    return {"kind": "does not hold"}


def comparisons(results: Results) -> list[tuple[str, int]]:
    """All (disturbance, seed) of the table."""
    return [(disturbance, seed) for disturbance in DISTURBANCES for seed in range(results.num_seeds)]


def metric_ratios(results: Results, metric: str, setting: str, over: str, under: str) -> list[float]:
    """A metric of one controller over that of another, by (disturbance, seed); infinite where the first diverged."""
    values = []
    for disturbance, seed in comparisons(results):
        first, second = (
            getattr(results.run(setting, name, disturbance=disturbance, seed=seed), metric) for name in (over, under)
        )
        values.append(first / second if math.isfinite(second) else math.nan)
    return values


def ranking(results: Results, metric: str, setting: str, disturbance: str, seed: int) -> list[str]:
    """Controllers from the smallest value to the largest."""
    return sorted(
        CONTROLLERS,
        key=lambda name: getattr(results.run(setting, name, disturbance=disturbance, seed=seed), metric),
    )


def table_rows(results: Results, setting: str) -> list[Row]:
    return [row for row in make_table(results) if row.setting == setting]
