# ruff: noqa: RUF001 (the texts use mathematical signs)
"""Claims about accuracy."""

import math

import numpy as np
import pandas as pd  # type: ignore[import-untyped]

from ffsm_drake.plugins.analysis.evidence import Evidence, rms
from ffsm_drake.plugins.paper import paper
from ffsm_drake.plugins.paper.runs import (
    CONTROLLERS,
    INTEGRAL_SURFACE,
    PROPOSED,
    SETTINGS,
    Results,
)
from ffsm_drake.plugins.paper.verdict import (
    Evaluated,
    both,
    claims_about,
    holds_if,
    in_both,
    ratios_in_both,
    table_rows,
)
from ffsm_drake.plugins.paper.wording import (
    NAMES,
    fixed,
    named,
    percent,
    scientific,
    span,
    times_span,
)
from ffsm_drake.runs.record import RunRecord

claim = claims_about("Accuracy")


@claim(
    "The proposed controller tracks more accurately (ITAE) than the other three under every "
    "disturbance.",
    "Section 4, Table 2; conclusions",
)
def proposed_is_most_accurate(results: Results) -> Evaluated:
    orders = {setting: results.rankings("itae", setting) for setting in SETTINGS}
    total = len(orders["euler"])
    wins = {
        setting: sum(order[0] == PROPOSED for order in found) for setting, found in orders.items()
    }
    ratio = both(lambda setting: times_span(results.ratios("itae", setting, PROPOSED, "aismc")))
    diverged = len(results.divergence_times("exact", PROPOSED))
    return (
        f"Smallest ITAE in {wins['euler']} of {total} comparisons (disturbance × seed) with "
        f"explicit Euler, at {ratio.euler} times AISMC's. With exact integration: in "
        f"{wins['exact']} with the published gains ({diverged} of its runs diverge) and in "
        f"{wins['bounded']} with K_s bounded, at {ratio.bounded} times.",
        in_both(wins["euler"] == total, wins["bounded"] == total),
    )


@claim(f"Order by accuracy: {' before '.join(NAMES[name] for name in CONTROLLERS)}.", "Table 2")
def order_of_accuracy(results: Results) -> Evaluated:
    orders = both(lambda setting: results.rankings("itae", setting))
    same = both(lambda setting: results.rankings("itae", setting).count(list(CONTROLLERS)))
    total = len(orders.bounded)
    usual = max(orders.bounded, key=orders.bounded.count)
    return (
        f"The same order in {same.pair(str)} of {total} comparisons (explicit Euler; exact, K_s "
        f"bounded). The latter's usual order: {' before '.join(NAMES[name] for name in usual)}, in "
        f"{orders.bounded.count(usual)}.",
        same.ruling(lambda count: count == total),
    )


@claim("The ITAE values of Table 2.", "Table 2")
def values_of_itae(results: Results) -> Evaluated:
    def of_controllers(setting: str) -> dict[str, list[float]]:
        ratios = table_rows(results, setting).groupby("controller", sort=False)["itae_ratio"]
        return dict(ratios.agg(list))

    ratio = both(of_controllers)
    parts = ratio.text(lambda by_name: named(by_name, lambda values: span(values, 2)))
    within = all(
        abs(value - 1.0) <= paper.REPRODUCED for values in ratio.euler.values() for value in values
    )
    measured = (
        f"Ours over the paper's: {parts}. The floor follows from a measurement error that it does "
        "not specify."
    )
    return measured, ("holds" if within else "not reproduced", "")


@claim(
    "Integral sliding surfaces improve the accuracy by nearly an order of magnitude over ordinary "
    "ones.",
    "Section 4",
)
def integral_surface_gains_an_order(results: Results) -> Evaluated:
    factor = ratios_in_both(results, "itae", "asmc", "aismc")
    quiet = ratios_in_both(results, "itae", ("asmc", "no noise"), ("aismc", "no noise"))
    tdc = ratios_in_both(results, "itae", "tdc", "aismc")
    asmc_printed, tdc_printed = (
        span([values[name] / values["aismc"] for values in paper.TABLE_2["itae"].values()], 2)
        for name in ("asmc", "tdc")
    )
    return (
        f"ITAE of ASMC over AISMC, which share K_D and the initial K_s: {factor.text(times_span)} "
        f"(without noise {quiet.pair(times_span)}). TDC over AISMC: {tdc.pair(span)}. In the "
        f"paper: {asmc_printed} and {tdc_printed}.",
        factor.ruling(lambda values: min(values) >= paper.NEARLY_TENFOLD),
    )


