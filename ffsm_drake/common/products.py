"""Products of matrices and vectors of several runs."""

import numpy as np


def matrix_vector(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices (..., n, n) and vectors (..., n), each bit for bit as if alone."""
    if vector.ndim == 1:
        return matrix.dot(vector)  # faster than @ on few numbers
    across, down, right = matrix.strides[-3:]
    if across == (down + right) * matrix.shape[-1]:  # blocks on the diagonal (``CopiesModel``)
        return np.matmul(matrix, vector[..., None])[..., 0]  # BLAS as it is, as ``dot`` of one
    return np.stack([matrix_vector(one, of) for one, of in zip(matrix, vector, strict=True)])
