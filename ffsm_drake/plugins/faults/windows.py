"""Values over a window of time: their slope and noise."""

import functools

import numpy as np


def times_of(count: int, step: float) -> np.ndarray:
    """Times of blocks, from their mean (count), s."""
    return step * (np.arange(count) - 0.5 * (count - 1))


@functools.lru_cache(maxsize=256)
def slope_weights(windows: tuple[int, ...], count: int, step: float) -> np.ndarray:
    """Weights (windows, count) of the last values, ``step`` s apart, that give slopes."""
    weights = np.zeros((len(windows), count))
    for row, window in enumerate(windows):
        time = times_of(window, step)
        weights[row, count - window :] = time / (time @ time)
    weights.flags.writeable = False
    return weights


def noise_of(values: np.ndarray, least: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise on slowly changing values (n, ...), at least the known one,
    since few values are a poor estimate.
    """
    return np.maximum(np.sqrt((np.diff(values, n=2, axis=0) ** 2).mean(axis=0) / 6.0), least)


def slope_of(
    values: np.ndarray, step: float, least: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The slope of values (n, ...) that are a time apart, and its standard deviation, with at
    least a noise of each value.
    """
    time = times_of(len(values), step)
    square, noise = float(time @ time), noise_of(values, np.asarray(least))
    return np.tensordot(time, values, axes=1) / square, noise / np.sqrt(square)
