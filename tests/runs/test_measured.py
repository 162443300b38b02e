"""Captures of a target that is measured: the approach follows its estimate."""

import numpy as np
import pytest
from test_closing import CLOSING

from ffsm_drake import ScenarioError, load_scenario, simulate
from ffsm_drake.runs.metrics import phases_of

MEASURED = [
    *CLOSING,
    "duration=12",
    "reference.duration=6",
    "capture.approach.duration=5",
    "capture.measured={replan: 0.5, last: 1.0}",
    "capture.measured.sensor.dropouts=0.2",
]
APART = [f"capture.measured.filter.{name}_deviation=0.01" for name in ("rate", "velocity")]


def measured(*given):
    return simulate(load_scenario("tumbling_capture", [*MEASURED, *given]), check_stability=False)


def test_the_approach_meets_a_target_that_is_not_where_it_is_expected():
    record = measured(*APART, "capture.envelope={position: 0.02, angle: 0.05}")
    data = record.dataset
    assert "stop" in phases_of(data)
    # within three standard deviations, by and large
    images = slice(100, 400)
    error, known = data["target_error"].values[images], data["target_deviation"].values[images]
    assert np.mean(np.abs(error) < 3.0 * known) > 0.98
    assert 5.0 < record.metrics["target"]["nees"] < 30.0
    assert np.abs(data["error"].values[200:400]).max() < 0.02
    # a reference without jumps: its rates are those of its positions
    step = record.scenario.sample_time
    position = data["desired_position"].values[:400]
    speed = data["desired_velocity"].values[:400, 3:6]
    steps = np.diff(position[:, 4:7], axis=0) / step
    np.testing.assert_allclose(steps, 0.5 * (speed[1:] + speed[:-1]), atol=2e-4)


def test_needs_a_gripper_that_closes():
    with pytest.raises(ScenarioError, match=r"capture\.measured: needs capture\.closing"):
        load_scenario("tumbling_capture", ["capture.measured={}"])


@pytest.mark.slow
def test_a_target_that_is_not_seen_is_not_met():
    # Without a pose, the supervisor gives the approach up.
    record = measured("supervisor={}", "capture.measured.sensor.dropouts=0.999")
    assert record.ending.status == "missed"
    assert "given up" in record.outcome.message
