"""The base's attitude some time ahead."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion

from ffsm_drake.plugins.actuators.attitude import attitude_ahead


@given(seed=st.integers(0, 10_000), time=st.sampled_from([0.0, 0.005, 0.3]))
def test_attitudes_ahead_are_those_of_drake(seed, time):
    rng = np.random.default_rng(seed)
    quaternion, w = rng.normal(size=4), rng.normal(size=3)
    half = 0.5 * time * w
    angle = np.linalg.norm(half)
    turn = Quaternion(wxyz=[np.cos(angle), *(np.sinc(angle / np.pi) * half)])
    unit = quaternion / np.linalg.norm(quaternion)
    expected = turn.multiply(Quaternion(unit / np.linalg.norm(unit))).rotation()
    found = attitude_ahead(quaternion, w, time).reshape(3, 3)
    assert found == pytest.approx(expected, abs=1e-14)
