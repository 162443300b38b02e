"""Planned motions: their rates are those of the positions, accelerations those of the rates."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation


def parts_of(motion, times):
    """q, v and dv/dt at some times, each a row."""
    nq = len(motion.coordinates.position_names)
    return np.split(motion.rows(np.asarray(times)), [nq, 2 * nq - 1], axis=1)


def assert_consistent(motion, times, *, h, atol):
    """By central differences with a step h."""
    before, now, after = (parts_of(motion, np.asarray(times) + step) for step in (-h, 0.0, h))
    turns = [Rotation.from_quat(q[:, :4], scalar_first=True) for q in (before[0], after[0])]
    assert_allclose((turns[1] * turns[0].inv()).as_rotvec() / (2 * h), now[1][:, :3], atol=atol)
    assert_allclose((after[0][:, 4:] - before[0][:, 4:]) / (2 * h), now[1][:, 3:], atol=atol)
    assert_allclose((after[1] - before[1]) / (2 * h), now[2], atol=atol)
    assert_allclose(np.linalg.norm(now[0][:, :4], axis=1), 1.0, atol=1e-14)
