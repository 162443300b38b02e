"""Products of matrices and vectors of one spacecraft or of several, each with the bits it has
alone.
"""

import math

import numpy as np


def times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices (..., m, n) and vectors (..., n), one by one."""
    if vector.ndim == 1:
        return matrix.dot(vector)  # the same, and faster on few numbers
    product: np.ndarray = np.matmul(matrix, vector[..., None])[..., 0]
    return product


def length(vector: np.ndarray) -> np.ndarray:
    """Lengths (..., 1) of vectors (..., n), which do not overflow."""
    found = [math.hypot(*one) for one in vector.reshape(-1, vector.shape[-1]).tolist()]
    return np.array(found).reshape(*vector.shape[:-1], 1)
