"""Preparation of curves for drawing: thinning, smoothing, axis ranges."""

from collections.abc import Sequence

import numpy as np

RMS_WINDOW = 1.0  # s


def thinned(values: np.ndarray, points: int) -> np.ndarray:
    """Return the indices of at most ``points`` values (n,): first, last, and the extremes of each
    interval.
    """
    if values.size <= points:
        return np.arange(values.size)
    width = -(-values.size // ((points - 2) // 2))
    intervals = -(-values.size // width)
    padded = np.full(intervals * width, np.nan)
    padded[: values.size] = values
    rows = padded.reshape(intervals, width)
    start = np.arange(intervals) * width
    low = start + np.where(np.isfinite(rows), rows, np.inf).argmin(axis=1)
    high = start + np.where(np.isfinite(rows), rows, -np.inf).argmax(axis=1)
    return np.unique(np.concatenate([[0], low, high, [values.size - 1]]))


def moving_rms(values: np.ndarray, sample_time: float) -> np.ndarray:
    """Rms over one second around each row of values (n, ...).

    Returns the rows before the first non-finite one, which does not affect them; zeros become NaN,
    for logarithmic axes.
    """
    from scipy.ndimage import uniform_filter1d

    finite = np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    values = values[: len(values) if finite.all() else int(np.argmin(finite))]
    if not len(values):
        return values
    window = max(round(RMS_WINDOW / sample_time), 1)
    with np.errstate(over="ignore"):
        mean_square = uniform_filter1d(np.square(values), window, axis=0, mode="nearest")
    return np.where(mean_square > 0.0, np.sqrt(np.maximum(mean_square, 0.0)), np.nan)


def completed_range(curves: Sequence[tuple[bool, np.ndarray]]) -> list[float] | None:
    """Range of the completed runs' curves if diverged ones would flatten them, else None."""
    completed = [values for done, values in curves if done]
    if not completed or len(completed) == len(curves):
        return None
    low, high = min(map(np.nanmin, completed)), max(map(np.nanmax, completed))
    margin = 0.08 * (high - low)
    return [float(low - margin), float(high + margin)] if high > low else None
