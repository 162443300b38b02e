"""Momentum that a record balances."""

import numpy as np

from ffsm_drake.runs.metrics import momentum_residual


def assert_momentum_follows(data, most):
    """A record's momentum is what acted on it, to ``most`` (N s and N m s)."""
    for residual in momentum_residual(data).values():
        assert np.linalg.norm(residual, axis=1).max() < most
