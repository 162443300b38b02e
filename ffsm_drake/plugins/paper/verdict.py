"""Claims, verdicts, and helpers to evaluate them.

Every number in a verdict is computed from the results, and the verdict follows from the numbers.
Of the settings (``runs.SETTINGS``), ``euler`` is the paper's own simulation and ``bounded`` the
exactly integrated plant with the proposed controller's K_s bounded: the two where every controller
completes.
"""

import dataclasses
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.plugins.paper.runs import Results, Side
from ffsm_drake.plugins.paper.table import make_table

Kind = Literal["holds", "holds only", "does not hold", "not reproduced", "not tested"]
Topic = Literal[
    "Accuracy",
    "Effort and chattering",
    "Comparison of the schemes",
    "Stability and robustness",
    "Theory",
]
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Verdict:
    """A claim with its verdict."""

    topic: Topic
    claim: str  # in our words
    place: str  # section, equation or table of the paper
    measured: str  # sentences with the numbers
    kind: Kind
    condition: str = ""  # completes the kind, such as "without measurement noise"

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        return f"{self.kind} {self.condition}".strip()


Ruling = tuple[Kind, str]  # kind and condition of a verdict
Evaluated = tuple[str, Ruling]  # the measurement in words, and the ruling
Evaluation = Callable[[Results], Evaluated]


@dataclasses.dataclass(frozen=True)
class Claim:
    """One claim of the paper; calling it with the results gives the verdict."""

    topic: Topic
    claim: str
    place: str
    evaluate: Evaluation

    def __call__(self, results: Results) -> Verdict:
        measured, (kind, condition) = self.evaluate(results)
        return Verdict(self.topic, self.claim, self.place, measured, kind, condition)


def claims_about(topic: Topic) -> Callable[[str, str], Callable[[Evaluation], Claim]]:
    """A decorator ``claim(text, place)`` that turns an evaluation function into a claim."""
    return lambda text, place: lambda evaluate: Claim(topic, text, place, evaluate)


def holds_if(good: bool) -> Ruling:
    return ("holds", "") if good else ("does not hold", "")


def in_both(euler: bool, exact: bool) -> Ruling:
    """The verdict on a claim that is evaluated in both settings."""
    if euler != exact:
        settings = (
            "with explicit Euler at the control period, not with exact integration of a held force",
            "with exact integration of a held force, not with explicit Euler at the control period",
        )
        return "holds only", settings[0] if euler else settings[1]
    return holds_if(euler)


@dataclasses.dataclass(frozen=True)
class Both(Generic[T]):
    """A quantity in both settings."""

    euler: T
    bounded: T

    def text(self, write: Callable[[T], str]) -> str:
        return (
            f"with explicit Euler {write(self.euler)}; with exact integration and K_s bounded "
            f"{write(self.bounded)}"
        )

    def pair(self, write: Callable[[T], str]) -> str:
        """Both values in this order, for a sentence that has named the settings."""
        return f"{write(self.euler)} and {write(self.bounded)}"

    def ruling(self, good: Callable[[T], bool]) -> Ruling:
        return in_both(good(self.euler), good(self.bounded))


def both(measure: Callable[[str], T]) -> Both[T]:
    """``measure(setting)`` in both settings."""
    return Both(measure("euler"), measure("bounded"))


def ratios_in_both(results: Results, metric: str, over: Side, under: Side) -> Both[list[float]]:
    return both(lambda setting: results.ratios(metric, setting, over, under))


def table_rows(results: Results, setting: str) -> pd.DataFrame:
    rows = make_table(results)
    return rows[rows["setting"] == setting]
