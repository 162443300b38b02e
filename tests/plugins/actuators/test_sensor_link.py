"""A lossy link of the sensors: the same receiver as of the actuators, on measurements."""

import numpy as np
import pytest
from c_code import needs_llvm
from compared_runs import check, of_seeds
from entry_points import needs
from event_queue import channel, delays_of, drawn_channel, received
from refusals import assert_refused

from ffsm_drake import load_scenario, simulate
from ffsm_drake.plugins.actuators.packets import packets_of
from ffsm_drake.plugins.actuators.sensor_link import LossyMeasurement
from ffsm_drake.systems.sampled import Now

STREAM = 0x11A3  # other draws than those of the actuators' link


@pytest.mark.smoke
@pytest.mark.parametrize("seed", range(12))
def test_measurements_are_those_of_an_event_queue(seed):
    """Of drawn channels: the measurement that is read, and whether it is new, at each sample."""
    draw, count, size = np.random.default_rng(seed), 300, 5
    link = drawn_channel(draw, seed)._replace(hold=np.inf, stream=STREAM)
    sent = draw.integers(2, size=size).astype(float)
    block = LossyMeasurement(channel=link, sent=sent, sample_time=0.01)
    states = draw.normal(size=(count + 1, size))
    first, states = states[0], states[1:]
    lost = packets_of(link, count).lost[:count]
    queue = (lost, delays_of(link, count), link.order, np.inf)
    sample = received(np.arange(1.0, count + 1.0), *queue).astype(int)  # 0: none
    memory, before = block.start(first), 0
    for now in range(count):
        time = Now(0.01 * now, phase=np.array(block.phase(now)))
        outputs, memory = block.step({"state": states[now]}, memory, time)
        shown = first if sample[now] == 0 else states[sample[now] - 1]
        expected = np.where(sent > 0.0, shown, states[now])
        assert np.array_equal(outputs["estimated_state"], expected)
        # a packet that acts again after another one is not in a link that keeps the order
        if link.order != "received":
            is_new = np.where(sent > 0.0, float(sample[now] != before), 1.0)
            assert np.array_equal(outputs["measurement_is_new"], is_new)
        before = sample[now]


def test_both_directions_have_draws_of_their_own():
    one = channel(3, drop_rate=0.5)
    other = one._replace(stream=STREAM)
    assert not np.array_equal(packets_of(one, 100).lost, packets_of(other, 100).lost)


LINK = "effects.sensor_link={drop_rate: 0.3, mean_burst: 3, delay: [0.0, 0.035]}"
USUAL = ["duration=0.4", "controller=pd_plus"]


def test_the_record_has_the_measurements_of_the_link():
    """Without noise, a run has the measured state of the sample at which the packet was sent."""
    exact = ["sensing.velocity_noise=0"]
    record = simulate(
        load_scenario("postcapture", [*USUAL, *exact, LINK]), check_stability=False, engine="drake"
    )
    data = record.dataset
    lost = data["measurement_lost"].values.ravel() > 0.0
    own = channel(0, most_delay=3.5, stream=STREAM)
    queue = lost, delays_of(own, lost.size), "kept", np.inf
    sample = received(np.arange(1.0, lost.size + 1.0), *queue).astype(int)
    at = np.maximum(sample - 1, 0)
    assert lost.any()
    assert (at < np.arange(lost.size)).any()
    velocity = data["velocity"].values
    assert np.array_equal(data["measured_velocity"].values[1:], velocity[at][1:])
    age = np.where(sample > 0, np.arange(1, lost.size + 1) - sample, 0) * 0.01
    assert data["measurement_age"].values.ravel() == pytest.approx(age)
    assert record.metrics["sensor_link"]["lost"] == pytest.approx(lost.mean())


COMPILED = {
    "bursts": [LINK],
    "joints": ["effects.sensor_link={drop_rate: 0.4, coordinates: [joints], order: received}"],
    "both directions": [LINK, "effects.link={drop_rate: 0.2, delay: [0, 0.02]}"],
    "kalman": [LINK, "controller=tdc", "estimator.kind=kalman"],
    "a frame": [
        LINK, "controller=task_time_delay", "estimator={kind: kalman, walk: 0.03}",
        "sensing.position_noise=1e-6",
        "controllers.task_time_delay={k_p_rotation: 25, k_p_position: 25, k_d_rotation: 10, "
        "k_d_position: 10}",
    ],
    "slow and late sensors": [LINK, "sensing.velocity_period=3", "sensing.delay=1"],
    "a fault": [LINK, "faults.events={stop: {unit: sensing.joint_2, kind: silent, time: 0.1}}"],
}  # fmt: skip


@needs("compiled")
@needs_llvm
@pytest.mark.long
@pytest.mark.parametrize("given", COMPILED.values(), ids=COMPILED.keys())
def test_compiled_runs_have_the_draws_of_drake(given):
    check(of_seeds("postcapture", [*USUAL, *given], [[]] * 2))


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        (["effects.sensor_link={drop_rate: 1}"], "effects.sensor_link.drop_rate: must be from 0"),
        (["effects.sensor_link={delay: 9}"], "effects.sensor_link.delay: must be at most 2 s"),
        (
            ["effects.sensor_link={coordinates: [joint_x]}"],
            "effects.sensor_link.coordinates.joint_x: unknown coordinate",
        ),
        (
            ["effects.sensor_link={}", "faults.detection={}"],
            "effects.sensor_link: cannot be combined with faults.detection",
        ),
    ],
)
def test_a_bad_link_is_refused(given, problem):
    assert_refused(problem, "postcapture", *given)
