"""Disk margins, against the poles of the loop with complex factors on its forces."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ffsm_drake import load_scenario
from ffsm_drake.common.errors import BlockError
from ffsm_drake.plugins.design.stability import disk
from ffsm_drake.plugins.design.stability.linearization import POSTURES, Linearizer

SCENARIO = load_scenario("postcapture", ["controller=tdc"])


@pytest.fixture(scope="module")
def margins():
    return disk.disk_margins(SCENARIO)


@pytest.fixture(scope="module")
def loops():
    with Linearizer(SCENARIO, blocks={"forces.push": disk.force_beside}) as linearizer:
        return linearizer.along(POSTURES)


def radius(loop, factors):
    """Spectral radius with complex factors (nv) on the forces that act."""
    (sample,), push = loop.samples, loop.noise["push"]
    change = np.diag(np.asarray(factors, dtype=complex) - 1.0)
    direct = np.linalg.solve(np.eye(len(change)) - change @ sample.d[:, push], change)
    poles = np.linalg.eigvals(sample.a + sample.b[:, push] @ direct @ sample.c)
    return np.abs(poles).max()


def factor(alpha, z):
    return (1.0 + 0.5 * alpha * z) / (1.0 - 0.5 * alpha * z)


@pytest.mark.smoke
@settings(max_examples=40, deadline=None)
@given(angle=st.floats(0.0, 2.0 * np.pi), size=st.floats(0.0, 0.97), axis=st.integers(0, 10))
def test_within_the_disk_each_force_alone_keeps_the_loop_stable(margins, loops, angle, size, axis):
    factors = np.ones(11, dtype=complex)
    factors[axis] = factor(margins.alone[axis], size * np.exp(1j * angle))
    for loop in loops:
        assert radius(loop, factors) < 1.0 + 1e-9


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.floats(0.0, 0.97))
def test_within_the_disk_all_at_once_keep_it(margins, loops, seed, size):
    z = size * np.exp(2j * np.pi * np.random.default_rng(seed).uniform(size=11))
    for loop in loops:
        assert radius(loop, factor(margins.together, z)) < 1.0 + 1e-9


@pytest.mark.slow
def test_just_beyond_it_some_factor_makes_it_unstable(margins, loops):
    angles = np.exp(1j * np.linspace(0.0, np.pi, 361))  # a conjugate factor has conjugate poles

    def radii(axis):
        for z in angles:
            factors = np.ones(11, dtype=complex)
            factors[axis] = factor(1.03 * margins.alone[axis], z)
            yield from (radius(loop, factors) for loop in loops)

    assert all(any(found > 1.0 for found in radii(axis)) for axis in (0, 3, 6, 10))
    assert (margins.together <= margins.alone + 1e-12).all()


def test_range_of_gain_and_phase(margins):
    low, high = margins.gain(1.0)
    assert (low, high) == (pytest.approx(1.0 / 3.0), pytest.approx(3.0))
    assert margins.gain(2.0)[1] == np.inf
    assert np.rad2deg(margins.phase(1.0)) == pytest.approx(53.13, abs=0.01)


@pytest.mark.long
def test_a_delay_costs_margin(margins):
    tdc = ["controller=tdc"]
    late = disk.disk_margins(load_scenario("flight_sensors", [*tdc, "actuation.delay=2"]))
    prompt = disk.disk_margins(load_scenario("flight_sensors", tdc))
    assert late.together < prompt.together
    assert (late.alone < prompt.alone).all()


def test_an_unstable_loop_has_none():
    scenario = load_scenario("postcapture", ["payload.nominal.mass=125"])
    with pytest.raises(BlockError, match="an unstable loop has no disk margins"):
        disk.disk_margins(scenario)
