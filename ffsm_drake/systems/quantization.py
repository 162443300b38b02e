"""Rounding to multiples of a resolution."""

import numpy as np


def quantize(values: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Round to the nearest multiple of each entry's resolution; entries with resolution 0 pass
    unchanged.
    """
    steps = np.where(resolution > 0.0, resolution, 1.0)
    return np.where(resolution > 0.0, np.round(values / steps) * steps, values)
