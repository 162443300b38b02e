"""The reaching law (7) and its bound on s, for the paper's laws; the bound on G for any law."""

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence, largest, ratio, rms
from ffsm_drake.plugins.analysis.findings import Evaluated, NotApplicable
from ffsm_drake.systems.controllers import PAPER_LAWS


def reaching_law_remainder(
    *, s: np.ndarray, k_s: np.ndarray, g: np.ndarray, tde_error: np.ndarray, period: float
) -> np.ndarray:
    """Remainder of equation (7) per period (n - 1, nv).

    That is (s_{k+1} - s_k) / L + Ntilde + K_s s + G sgn s.

    (7) holds in continuous time. Over a period, s also changes by the variation of de/dt and
    d^2e/dt^2, by the noise of two measurements and, on a plant stepped by explicit Euler, by the
    integration error.
    """
    return np.diff(s, axis=0) / period + tde_error + (k_s * s + g * np.sign(s))[:-1]


def direct_bound(
    *, first: np.ndarray, bound: np.ndarray, k_s_min: np.ndarray, g_min: np.ndarray
) -> np.ndarray:
    """Bound on |s_i| (nv) that follows from equation (7) alone: max(|s_i(0)|, (N*_i - G_i)^+ /
    K_si).

    Beyond it d|s_i|/dt <= N*_i - G_i - K_si |s_i| < 0. This needs neither adaptation nor V, but
    (7) must hold exactly, as it does in continuous time only.

    Args: s at the start, N* by coordinate, and the smallest K_s and G of the run, all (nv).
    """
    excess = np.maximum(bound - g_min, 0.0)
    # Without K_s, |s| is bounded only if N*_i <= G_i.
    return np.maximum(np.abs(first), ratio(excess, k_s_min))


def _sliding(run: Evidence) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return s, K_s and G (n, nv) of a run that records s."""
    if "sliding_variable" not in run.data:
        raise NotApplicable(f"the controller {run.scenario.controller} has no sliding variable")
    run.require_period()
    s, (k_s, g) = run.values("sliding_variable"), run.gains
    run.add(sliding_variable=s, reaching_gain=k_s, switching_gain=g)
    return s, k_s, g


def _remainder(run: Evidence) -> np.ndarray:
    s, k_s, g = _sliding(run)
    if run.scenario.controller not in PAPER_LAWS:
        raise NotApplicable(
            "(7) follows from the injected dynamics of the paper's laws, and "
            f"{run.scenario.controller} is not one"
        )
    remainder = reaching_law_remainder(
        s=s, k_s=k_s, g=g, tde_error=run.tde_error, period=run.period
    )
    run.add(reaching_law_remainder=remainder)
    return remainder


def reaching_law(run: Evidence) -> Evaluated:
    """The remainder of (7), for the paper's laws."""
    remainder = _remainder(run)
    late = run.after_start_up[:-1]
    numbers = {
        "start_up_time": run.start_up_time,
        "remainder": largest(remainder).max(),
        "remainder_late": largest(remainder[late]).max(),
        "rms_ratio": ratio(rms(remainder), rms(run.tde_error)),
        "rms_ratio_late": ratio(rms(remainder[late]), rms(run.tde_error[late])),
        "largest_k_d_l": np.max(run.constants["k_d"]) * run.period,
        "largest_k_s_l": run.gains[0].max() * run.period,
        **run.grouped("remainder", largest(remainder)),
    }
    statement = (
        "Over a period, ds/dt differs from -Ntilde - K_s s - G sgn s by up to {remainder:.3g} "
        "rad/s^2 or m/s^2, in "
        "root mean square {rms_ratio:.3g} times Ntilde; K_s L = {largest_k_s_l:.3g}, K_D L = "
        "{largest_k_d_l:.3g}."
    )
    return "measured", statement, numbers


def direct(run: Evidence) -> Evaluated:
    """The bound on s from (7), for the paper's laws."""
    remainder, late = _remainder(run), run.after_start_up
    s, k_s, g = _sliding(run)

    def evaluate(disturbance: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds (nv), and largest |s_i| over bound (nv), on the samples of ``part``
        (n).
        """
        if not part[:-1].any():
            return (np.full(s.shape[1], np.nan),) * 2
        k_s_min, g_min = k_s[part].min(axis=0), g[part].min(axis=0)
        bound = direct_bound(
            first=s[part][0], bound=largest(disturbance[part[:-1]]), k_s_min=k_s_min, g_min=g_min
        )
        return bound, ratio(largest(s[part]), bound)

    whole = np.ones_like(late)
    bound, times = evaluate(run.tde_error, whole)
    _, late_times = evaluate(run.tde_error, late)
    _, full_times = evaluate(run.tde_error - remainder, whole)
    run.add(direct_bound=bound)
    numbers = {
        "start_up_time": run.start_up_time,
        "coordinates": times.size,
        "coordinates_within": np.count_nonzero(times <= 1.0),
        "worst_ratio": times.max(),
        "worst_coordinate": run.coordinates.names[int(times.argmax())],
        "coordinates_within_late": np.count_nonzero(late_times <= 1.0)
        if run.outlasts_start_up
        else np.nan,
        "worst_ratio_late": late_times.max(),
        "worst_ratio_with_remainder": full_times.max(),
        **run.named("bound", bound),
        **run.named("ratio", times),
    }
    statement = (
        "|s_i| stays within max(|s_i(0)|, (N*_i - G_i)^+ / K_si) in {coordinates_within:g} of "
        "{coordinates:g} "
        "coordinates; the largest ratio is {worst_ratio:.3g} ({worst_coordinate})."
    )
    return bool((times <= 1.0).all()), statement, numbers


def switching_gain(run: Evidence) -> Evaluated:
    """The bound on G, for any law that records it."""
    _, _, g = _sliding(run)
    if "switching_gain" not in run.data:
        raise NotApplicable(f"the controller {run.scenario.controller} has no switching gain")
    bound = run.bound.max()
    numbers = {
        "largest_g": g.max(),
        "bound": bound,
        "bound_late": run.late_bound.max(),
        "ratio": ratio(g.max(), bound),
        "coordinates": g.shape[1],
        "coordinates_within_own_bound": np.count_nonzero((g <= run.bound).all(axis=0)),
        **run.named("largest_g", g.max(axis=0)),
    }
    statement = (
        "G_i reaches {largest_g:.3g}, where N* = {bound:.3g}; {coordinates_within_own_bound:g} of "
        "{coordinates:g} "
        "coordinates stay within their own N*_i."
    )
    return bool(g.max() <= bound), statement, numbers
