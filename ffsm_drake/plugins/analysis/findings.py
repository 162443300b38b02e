"""Result of an analysis: findings with their figures, and the curves behind them.

``docs/findings.md`` explains every finding: its source, computation, and when it does not apply.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import xarray as xr

Verdict = Literal["holds", "does not hold", "not tested", "not applicable", "measured"]
Numbers = Mapping[str, float | str]

# Key -> title of every finding, in the order of ``Analysis.findings``.
TITLES = {
    "condition_8": "Condition (8): ||E - H^-1 Hhat||_2 < 1",
    "tde_error_bound": "Bound N* on the TDE errors",
    "reaching_law": "Reaching law (7) over a sample",
    "lyapunov_derivative": "dV/dt <= 0 outside the vicinity of the manifold, (12) to (14)",
    "ultimate_bound": "Ultimate bound on ||s||_2, (16)",
    "direct_bound": "Bound on |s_i| from (7) alone",
    "lemma_1_premise": "Lemma 1, premise: beta_i ||s||_inf < N*",
    "lemma_1_conclusion": "Lemma 1, conclusion: K_si < N*",
    "switching_gain_bound": "Switching gain within G_i <= N*",
    "chattering": "Chattering of the control force",
    "momentum_balance": "Momentum balance",
    "energy_balance": "Energy balance",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finding:
    """One claim, or one figure of merit, evaluated on one run."""

    key: str  # a key of TITLES
    title: str
    statement: str  # one sentence with the main figures
    # "measured" for a figure of merit, "not tested" if the claim covers none of the samples
    verdict: Verdict
    # all figures; ``name.part`` belongs to a group or coordinate, NaN means undefined in this run
    numbers: Numbers

    @property
    def holds(self) -> bool | None:
        """True if the claim holds on this run; None if it does not apply or there is no claim."""
        return {"holds": True, "does not hold": False}.get(self.verdict)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Analysis:
    """All findings of a run, and the curves behind them.

    ``series`` is an xarray Dataset along ``time`` (samples t_k), ``period`` (start times t_k of the
    periods), ``posture_time``, ``frequency`` and ``coordinate``. It holds the series that apply to
    the run, with units and meaning.
    """

    findings: tuple[Finding, ...]
    series: "xr.Dataset"

    def __str__(self) -> str:
        """Return the findings as plain text, one paragraph each."""
        return "\n".join(
            f"[{item.verdict}] {item.title}\n    {item.statement}" for item in self.findings
        )

    def finding(self, key: str) -> Finding:
        """Return the finding with a key. Raises KeyError naming the valid keys."""
        for finding in self.findings:
            if finding.key == key:
                return finding
        raise KeyError(f"no finding '{key}'; choose one of {', '.join(TITLES)}")


class NotApplicable(Exception):
    """Reason why a finding does not apply to a run."""


# What a finding's function returns: whether the claim holds, "not tested" or "measured"; a format
# string over the numbers; the numbers.
Evaluated = tuple[bool | Verdict, str, Mapping[str, Any]]


def evaluated(key: str, evaluate: Callable[[], Evaluated]) -> Finding:
    """Return the finding of a function, or the reason why it does not apply."""
    numbers: Numbers = {}
    try:
        verdict, statement, found = evaluate()
    except NotApplicable as reason:
        verdict, statement = "not applicable", f"Not applicable: {reason}."
    else:
        numbers = {
            name: value if isinstance(value, str) else float(value) for name, value in found.items()
        }
        statement = statement.format(**numbers)
    if isinstance(verdict, bool):
        verdict = "holds" if verdict else "does not hold"
    return Finding(
        key=key, title=TITLES[key], statement=statement, verdict=verdict, numbers=numbers
    )
