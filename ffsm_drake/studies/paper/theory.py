"""Claims of the proof, and of stability as the sampled loop has it; judged by ``analysis`` and ``stability``."""

import functools

import numpy as np

from ffsm_drake.analysis import Analysis, analyze
from ffsm_drake.design.stability import Margins, assess
from ffsm_drake.runs.record import RunRecord
from ffsm_drake.studies.paper.runs import CONTROLLERS, PROPOSED, SETTINGS, Case, Results
from ffsm_drake.studies.paper.verdict import Verdict, in_both
from ffsm_drake.studies.paper.wording import NAMES, fixed, listed, scientific


@functools.lru_cache(maxsize=4)
def _analysis(record: RunRecord) -> Analysis:
    return analyze(record)


def _analyses(results: Results) -> dict[str, Analysis]:
    """The proposed controller's runs that judge a claim about it: the paper's own, and the exact one that ends."""
    return {setting: _analysis(results.record(setting, PROPOSED)) for setting in ("euler", "bounded")}


def _found(results: Results, key: str, *, claim: str, place: str) -> Verdict:
    """A claim that is one finding of the analysis."""
    found = {setting: analysis.finding(key) for setting, analysis in _analyses(results).items()}
    measured = " ".join(f"{SETTINGS[setting].title}: {finding.statement}" for setting, finding in found.items())
    holds = {setting: finding.verdict == "holds" for setting, finding in found.items()}
    return Verdict(
        topic="Theory", claim=claim, place=place, measured=measured, **in_both(holds["euler"], holds["bounded"])
    )


def tde_errors_are_bounded(results: Results) -> Verdict:
    measured, bounded = [], {}
    for setting in SETTINGS:
        record = results.record(setting, PROPOSED)
        bound = float(_analysis(record).finding("tde_error_bound").numbers["bound"])
        bounded[setting] = record.outcome.completed and np.isfinite(bound)
        fate = "" if record.outcome.completed else f" until it diverges at {record.outcome.time:.2f} s"
        measured.append(f"{SETTINGS[setting].title}: largest |Ñ| {scientific(bound)} rad/s² or m/s²{fate}")
    verdict = in_both(bounded["euler"], bounded["exact"])
    if verdict["kind"] == "holds only" and bounded["bounded"]:
        verdict["condition"] += ", or with K_s bounded"
    return Verdict(
        topic="Theory",
        claim="The TDE errors stay within a constant N*.",
        place="Section 3.1, after (8)",
        measured="; ".join(measured) + ".",
        **verdict,
    )


def lemma_1_premise(results: Results) -> Verdict:
    return _found(
        results,
        "lemma_1_premise",
        claim="The normalization factor satisfies β_i < N*/‖s‖∞.",
        place="After (9); premise of Lemma 1",
    )


def lemma_1_conclusion(results: Results) -> Verdict:
    return _found(
        results, "lemma_1_conclusion", claim="The gain dynamics stays below N*: K_si < N*.", place="Lemma 1, (11)"
    )


def switching_gain_is_limited(results: Results) -> Verdict:
    return _found(results, "switching_gain_bound", claim="The switching gain stays below N*.", place="After (10)")


def lyapunov_function_decreases(results: Results) -> Verdict:
    return _found(
        results,
        "lyapunov_derivative",
        claim="The Lyapunov function decreases wherever |s_i| > max(K_si/β_i, ε).",
        place="(12) to (14)",
    )


def sliding_variable_is_ultimately_bounded(results: Results) -> Verdict:
    return _found(
        results, "ultimate_bound", claim="The sliding variable ends within the bound of (16).", place="(15), (16)"
    )


def sampled_loop_decides(results: Results) -> Verdict:
    margins = {
        (setting, name): _margins(results, setting, name) for setting in ("euler", "exact") for name in CONTROLLERS
    }
    wrong = [
        f"{NAMES[name]} ({SETTINGS[setting].title})"
        for (setting, name), found in margins.items()
        if found.is_stable != results.run(setting, name).outcome.completed
    ]
    limits = {setting: np.nanmin(margins[setting, PROPOSED].k_s_limit) for setting in ("euler", "exact")}
    proposed = margins["exact", PROPOSED]
    leaves = proposed.forecast_times[np.argmax((proposed.forecast_k_s > limits["exact"]).any(axis=1))]
    outcome = results.run("exact", PROPOSED).outcome
    fate = f"the run diverges at {outcome.time:.2f} s" if not outcome.completed else "the run completes"
    stable = {setting: margins[setting, PROPOSED].is_stable for setting in ("euler", "exact")}
    agreement = (
        f"Foreseen and simulated outcome agree in all {len(margins)} cases"
        if not wrong
        else f"Foreseen and simulated outcome differ for {listed(wrong)}"
    )
    return Verdict(
        topic="Theory",
        claim="The Lyapunov criterion proves the controller's global stability.",
        place="Abstract, Section 3.2",
        measured="The proof is in continuous time. The sampled loop, linear near every posture of the plan, is stable "
        f"for K_s below {fixed(float(limits['exact']))} 1/s on the exactly integrated plant and "
        f"{fixed(float(limits['euler']))} 1/s on the Euler plant. On the former law (9) is expected to pass the limit "
        f"at {leaves:.1f} s; {fate}. {agreement}.",
        **in_both(stable["euler"], stable["exact"]),
    )


def _margins(results: Results, setting: str, name: str) -> Margins:
    return assess(Case(setting=setting, controller=name).scenario(results.overrides))


THEORY_CLAIMS = (
    sampled_loop_decides,
    tde_errors_are_bounded,
    lemma_1_premise,
    lemma_1_conclusion,
    switching_gain_is_limited,
    lyapunov_function_decreases,
    sliding_variable_is_ultimately_bounded,
)