@claim(
    "The integral surface is what eliminates steady-state errors; ordinary surfaces keep them.",
    "Sections 1 and 4",
)
def integral_surface_removes_steady_errors(results: Results) -> Evaluated:
    at_rest = results.run("bounded", PROPOSED, variant="at rest")
    motion = at_rest.case.scenario(results.overrides).reference.duration or math.nan
    left = both(
        lambda setting: {
            name: results.run(setting, name, variant="at rest").resting_error
            for name in CONTROLLERS
        }
    )

    def removed(errors: dict[str, float]) -> bool:
        return (
            max(errors[name] for name in INTEGRAL_SURFACE) < errors["asmc"] / paper.NEARLY_TENFOLD
        )

    return (
        "Sum of the absolute mean errors (rad, m) over the last five of "
        f"{fixed(at_rest.outcome.time, 2)} s, motion until {fixed(motion, 2)} s, constant "
        "disturbance, no noise: "
        f"{left.text(lambda errors: named(errors, lambda error: scientific(error, 2)))}. "
        "Time-delay estimation already acts as an integrator.",
        left.ruling(removed),
    )


@claim(
    "The robust term G sgn s improves the accuracy: proposed against AISMC, ASMC against TDC.",
    "Section 4",
)
def robust_term_improves_accuracy(results: Results) -> Evaluated:
    noisy = ratios_in_both(results, "itae", PROPOSED, (PROPOSED, "G = 0"))
    quiet = ratios_in_both(results, "itae", (PROPOSED, "no noise"), (PROPOSED, "G = 0, no noise"))
    asmc = ratios_in_both(results, "itae", "asmc", ("asmc", "G = 0"))
    stiff = ratios_in_both(results, "itae", ("tdc", "stiffness of ASMC"), "asmc")
    ruling = holds_if(max(*noisy.euler, *noisy.bounded, *quiet.euler, *quiet.bounded) < 1.0)
    if ruling[0] != "holds" and max(*quiet.euler, *quiet.bounded) < 1.0:
        ruling = ("holds only", "without measurement noise, for the proposed controller")
    return (
        f"ITAE of the proposed controller with G over without it: {noisy.text(times_span)}; "
        f"without noise {quiet.pair(times_span)}. ASMC, whose G starts at zero: "
        f"{asmc.pair(times_span)}. ASMC's lead over TDC is stiffness: TDC with ASMC's and no G has "
        f"{stiff.pair(times_span)} times its ITAE.",
        ruling,
    )


@claim(
    "The new adaptive law for K_s improves tracking accuracy and stability.",
    "Section 1; (9) against (21)",
)
def new_law_improves_accuracy_and_stability(results: Results) -> Evaluated:
    euler, exact = (
        results.ratios("itae", setting, (PROPOSED, "G = 0"), "aismc")
        for setting in ("euler", "exact")
    )
    ended = results.divergence_times("exact", (PROPOSED, "G = 0"))
    rivals = results.runs_of("exact", "aismc").loc["tau_d1", "diverged"].count()
    when = f" (at {span(ended, 2)} s)" if ended else ""
    return (
        "With G = 0 the proposed controller is AISMC with law (9) for (21). Its ITAE is then "
        f"{times_span(euler)} times AISMC's with explicit Euler. With exact integration and the "
        f"published gains, (9) diverges in {len(ended)} of {len(exact)} runs{when}, (21) in "
        f"{rivals}.",
        in_both(max(euler) < 1.0, max(exact) < 1.0 and not ended),
    )


