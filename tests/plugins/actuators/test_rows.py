"""Thrusters on several wrenches at once, as rehearsals use them: each has the bits that it has
alone.
"""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion

from ffsm_drake import load_scenario
from ffsm_drake.plugins.actuators.allocation import Allocation
from ffsm_drake.plugins.actuators.attitude import attitude_ahead
from ffsm_drake.plugins.actuators.thrusters import ThrusterSet


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    size=st.integers(1, 5),
    seed=st.integers(0, 1000),
    scale=st.sampled_from([0.1, 3.0, 30.0, 1e4]),
    failed=st.sampled_from([{}, {"top_1_x": "stuck_on"}, {"top_1_x": "stuck_off"}]),
)
def test_wrenches_are_allocated_each_by_itself(size, seed, scale, failed):
    settings_of = load_scenario("thrusters_only").actuation.thrusters
    thrusters = ThrusterSet(dataclasses.replace(settings_of, failures=failed), sample_time=0.01)
    wrenches = scale * np.random.default_rng(seed).normal(size=(size, 6))
    wrenches[0, 0] = np.nan if seed % 3 == 0 else 0.0
    memory = thrusters.initial_memory()
    rows = dataclasses.replace(
        memory,
        **{
            field.name: np.tile(getattr(memory, field.name), (size, 1))
            for field in dataclasses.fields(memory)
        },
    )
    together = thrusters.allocate(wrenches, rows)
    for row, wrench in enumerate(wrenches):
        alone = thrusters.allocate(wrench, memory)
        np.testing.assert_array_equal(together.packed()[row], alone.packed())


def test_a_program_too_is_solved_for_its_own_wrench():
    wrenches = np.hstack([np.eye(6), -np.eye(6)])
    allocation = Allocation(wrenches, largest=np.ones(12), cost=np.ones(12))
    wanted = np.array([[0.5, 0, 0, 0, 0, 0], [4.0, 0, 0, 0, 0, 0]])
    forces, part = allocation.solve(wanted)
    assert part == pytest.approx([1.0, 0.25])
    assert forces @ wrenches.T == pytest.approx(part[:, None] * wanted, abs=1e-9)


@given(seed=st.integers(0, 10_000), time=st.sampled_from([0.0, 0.005, 0.3]))
def test_attitudes_ahead_are_those_of_drake(seed, time):
    rng = np.random.default_rng(seed)
    quaternion, w = rng.normal(size=(3, 4)), rng.normal(size=(3, 3))
    found = attitude_ahead(quaternion, w, time)
    for row in range(3):
        np.testing.assert_array_equal(attitude_ahead(quaternion[row], w[row], time), found[row])
        half = 0.5 * time * w[row]
        angle = np.linalg.norm(half)
        turn = Quaternion(wxyz=[np.cos(angle), *(np.sinc(angle / np.pi) * half)])
        unit = quaternion[row] / np.linalg.norm(quaternion[row])
        expected = turn.multiply(Quaternion(unit / np.linalg.norm(unit))).rotation()
        assert found[row].reshape(3, 3) == pytest.approx(expected, abs=1e-14)
