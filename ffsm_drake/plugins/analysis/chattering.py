"""Chattering of the control force: spectrum, reversals, total variation.

Forces are arrays (n, nv), N m or N, one row per sample.
"""

import numpy as np

from ffsm_drake.plugins.analysis.evidence import Evidence, ratio, ratios
from ffsm_drake.plugins.analysis.findings import Finding, finding, not_applicable

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
    size = min(SEGMENT, len(effort))
    segments = np.lib.stride_tricks.sliding_window_view(effort, size, axis=0)  # (n, nv, size)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)
    parts = detrended(segments[:: size - size // 2]) * window
    density = _one_sided(parts).mean(axis=0).T * (period / np.square(window).sum())
    return np.fft.rfftfreq(size, period), density


def split_variance(
    effort: np.ndarray, period: float, *, split: float
) -> tuple[np.ndarray, np.ndarray]:
    """Variance of each coordinate's detrended force, split into (below ``split``, from it on).

    Both (nv), squared force, over the whole record, from the periodogram without a window: it
    weights all samples equally, and by Parseval's theorem the two parts sum to the variance.
    """
    power = _one_sided(detrended(effort.T)).T / len(effort) ** 2
    high = np.fft.rfftfreq(len(effort), period) >= split
    return power[~high].sum(axis=0), power[high].sum(axis=0)


def detrended(values: np.ndarray) -> np.ndarray:
    """Return values (..., n) without their linear trend: the least-squares line is subtracted."""
    time = np.arange(values.shape[-1]) - 0.5 * (values.shape[-1] - 1)
    centred = values - values.mean(axis=-1, keepdims=True)
    slope = centred @ time / max(time @ time, 1.0)
    return centred - slope[..., None] * time


def _one_sided(values: np.ndarray) -> np.ndarray:
    """Squared magnitude of the Fourier transform of real values (..., n), negative frequencies
    added to the positive ones (..., n // 2 + 1).
    """
    power = np.square(np.abs(np.fft.rfft(values)))
    power[..., 1 : (values.shape[-1] + 1) // 2] *= 2.0
    return power


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


def findings(run: Evidence) -> list[Finding]:
    """``chattering``, for any controller."""
    tau, period = run.values("generalized_force"), run.period
    if len(tau) < FEWEST_SAMPLES:
        return not_applicable(
            f"a spectrum needs {FEWEST_SAMPLES} samples, the record has {len(tau)}", "chattering"
        )
    split = split_frequency(period)
    frequency, density = effort_spectrum(tau, period)
    run.axes["frequency"] = frequency
    run.attributes["split_frequency"] = split
    run.add(effort_spectrum=density)
    low, high = split_variance(tau, period, split=split)
    # n samples have n - 1 changes in n - 1 periods
    turns = reversals(tau) / (period * (len(tau) - 1))
    variation = total_variation(tau)
    numbers: dict[str, float | str] = {
        "split_frequency": split,
        "sampling_frequency": 1.0 / period,
        "effort_share": ratio(float(high.sum()), float(np.square(tau).sum(axis=1).mean())),
        **run.named("share", ratios(high, low + high)),
        **run.named("rms", np.sqrt(high)),
        **run.named("reversals_per_second", turns),
        **run.named("total_variation", variation),
    }
    for group, part in run.groups.items():
        numbers[f"share.{group}"] = ratio(float(high[part].sum()), float((low + high)[part].sum()))
        numbers[f"rms.{group}"] = float(np.sqrt(high[part].sum()))
        numbers[f"reversals_per_second.{group}"] = float(turns[part].mean())
        numbers[f"total_variation.{group}"] = float(variation[part].sum())
    shares = ", ".join(f"{numbers[f'share.{group}']:.3g} ({group})" for group in run.groups)
    statement = (
        f"The share of tau's variance from {{split_frequency:g}} Hz on is {shares}; "
        "{effort_share:.3g} of the mean |tau|^2, and so of ISV, is chattering."
    )
    return [finding("chattering", statement, numbers)]
