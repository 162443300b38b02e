"""Products of matrices and vectors, of one or of many at once, with the bits of a single one."""

import math

import numpy as np

from ffsm_drake.common.choice import is_known


def product(matrix: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Products (..., m, k) of matrices (..., m, n) and (..., n, k), however they lie in memory."""
    return np.matmul(np.asanyarray(matrix, order="C"), np.asanyarray(other, order="C"))


def condensed(matrix: np.ndarray, kept: np.ndarray, others: np.ndarray) -> np.ndarray:
    """M_aa - M_au M_uu^-1 M_ua (..., na, na) of symmetric matrices M, with the indices ``kept`` (a)
    and the ``others`` (u).
    """
    rows = matrix[..., others, :]
    across = rows[..., kept]
    following = np.linalg.solve(rows[..., others], across)
    return matrix[..., kept[:, None], kept] - product(across.mT, following)


def applied(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices (..., m, n) and vectors (..., n), however they lie in memory."""
    return product(matrix, vector[..., None])[..., 0]


def times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Products of matrices (..., m, n) and vectors (..., n), one by one."""
    if vector.ndim == 1:
        return matrix.dot(vector)  # the same, and faster on few numbers
    return np.matmul(matrix, vector[..., None])[..., 0]


def length(vector: np.ndarray) -> np.ndarray:
    """Lengths (..., 1) of vectors (..., n), which do not overflow."""
    if not is_known(vector):
        return np.sqrt((vector * vector).sum(axis=-1, keepdims=True))
    found = [math.hypot(*one) for one in vector.reshape(-1, vector.shape[-1]).tolist()]
    return np.array(found).reshape(*vector.shape[:-1], 1)