@claim(
    "Three times the disturbance's frequency or amplitude leaves the accuracy as it was.",
    "Section 4, Table 2",
)
def accuracy_does_not_depend_on_the_disturbance(results: Results) -> Evaluated:
    def itae(setting: str, name: str) -> pd.Series:
        return results.runs_of(setting, name)["itae"]

    def change(values: pd.Series) -> float:
        return float(values.max() / values.min() - 1.0)

    changes = both(
        lambda setting: {
            name: change(itae(setting, name).groupby("disturbance").mean()) for name in CONTROLLERS
        }
    )
    noise = both(lambda setting: max(change(itae(setting, name)["tau_d1"]) for name in CONTROLLERS))
    return (
        "Largest change of the mean ITAE: "
        f"{changes.text(lambda by_name: named(by_name, percent))}; the noise seed alone changes it "
        f"by up to {noise.pair(percent)}. Evaluated for the proposed controller, within 5 %.",
        changes.ruling(lambda by_name: by_name[PROPOSED] <= paper.SLIGHTLY),
    )


@claim(
    "The controller brings spacecraft and target to the planned posture with high precision.",
    "Section 4, Figure 3",
)
def target_is_reached_with_high_precision(results: Results) -> Evaluated:
    def largest(setting: str, metric: str) -> tuple[float, float]:
        """Over all runs, in rad and m; infinite when one of them diverged."""
        runs = results.runs_of(setting, PROPOSED)["run"]
        found = [run.metrics[metric] for run in runs]
        if not all(run.outcome.completed for run in runs):
            return math.inf, math.inf
        return max(max(f["base_rotation"], f["joints"]) for f in found), max(
            f["base_position"] for f in found
        )

    def written(errors: tuple[tuple[float, float], ...]) -> str:
        peak, final = (f"{scientific(rad, 2)} rad and {scientific(m, 2)} m" for rad, m in errors)
        return f"never more than {peak}, at the end {final}"

    errors = both(lambda setting: (largest(setting, "peak_error"), largest(setting, "final_error")))
    diverged = results.divergence_times("exact", PROPOSED)
    total = len(results.comparisons)
    when = f", at {span(diverged, 2)} s" if diverged else ""
    kind, condition = errors.ruling(lambda found: max(found[1]) < paper.PRECISELY)
    if kind == "holds" and diverged:
        kind, condition = (
            "holds only",
            ("with explicit Euler at the control period, or with K_s bounded"),
        )
    return (
        f"Largest error of all runs: {errors.text(written)}. With exact integration and the "
        f"published gains {len(diverged)} of {total} runs diverge{when}. Position and attitude are "
        "measured without error.",
        (kind, condition),
    )


@claim(
    "Time-delay estimation gives the lumped uncertainty N accurately.",
    "Sections 3.1 and 4, equation (5)",
)
def estimation_is_accurate(results: Results) -> Evaluated:
    noisy = both(lambda setting: _estimation_error(results.record(setting, PROPOSED)))
    quiet = both(
        lambda setting: _estimation_error(results.record(setting, PROPOSED, variant="no noise"))
    )

    def accurate(shares: dict[str, float]) -> bool:
        return max(shares.values()) <= paper.ACCURATELY

    ruling = noisy.ruling(accurate)
    if ruling[0] == "does not hold" and quiet.ruling(accurate)[0] == "holds":
        ruling = ("holds only", "without measurement noise")
    return (
        "Rms of the estimation error over that of N: "
        f"{noisy.text(lambda shares: named(shares, percent))}. Without noise: "
        f"{quiet.text(lambda shares: named(shares, percent))}. Noise σ is √2 σ/L of acceleration.",
        ruling,
    )


def _estimation_error(record: RunRecord) -> dict[str, float]:
    """Rms of the controller's estimation error N - N(t - L) over that of N, by group.

    Equations (2) and (5).
    """
    run = Evidence(record)
    # without the first two updates, which lack a previous estimate
    error = run.tde_error[2:]
    effort = run.values("generalized_force")
    truth = (run.acceleration - np.linalg.solve(run.inertia, effort[..., None])[:-1, :, 0])[2:]
    return {name: rms(error[:, part]) / rms(truth[:, part]) for name, part in run.groups.items()}
