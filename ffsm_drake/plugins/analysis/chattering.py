"""Chattering of the control force: spectrum, reversals, total variation.

Forces are arrays (n, nv), N m or N, one row per sample.
"""

import numpy as np
from scipy import signal

from ffsm_drake.plugins.analysis.evidence import Evidence, ratio
from ffsm_drake.plugins.analysis.findings import Evaluated, NotApplicable

SEGMENT = 256  # samples of one segment of the smoothed spectrum
FEWEST_SAMPLES = 16


def split_frequency(period: float) -> float:
    """Frequency above which a force counts as chattering, Hz.

    10 Hz, or a fifth of the Nyquist frequency if that is lower.

    The planned motion and the disturbances lie below 1 Hz, the sampled loop's oscillation at half
    the sampling rate.
    """
    return min(10.0, 0.1 / period)


def effort_spectrum(effort: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (m), Hz, and power spectral density (m, nv), squared force per Hz, smoothed for
    plotting.

    Welch's method with half-overlapping Hann windows, each with its linear trend (the planned
    motion) removed.
    """
    return signal.welch(
        effort, 1.0 / period, nperseg=min(SEGMENT, len(effort)), detrend=signal.detrend, axis=0
    )


def split_variance(
    effort: np.ndarray, period: float, *, split: float
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of each coordinate's detrended force, split into (below ``split``, from it on).

    Both (nv), squared force, over the whole record, from the periodogram without a window: it
    weights all samples equally, and by Parseval's theorem the two parts sum to the variance.
    """
    frequency, power = signal.periodogram(
        effort, 1.0 / period, detrend=signal.detrend, scaling="spectrum", axis=0
    )
    high = frequency >= split
    return power[~high].sum(axis=0), power[high].sum(axis=0)


def total_variation(effort: np.ndarray) -> np.ndarray:
    """Sum of |tau_{k+1} - tau_k| (nv)."""
    return np.abs(np.diff(effort, axis=0)).sum(axis=0)


def reversals(effort: np.ndarray) -> np.ndarray:
    """Number of reversals of the force (nv): sign changes of tau_{k+1} - tau_k, ignoring zeros."""
    changes = np.diff(effort, axis=0).T
    return np.array(
        [np.count_nonzero(np.diff(np.sign(change[change != 0.0]))) for change in changes],
        dtype=float,
    )


def chattering(run: Evidence) -> Evaluated:
    """Share of chattering in the force, its reversals and total variation."""
    tau, period = run.values("generalized_force"), run.period
    if len(tau) < FEWEST_SAMPLES:
        raise NotApplicable(f"a spectrum needs {FEWEST_SAMPLES} samples, the record has {len(tau)}")
    split = split_frequency(period)
    run.axes["frequency"], density = effort_spectrum(tau, period)
    run.attributes["split_frequency"] = split
    run.add(effort_spectrum=density)
    low, high = split_variance(tau, period, split=split)
    # n samples have n - 1 changes in n - 1 periods
    turns = reversals(tau) / (period * (len(tau) - 1))
    variation = total_variation(tau)
    numbers = {
        "split_frequency": split,
        "sampling_frequency": 1.0 / period,
        "effort_share": ratio(high.sum(), np.square(tau).sum(axis=1).mean()),
        **run.named("share", ratio(high, low + high)),
        **run.named("rms", np.sqrt(high)),
        **run.named("reversals_per_second", turns),
        **run.named("total_variation", variation),
    }
    for group, part in run.groups.items():
        numbers |= {
            f"share.{group}": ratio(high[part].sum(), (low + high)[part].sum()),
            f"rms.{group}": np.sqrt(high[part].sum()),
            f"reversals_per_second.{group}": turns[part].mean(),
            f"total_variation.{group}": variation[part].sum(),
        }
    shares = ", ".join(f"{numbers[f'share.{group}']:.3g} ({group})" for group in run.groups)
    statement = (
        f"The share of tau's variance from {{split_frequency:g}} Hz on is {shares}; "
        "{effort_share:.3g} of the mean |tau|^2, and so of ISV, is chattering."
    )
    return "measured", statement, numbers
