"""The paper's claims and the verdicts on them."""

from typing import get_args

from ffsm_drake.plugins.paper import accuracy, effort, robustness, schemes, theory
from ffsm_drake.plugins.paper.runs import Results
from ffsm_drake.plugins.paper.verdict import Claim, Kind, Verdict

# The claims of these modules, in their order.
CLAIMS: tuple[Claim, ...] = tuple(
    item
    for module in (accuracy, effort, schemes, robustness, theory)
    for item in vars(module).values()
    if isinstance(item, Claim)
)


def evaluate(results: Results) -> list[Verdict]:
    """The verdict on every claim, in order."""
    return [claim(results) for claim in CLAIMS]


def by_topic(verdicts: list[Verdict]) -> list[tuple[str, list[Verdict]]]:
    """Verdicts under their topics, in order of first appearance."""
    topics = dict.fromkeys(verdict.topic for verdict in verdicts)
    return [
        (topic, [verdict for verdict in verdicts if verdict.topic == topic]) for topic in topics
    ]


def counts(verdicts: list[Verdict]) -> dict[Kind, int]:
    """Number of verdicts of each kind."""
    return {kind: sum(verdict.kind == kind for verdict in verdicts) for kind in get_args(Kind)}
