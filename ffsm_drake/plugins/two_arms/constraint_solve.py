"""Multipliers of constraints that may depend on each other."""

from typing import Any

import numpy as np

_LEAST = 1e-9  # share of a constraint's mobility that earlier ones leave, if it depends on them


def solved(mobility: Any, wanted: Any) -> Any:
    """The multipliers x (n) with M x = b, zero for constraints that depend on earlier ones.

    Gaussian elimination in the given order, which is stable for a symmetric matrix without negative
    eigenvalues (Golub and Van Loan, Matrix Computations, section 4.2). A constraint whose pivot
    vanishes, but for rounding, moves with the earlier ones and is left out, as a zero row is.

    Args: M (n, n) of constraints with rows A, A H^-1 A'; b (n), their wanted accelerations minus
    those of all other forces. Numbers or symbols.
    """
    size, rows = len(wanted), np.concatenate([mobility, wanted[:, None]], axis=1)
    pivots, are_free = list[Any](), list[Any]()
    for k in range(size):
        is_free = rows[k, k] > _LEAST * mobility[k, k]
        pivot = np.where(is_free, rows[k, k], 1.0)
        share = np.where(is_free, rows[k + 1 :, k] / pivot, 0.0)
        rows[k + 1 :] = rows[k + 1 :] - share[:, None] * rows[k]
        pivots.append(pivot)
        are_free.append(is_free)
    found = 0.0 * wanted
    for k in reversed(range(size)):
        rest = rows[k, size] - rows[k, k + 1 : size] @ found[k + 1 :]
        found[k] = np.where(are_free[k], rest / pivots[k], 0.0)
    return found
