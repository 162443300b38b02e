"""Claims about the comparison of the four schemes, and their special cases."""

import dataclasses
from typing import Any

import numpy as np

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.paper.runs import PROPOSED, Results
from ffsm_drake.plugins.paper.verdict import Evaluated, both, claims_about, holds_if, ratios_in_both
from ffsm_drake.plugins.paper.wording import fixed, percent, span, times_span
from ffsm_drake.scenario import Scenario
from ffsm_drake.spacecraft.craft import Craft
from ffsm_drake.systems.controllers import make_law

claim = claims_about("Comparison of the schemes")


@claim("The same parameters for all four controllers make a fair comparison.", "Section 4")
def comparison_is_fair(results: Results) -> Evaluated:
    scenario = results.record("euler", "asmc").scenario
    tdc, asmc, aismc = (_law(scenario, name) for name in ("tdc", "asmc", "aismc"))
    asmc_stiffness, stiffness = asmc.k_s * asmc.k_d, aismc.k_p + aismc.k_s_initial * aismc.k_d
    before = both(lambda setting: results.ratios("itae", setting, "tdc", "asmc")[0])
    after = ratios_in_both(results, "itae", ("tdc", "stiffness of ASMC"), "asmc")
    return (
        f"Stiffness (1/s²): TDC {span(tdc.k_p)}, ASMC K_s K_D = {span(asmc_stiffness, 4)}, AISMC "
        f"and proposed K_P + K_s K_D = {span(stiffness, 4)} at the start. ITAE of TDC over ASMC: "
        f"{before.text(fixed)}; with ASMC's stiffness {after.pair(times_span)}.",
        holds_if(min(asmc_stiffness) <= 2.0 * max(tdc.k_p)),
    )


@claim("With G = 0 the proposed controller (6) becomes AISMC (20).", "Section 3.3")
def without_g_it_is_aismc(results: Results) -> Evaluated:
    gap = _law_gap(results, PROPOSED, "aismc", keep_k_p=True, keep_g=False)
    euler, exact = (
        times_span(results.ratios("itae", setting, (PROPOSED, "G = 0"), "aismc"))
        for setting in ("euler", "exact")
    )
    ended = results.divergence_times("exact", (PROPOSED, "G = 0"))
    fate = (
        f"it does not stay with AISMC, diverging at {span(ended, 2)} s"
        if ended
        else f"{exact} times"
    )
    return (
        f"For the same K_s the two laws differ by {percent(gap)} of the command over random "
        f"errors. But (6) comes with law (9): with G = 0 its ITAE is {euler} times AISMC's with "
        f"explicit Euler; exactly integrated {fate}.",
        ("holds only", "with law (21) in place of (9)") if gap == 0.0 else ("does not hold", ""),
    )


@claim(
    "With K_P = 0 the integral surface becomes an ordinary one, and (6) and (20) become (18) and "
    "(17).",
    "Section 3.3",
)
def without_k_p_surfaces_become_ordinary(results: Results) -> Evaluated:
    robust = _law_gap(results, PROPOSED, "asmc", keep_k_p=False, keep_g=True)
    plain = _law_gap(results, "aismc", "tdc", keep_k_p=False, keep_g=True)
    ruling = holds_if(robust == plain == 0.0)
    if robust == 0.0 != plain:
        ruling = ("holds only", "for (6) and (18), with the same K_s and G, not for (20) and (17)")
    return (
        "Largest difference of the commands over random errors with K_P = 0 and equal K_s and G: "
        f"(6) and (18) {percent(robust)}, (20) and (17) {percent(plain)}: (20) keeps K_s s, which "
        "TDC lacks. The adaptation laws differ, too: K_s is constant in (18), and G follows (19), "
        "not (10).",
        ruling,
    )


def _law(scenario: Scenario, name: str) -> Any:
    """The injected dynamics of one of the paper's laws with the scenario's gains."""
    mission = Mission(dataclasses.replace(scenario, controller=name))
    return make_law(mission, mission.craft.nominal()).dynamics


def _law_gap(results: Results, first: str, second: str, *, keep_k_p: bool, keep_g: bool) -> float:
    """Largest relative difference of two laws' feedback over random errors, with equal K_s
    and G.
    """
    scenario = results.record("euler", PROPOSED).scenario
    laws = [_law(scenario, name) for name in (first, second)]
    if not keep_k_p:
        laws = [
            dataclasses.replace(law, k_p=0.0 * law.k_p) if hasattr(law, "k_p") else law
            for law in laws
        ]
    random = np.random.default_rng(0)
    size = len(Craft(scenario).coordinates.names)
    largest = 0.0
    for _ in range(100):
        e, e_dot, integral = 1e-6 * random.normal(size=(3, size))
        k_s = random.uniform(50.0, 90.0, size)
        g = random.uniform(1e-5, 1e-3, size) if keep_g else np.zeros(size)
        given = {"integral_error": integral, "reaching_gain": k_s, "switching_gain": g}
        feedback = []
        for law in laws:
            if hasattr(law, "k_s"):  # the constant gain of (18)
                law = dataclasses.replace(law, k_s=k_s)
            state = {key: given.get(key, value) for key, value in law.initial_state().items()}
            feedback.append(law.step(e, e_dot, np.zeros(size), state)[0])
        largest = max(
            largest, float(np.linalg.norm(feedback[0] - feedback[1]) / np.linalg.norm(feedback[0]))
        )
    return largest
