"""Claims of the proof and of the sampled loop's stability, by ``analysis`` and ``stability``."""

import functools

import numpy as np

from ffsm_drake.plugins.analysis import Analysis, analyze
from ffsm_drake.plugins.design.stability import stability
from ffsm_drake.plugins.paper.runs import CONTROLLERS, PROPOSED, SETTINGS, Results, StudyCase
from ffsm_drake.plugins.paper.verdict import (
    Both,
    Claim,
    Evaluated,
    both,
    claims_about,
    holds_if,
    in_both,
)
from ffsm_drake.plugins.paper.wording import NAMES, fate, fixed, listed, percent, scientific
from ffsm_drake.runs.record import RunRecord

claim = claims_about("Theory")
_N_STAR = "the largest TDE error of the run, the least bound"
LEMMA_1 = f"with N* {_N_STAR}"


@functools.lru_cache(maxsize=4)
def _analysis(record: RunRecord) -> Analysis:
    return analyze(record)


@claim("The Lyapunov criterion proves the controller's global stability.", "Abstract, Section 3.2")
def proof_is_conclusive(results: Results) -> Evaluated:
    """Evaluate the premises: a completed run agrees with the conclusion, but does not prove it."""
    premise = _shares(results, "lemma_1_premise", "share_of_samples")
    conclusion = _shares(results, "lemma_1_conclusion", "share_of_gains")
    more = [
        _shares(results, key, "ratio").pair(fixed)
        for key in ("lemma_1_premise", "lemma_1_conclusion")
    ]
    margins = {
        (setting, name): stability(
            StudyCase(setting=setting, controller=name).scenario(results.overrides)
        )
        for setting in ("euler", "exact")
        for name in CONTROLLERS
    }
    wrong = [
        f"{NAMES[name]} ({SETTINGS[setting].title})"
        for (setting, name), found in margins.items()
        if found.is_stable != results.run(setting, name).outcome.completed
    ]
    euler, exact = (margins[setting, PROPOSED] for setting in ("euler", "exact"))
    assert exact.axes is not None
    assert euler.axes is not None
    limit, euler_limit = (float(np.nanmin(axes.k_s_limit)) for axes in (exact.axes, euler.axes))
    agreement = f"except for {listed(wrong)}" if wrong else f"in all {len(margins)} cases"
    return (
        f"The proof needs Lemma 1, whose premise is true of {premise.pair(percent)} of the samples "
        f"(explicit Euler; exact, K_s bounded) and whose conclusion of {conclusion.pair(percent)} "
        f"of the gains, with N* {_N_STAR}: the verdict depends on it. The premise holds for N* "
        f"beyond {more[0]} times that, the conclusion beyond {more[1]} times. "
        "The proof is in continuous time, too: with the force held, the published gains' "
        f"run {fate(results.run('exact', PROPOSED))}. The sampled loop predicts the outcome, "
        f"{agreement}: it is stable for K_s below {fixed(limit)} 1/s on the exactly integrated "
        f"plant and {fixed(euler_limit)} 1/s on the Euler plant. That runs complete proves "
        "nothing.",
        holds_if(
            min(premise.euler, premise.bounded) == 1.0
            and results.run("exact", PROPOSED).outcome.completed
        ),
    )


def _shares(results: Results, key: str, number: str) -> Both[float]:
    """A fraction counted by a finding, in the two runs of ``both``."""
    found = both(
        lambda setting: _analysis(results.record(setting, PROPOSED)).finding(key).numbers[number]
    )
    return Both(float(found.euler), float(found.bounded))


@claim("The TDE errors stay within a constant N*.", "Section 3.1, after (8)")
def tde_errors_are_bounded(results: Results) -> Evaluated:
    measured, bounded = [], {}
    for setting in SETTINGS:
        record = results.record(setting, PROPOSED)
        bound = float(_analysis(record).finding("tde_error_bound").numbers["bound"])
        bounded[setting] = record.outcome.completed and np.isfinite(bound)
        until = (
            ""
            if record.outcome.completed
            else (f" until it diverges at {record.outcome.time:.2f} s")
        )
        measured.append(
            f"{SETTINGS[setting].title}: largest |Ñ| {scientific(bound)} rad/s² or m/s²{until}"
        )
    kind, condition = in_both(bounded["euler"], bounded["exact"])
    if kind == "holds only" and bounded["bounded"]:
        condition = "with explicit Euler at the control period, or with K_s bounded"
    return f"{'; '.join(measured)}.", (kind, condition)


def _finding(key: str, text: str, place: str, condition: str = "") -> Claim:
    """A claim that is a finding of the analysis, in the paper's and the exact bounded run; a
    condition that the finding rests on completes the verdict.
    """

    def evaluate(results: Results) -> Evaluated:
        found = {
            setting: _analysis(results.record(setting, PROPOSED)).finding(key)
            for setting in ("euler", "bounded")
        }
        measured = " ".join(
            f"{SETTINGS[setting].title}: {finding.statement}" for setting, finding in found.items()
        )
        if all(finding.verdict == "not tested" for finding in found.values()):
            return measured, ("not tested", "")
        kind, where = in_both(*(finding.verdict == "holds" for finding in found.values()))
        return measured, (kind, f"{where} {condition}".strip())

    return Claim("Theory", text, place, evaluate)


lemma_1_premise = _finding(
    "lemma_1_premise",
    "The normalization factor satisfies β_i < N*/‖s‖∞.",
    "After (9); premise of Lemma 1",
    LEMMA_1,
)
lemma_1_conclusion = _finding(
    "lemma_1_conclusion", "The gain dynamics stays below N*: K_si < N*.", "Lemma 1, (11)", LEMMA_1
)
switching_gain_is_limited = _finding(
    "switching_gain_bound", "The switching gain stays below N*.", "After (10)", LEMMA_1
)
lyapunov_function_decreases = _finding(
    "lyapunov_derivative",
    "The Lyapunov function decreases wherever |s_i| > max(K_si/β_i, ε).",
    "(12) to (14)",
)
sliding_variable_is_ultimately_bounded = _finding(
    "ultimate_bound", "The sliding variable ends within the bound of (16).", "(15), (16)"
)
