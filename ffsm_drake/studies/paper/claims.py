"""The paper's claims and the verdicts on them."""

from ffsm_drake.studies.paper import accuracy, effort, robustness, schemes
from ffsm_drake.studies.paper.runs import Results
from ffsm_drake.studies.paper.theory import THEORY_CLAIMS
from ffsm_drake.studies.paper.verdict import Claim, Kind, Verdict

EMPIRICAL_CLAIMS: tuple[Claim, ...] = (
    accuracy.proposed_is_most_accurate,
    accuracy.order_of_accuracy,
    accuracy.values_of_itae,
    accuracy.integral_surface_gains_an_order,
    accuracy.integral_surface_removes_steady_errors,
    accuracy.robust_term_improves_accuracy,
    accuracy.new_law_improves_accuracy_and_stability,
    accuracy.accuracy_does_not_depend_on_the_disturbance,
    accuracy.target_is_reached_with_high_precision,
    accuracy.estimation_is_accurate,
    effort.values_of_isv,
    effort.order_of_effort,
    effort.effort_is_slightly_larger,
    effort.chattering_is_local,
    effort.epsilon_trades_accuracy_for_smoothness,
    schemes.comparison_is_fair,
    schemes.without_g_it_is_aismc,
    schemes.without_k_p_surfaces_become_ordinary,
    robustness.published_gains_are_stable,
    robustness.condition_8_protects,
    robustness.payload_uncertainty_is_tolerated,
    robustness.more_robust_than_its_rivals,
)

CLAIMS: tuple[Claim, ...] = (*EMPIRICAL_CLAIMS, *THEORY_CLAIMS)


def judge(results: Results, claims: tuple[Claim, ...] | None = None) -> list[Verdict]:
    """The verdict on every claim, in order (default: ``CLAIMS``)."""
    return [claim(results) for claim in (CLAIMS if claims is None else claims)]


def by_topic(verdicts: list[Verdict]) -> list[tuple[str, list[Verdict]]]:
    """Verdicts under their topics, in order of first appearance."""
    topics = dict.fromkeys(verdict.topic for verdict in verdicts)
    return [(topic, [verdict for verdict in verdicts if verdict.topic == topic]) for topic in topics]


def counts(verdicts: list[Verdict]) -> dict[Kind, int]:
    """How many verdicts of each kind."""
    kinds: tuple[Kind, ...] = ("holds", "holds only", "does not hold", "not reproduced")
    return {kind: sum(verdict.kind == kind for verdict in verdicts) for kind in kinds}
