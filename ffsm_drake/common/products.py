"""Products of matrices and vectors, alone or of several runs: each with the bits it has alone."""

import numpy as np


def matrix_vector(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of vectors (..., n) and matrices (..., n, n) that lie in memory as they do alone."""
    if vector.ndim == 1:
        return matrix.dot(vector)  # faster than @ on few numbers
    across, down, right = matrix.strides[-3:]
    if across == (down + right) * matrix.shape[-1]:  # blocks on the diagonal (``CopiesModel``)
        return np.matmul(matrix, vector[..., None])[..., 0]  # BLAS as it is, as ``dot`` of one
    return np.stack([matrix_vector(one, of) for one, of in zip(matrix, vector, strict=True)])


def product(matrix: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Products (..., m, k) of matrices (..., m, n) and (..., n, k), however they lie in memory."""
    return np.matmul(np.ascontiguousarray(matrix), np.ascontiguousarray(other))


def applied(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices (..., m, n) and vectors (..., n), however they lie in memory."""
    return product(matrix, vector[..., None])[..., 0]
