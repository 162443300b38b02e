"""How a run ended: by drawn courses of the error."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ffsm_drake import load_scenario
from ffsm_drake.runs.ending import ending_of_completed
from ffsm_drake.runs.tracking import Tracked

PERIOD = 0.01
SCENARIO = load_scenario("postcapture", ["duration=30"])  # its motion ends at 20 s


def tracked(*errors, names=("base_rotation_x", "joint_1")):
    return Tracked(
        error=np.stack(errors, axis=1),
        names=names[: len(errors)],
        groups=("base_rotation", "joints")[: len(errors)],
        units=("rad", "rad")[: len(errors)],
    )


def ending(error, *, scenario=SCENARIO, end=30.0):
    time = np.arange(round(end / PERIOD) + 1) * PERIOD
    return ending_of_completed(scenario, time, tracked(error(time), 1e-6 * np.ones_like(time)))


@pytest.mark.smoke
@given(size=st.floats(1e-9, 0.99e-3), frequency=st.floats(1.1, 40.0), seed=st.integers(0, 99))
def test_errors_within_their_tolerance_have_settled(size, frequency, seed):
    noise = np.random.default_rng(seed)
    for error in (
        lambda t: size * np.sin(2.0 * np.pi * frequency * t),
        lambda t: size * noise.uniform(-1.0, 1.0, t.size),
        lambda t: size * np.exp(-t),
    ):
        assert ending(error).status == "settled"


@given(
    rate=st.floats(0.8, 30.0),
    last=st.floats(0.4e-3, 10.0),
    frequency=st.just(0.0) | st.floats(7.0, 50.0),
)
def test_errors_that_grow_exponentially_are_seen(rate, last, frequency):
    found = ending(lambda t: last * np.exp(rate * (t - 30.0)) * np.cos(frequency * (t - 30.0)))
    assert found.status == "growing"
    assert found.is_failure
    assert "base_rotation_x" in found.sentence


@given(size=st.floats(1.1e-3, 1.0), rate=st.floats(0.0, 3.0), frequency=st.floats(1.1, 40.0))
def test_errors_that_stay_or_decay_beyond_it_have_not_settled(size, rate, frequency):
    decay = lambda t: np.exp(rate * (30.0 - t))  # noqa: E731
    found = ending(lambda t: size * decay(t) * (2.0 + np.cos(2.0 * np.pi * frequency * t)))
    assert found.status == "not settled"
    assert not found.is_failure
    assert found.excess > 1.0


@given(
    size=st.floats(0.3e-3, 0.1),
    period=st.floats(1.5, 14.0),
    phase=st.floats(0.0, 6.3),
    other=st.floats(0.0, 0.5),
)
def test_errors_that_only_swing_do_not_grow(size, period, phase, other):
    """As under a slow disturbance: the peak of a second may rise from almost nothing."""
    swing = lambda t: np.sin(2.0 * np.pi * t / period + phase) + other * np.sin(3.0 * t)  # noqa: E731
    assert ending(lambda t: size * swing(t)).status != "growing"


def test_a_leap_in_the_last_second_counts_as_growing():
    leap = lambda t: np.where(t > 29.2, 3e-3, 3e-5)  # noqa: E731
    assert ending(leap).status == "growing"


def test_a_run_that_ends_within_its_motion_has_not_settled():
    found = ending(lambda t: 1e-5 * t, end=10.0)
    assert found.status == "not settled"
    assert "before the planned motion ends at 20 s" in found.sentence
    assert ending(lambda t: 1e-9 * np.exp(2.0 * t), end=10.0).status == "growing"


def test_each_coordinate_has_its_own_tolerance():
    wide = dataclasses.replace(SCENARIO, tolerance={"base_rotation": 1.0, "joints": 1e-7})
    found = ending(lambda t: 0.5 * np.ones_like(t), scenario=wide)
    assert (found.status, found.coordinate) == ("not settled", "joint_1")


@pytest.mark.parametrize("samples", [1, 2, 3, 5])
def test_a_short_run_has_an_ending(samples):
    time = np.arange(samples) * PERIOD
    found = ending_of_completed(SCENARIO, time, tracked(np.zeros(samples)))
    assert found.status == "not settled"
