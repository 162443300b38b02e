"""The stability proof of Section 3.2 evaluated on a run: equations (12) to (16) and Lemma 1.

N* is the largest TDE error of the run. The arrays are samples (n, nv) of s, K_s, G.
"""

import dataclasses

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence, ratio
from ffsm_drake.plugins.analysis.findings import Finding, Numbers, finding, not_applicable


def outside(s: np.ndarray, k_s: np.ndarray, *, beta: np.ndarray, epsilon: float) -> np.ndarray:
    """Return the mask (n, nv) of the coordinates outside |s_i| <= max(K_si / beta_i, epsilon)."""
    return np.abs(s) > np.maximum(k_s / beta, epsilon)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lyapunov:
    """V of equation (12) at every sample, and its rate over every period."""

    value: np.ndarray  # V (n)
    rate_of_s: np.ndarray  # s^T ds/dt (n - 1), the first term of equation (13)
    rate_of_k_s: np.ndarray  # (n - 1), the second
    rate_of_g: np.ndarray  # (n - 1), the third

    @property
    def rate(self) -> np.ndarray:
        """dV/dt of equation (13), (V_{k+1} - V_k) / L, (n - 1)."""
        return self.rate_of_s + self.rate_of_k_s + self.rate_of_g


def lyapunov(
    *,
    s: np.ndarray,
    k_s: np.ndarray,
    g: np.ndarray,
    alpha: np.ndarray,
    phi: np.ndarray,
    bound: float,
    period: float,
) -> Lyapunov:
    """Evaluate (12) and (13) on samples.

    The rates are differences over the period, so their sum is the change of V. A gain that does
    not adapt (alpha_i or phi_i zero) is constant and has no term: its quotient would be NaN.
    """

    def term(distance: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weight = np.divide(1.0, rate, out=np.zeros_like(rate), where=rate > 0.0)
        middle = 0.5 * (distance[1:] + distance[:-1])
        value = 0.5 * (weight * distance**2).sum(axis=1)
        return value, (weight * middle * np.diff(distance, axis=0)).sum(axis=1) / period

    parts = [term(s, np.ones_like(alpha)), term(k_s - bound, alpha), term(g - bound, phi)]
    values, (of_s, of_k_s, of_g) = zip(*parts, strict=True)
    return Lyapunov(
        value=np.sum(values, axis=0), rate_of_s=of_s, rate_of_k_s=of_k_s, rate_of_g=of_g
    )


def ultimate_bound(
    *, bound: float, alpha: np.ndarray, beta: np.ndarray, phi: np.ndarray, epsilon: float
) -> float:
    """Return the bound on ||s||_2 of equation (16). Infinite if a gain does not adapt."""
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.maximum(bound / beta, epsilon) ** 2 + bound**2 / alpha + bound**2 / phi
    return float(np.sqrt(np.where(np.isnan(squares), np.inf, squares).sum()))


def findings(run: Evidence) -> list[Finding]:
    """Findings of Section 3.2, for a run with s, K_s, G and a law with constants of (9), (10)."""
    keys = ("lyapunov_derivative", "ultimate_bound", "lemma_1_premise", "lemma_1_conclusion")
    recorded = {"sliding_variable", "reaching_gain", "switching_gain"}
    constants = {"alpha", "beta", "phi", "epsilon"}
    if not (recorded <= {*run.data} and constants <= {*run.constants}):
        reason = (
            "the proof covers gains that adapt by (9) and (10); the gains of "
            f"{run.scenario.controller} do not"
        )
        return not_applicable(reason, *keys)
    if run.too_short:
        return not_applicable(run.too_short, *keys)
    bound = float(run.bound.max())
    return [
        _derivative(run, bound), _ultimate_bound(run, bound),
        _premise(run, bound), _conclusion(run, bound),
    ]  # fmt: skip


def _ultimate_bound(run: Evidence, bound: float) -> Finding:
    alpha, beta, phi, epsilon = _constants(run)
    limit = ultimate_bound(bound=bound, alpha=alpha, beta=beta, phi=phi, epsilon=epsilon)
    largest = float(np.linalg.norm(run.values("sliding_variable"), axis=1).max())
    return finding(
        "ultimate_bound",
        "||s||_2 reaches {largest_norm:.3g}; (16) gives {ultimate_bound:.3g} for N* = {bound:.3g}.",
        {
            "bound": bound,
            "ultimate_bound": limit,
            "largest_norm": largest,
            "ratio": ratio(largest, limit),
        },
        holds=largest <= limit,
    )


def _premise(run: Evidence, bound: float) -> Finding:
    peak = np.abs(run.values("sliding_variable")).max(axis=1)  # ||s||_inf
    beta = run.constants["beta"]
    scaled = beta.max() * peak
    run.add(scaled_sliding_variable=scaled)
    largest = float(scaled.max())
    return finding(
        "lemma_1_premise",
        "The largest beta_i ||s||_inf is {largest:.3g}, {ratio:.2g} times N* = {bound:.3g}; "
        "all beta_i satisfy the premise in {share_of_samples:.3g} of the samples.",
        {
            "largest": largest,
            "largest_of_smallest_beta": float(beta.min() * peak.max()),
            "bound": bound,
            "ratio": ratio(largest, bound),
            "share_of_samples": float(np.mean(scaled < bound)),
        },
        holds=largest < bound,
    )


def _conclusion(run: Evidence, bound: float) -> Finding:
    k_s = run.gains[0]
    largest = float(k_s.max())
    return finding(
        "lemma_1_conclusion",
        "K_si lies in [{smallest_k_s:.4g}, {largest_k_s:.4g}] 1/s, up to {ratio:.2g} times N* "
        "= {bound:.3g}.",
        {
            "smallest_k_s": float(k_s.min()),
            "largest_k_s": largest,
            "largest_initial_k_s": float(k_s[0].max()),
            "bound": bound,
            "ratio": ratio(largest, bound),
            "share_of_gains": float(np.mean(k_s < bound)),
        },
        holds=largest < bound,
    )


def _constants(run: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """alpha, beta, phi (nv) and epsilon of the law."""
    alpha, beta, phi = (run.constants[name] for name in ("alpha", "beta", "phi"))
    return alpha, beta, phi, float(run.constants["epsilon"])


def _derivative(run: Evidence, bound: float) -> Finding:
    s, (k_s, g) = run.values("sliding_variable"), run.gains
    alpha, beta, phi, epsilon = _constants(run)
    v = lyapunov(s=s, k_s=k_s, g=g, alpha=alpha, phi=phi, bound=bound, period=run.period)
    exceeding = outside(s, k_s, beta=beta, epsilon=epsilon)
    parts = {"s": v.rate_of_s, "K_s": v.rate_of_k_s, "G": v.rate_of_g}
    run.add(lyapunov=v.value, lyapunov_rate=v.rate, outside=exceeding.sum(axis=1))
    run.add(**{f"lyapunov_rate_of_{name.lower()}": part for name, part in parts.items()})
    rising, left, wholly = v.rate > 0.0, exceeding[:-1].any(axis=1), exceeding[:-1].all(axis=1)
    # The largest term of (13) while V rises.
    driver = max(parts, key=lambda name: parts[name][rising].sum()) if rising.any() else "none"
    numbers: Numbers = {
        "bound": bound,
        "epsilon": epsilon,
        "samples": float(rising.size),
        "outside_any": float(left.sum()),
        "outside_all": float(wholly.sum()),
        "rising_outside_any": float((rising & left).sum()),
        "rising_outside_all": float((rising & wholly).sum()),
        "inside": float((~left).sum()),
        "rising_inside": float((rising & ~left).sum()),
        "largest_rate_outside": float(v.rate[left].max()) if left.any() else np.nan,
        "largest_rate_inside": float(v.rate[~left].max()) if (~left).any() else np.nan,
        "value_first": float(v.value[0]),
        "value_last": float(v.value[-1]),
        "driver": driver,
    }
    statement = (
        "dV/dt > 0 in {rising_outside_all:g} of the {outside_all:g} samples with all |s_i| > "
        "max(K_si/beta_i, "
        "epsilon), which (14) is about, in {rising_outside_any:g} of the {outside_any:g} with "
        "some, and in "
        "{rising_inside:g} of the {inside:g} others; V goes from {value_first:.4g} to "
        "{value_last:.4g}."
    )
    found = finding("lyapunov_derivative", statement, numbers, holds=not (rising & wholly).any())
    return found if wholly.any() else dataclasses.replace(found, verdict="not tested")
