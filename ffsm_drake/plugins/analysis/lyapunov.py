"""The stability proof of Section 3.2 evaluated on a run: equations (12) to (16) and Lemma 1.

N* is the largest TDE error of the run. The arrays are samples (n, nv) of s, K_s, G.
"""

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence, ratio
from ffsm_drake.plugins.analysis.findings import Evaluated, NotApplicable, Verdict


def outside(s: np.ndarray, k_s: np.ndarray, *, beta: np.ndarray, epsilon: float) -> np.ndarray:
    """Return the mask (n, nv) of the coordinates outside |s_i| <= max(K_si / beta_i, epsilon)."""
    return np.abs(s) > np.maximum(k_s / beta, epsilon)


def lyapunov(
    *,
    s: np.ndarray,
    k_s: np.ndarray,
    g: np.ndarray,
    alpha: np.ndarray,
    phi: np.ndarray,
    bound: float,
    period: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate (12) and (13) on samples.

    The rates are differences over the period, so their sum is the change of V. A gain that does
    not adapt (alpha_i or phi_i zero) is constant and has no term: its quotient would be NaN.

    Returns: V at every sample (n), and the terms of (13) over every period, of s, K_s and G
    (3, n - 1).
    """
    distance = np.stack([s, k_s - bound, g - bound])
    rates = np.stack([np.ones_like(alpha), alpha, phi])[:, None]
    weight = np.divide(1.0, rates, out=np.zeros_like(rates), where=rates > 0.0)
    middle = 0.5 * (distance[:, 1:] + distance[:, :-1])
    value = 0.5 * (weight * distance**2).sum(axis=2).sum(axis=0)
    return value, (weight * middle * np.diff(distance, axis=1)).sum(axis=2) / period


def ultimate_bound(
    *, bound: float, alpha: np.ndarray, beta: np.ndarray, phi: np.ndarray, epsilon: float
) -> float:
    """Return the bound on ||s||_2 of equation (16). Infinite if a gain does not adapt."""
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.maximum(bound / beta, epsilon) ** 2 + bound**2 / alpha + bound**2 / phi
    return float(np.sqrt(np.where(np.isnan(squares), np.inf, squares).sum()))


def _proof(run: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
    """alpha, beta, phi (nv), epsilon and N* of a run with s, K_s, G and the constants of (9) and
    (10).
    """
    recorded = {"sliding_variable", "reaching_gain", "switching_gain"}
    constants = ("alpha", "beta", "phi", "epsilon")
    if not (recorded <= {*run.data} and {*constants} <= {*run.constants}):
        raise NotApplicable(
            "the proof covers gains that adapt by (9) and (10); the gains of "
            f"{run.scenario.controller} do not"
        )
    run.require_period()
    alpha, beta, phi, epsilon = (run.constants[name] for name in constants)
    return alpha, beta, phi, float(epsilon), float(run.bound.max())


def ultimate(run: Evidence) -> Evaluated:
    """The bound (16)."""
    alpha, beta, phi, epsilon, bound = _proof(run)
    limit = ultimate_bound(bound=bound, alpha=alpha, beta=beta, phi=phi, epsilon=epsilon)
    largest = float(np.linalg.norm(run.values("sliding_variable"), axis=1).max())
    numbers = {
        "bound": bound,
        "ultimate_bound": limit,
        "largest_norm": largest,
        "ratio": ratio(largest, limit),
    }
    statement = (
        "||s||_2 reaches {largest_norm:.3g}; (16) gives {ultimate_bound:.3g} for N* = {bound:.3g}."
    )
    return largest <= limit, statement, numbers


def premise(run: Evidence) -> Evaluated:
    """The premise of Lemma 1."""
    _, beta, _, _, bound = _proof(run)
    peak = np.abs(run.values("sliding_variable")).max(axis=1)  # ||s||_inf
    scaled = beta.max() * peak
    run.add(scaled_sliding_variable=scaled)
    numbers = {
        "largest": scaled.max(),
        "largest_of_smallest_beta": beta.min() * peak.max(),
        "bound": bound,
        "ratio": ratio(scaled.max(), bound),
        "share_of_samples": np.mean(scaled < bound),
    }
    statement = (
        "The largest beta_i ||s||_inf is {largest:.3g}, {ratio:.2g} times N* = {bound:.3g}; "
        "all beta_i satisfy the premise in {share_of_samples:.3g} of the samples."
    )
    return bool(scaled.max() < bound), statement, numbers


def conclusion(run: Evidence) -> Evaluated:
    """The conclusion of Lemma 1."""
    *_, bound = _proof(run)
    k_s = run.gains[0]
    numbers = {
        "smallest_k_s": k_s.min(),
        "largest_k_s": k_s.max(),
        "largest_initial_k_s": k_s[0].max(),
        "bound": bound,
        "ratio": ratio(k_s.max(), bound),
        "share_of_gains": np.mean(k_s < bound),
    }
    statement = (
        "K_si lies in [{smallest_k_s:.4g}, {largest_k_s:.4g}] 1/s, up to {ratio:.2g} times N* "
        "= {bound:.3g}."
    )
    return bool(k_s.max() < bound), statement, numbers


def derivative(run: Evidence) -> Evaluated:
    """The sign of dV/dt inside and outside the vicinity of the manifold."""
    alpha, beta, phi, epsilon, bound = _proof(run)
    s, (k_s, g) = run.values("sliding_variable"), run.gains
    value, terms = lyapunov(s=s, k_s=k_s, g=g, alpha=alpha, phi=phi, bound=bound, period=run.period)
    rate, names = terms.sum(axis=0), ("s", "K_s", "G")
    exceeding = outside(s, k_s, beta=beta, epsilon=epsilon)
    run.add(lyapunov=value, lyapunov_rate=rate, outside=exceeding.sum(axis=1))
    run.add(**{f"lyapunov_rate_of_{n.lower()}": term for n, term in zip(names, terms, strict=True)})
    rising, left, wholly = rate > 0.0, exceeding[:-1].any(axis=1), exceeding[:-1].all(axis=1)
    numbers = {
        "bound": bound,
        "epsilon": epsilon,
        "samples": rising.size,
        "outside_any": left.sum(),
        "outside_all": wholly.sum(),
        "rising_outside_any": (rising & left).sum(),
        "rising_outside_all": (rising & wholly).sum(),
        "inside": (~left).sum(),
        "rising_inside": (rising & ~left).sum(),
        "largest_rate_outside": rate[left].max() if left.any() else np.nan,
        "largest_rate_inside": rate[~left].max() if (~left).any() else np.nan,
        "value_first": value[0],
        "value_last": value[-1],
        # the largest term of (13) while V rises
        "driver": names[terms[:, rising].sum(axis=1).argmax()] if rising.any() else "none",
    }
    statement = (
        "dV/dt > 0 in {rising_outside_all:g} of the {outside_all:g} samples with all |s_i| > "
        "max(K_si/beta_i, "
        "epsilon), which (14) is about, in {rising_outside_any:g} of the {outside_any:g} with "
        "some, and in "
        "{rising_inside:g} of the {inside:g} others; V goes from {value_first:.4g} to "
        "{value_last:.4g}."
    )
    tested: bool | Verdict = not (rising & wholly).any() if wholly.any() else "not tested"
    return tested, statement, numbers
