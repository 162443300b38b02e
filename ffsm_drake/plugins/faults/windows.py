"""Slopes of values over a window of time."""

import functools

import numpy as np

EVERY = 5  # control samples of a block
BATCH = 4  # blocks that are looked at together while there is no evidence


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
