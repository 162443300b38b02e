"""Runs whose gripper closes over a time: outcomes, and what follows a target that gets away."""

import gc
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from near_captures import SHORT

from ffsm_drake import ScenarioError, load_scenario, simulate
from ffsm_drake.plugins.capture.closing import Closing
from ffsm_drake.plugins.capture.contact import coast
from ffsm_drake.plugins.capture.free_body import Target
from ffsm_drake.plugins.capture.modes import Mode
from ffsm_drake.plugins.capture.phases import retreat
from ffsm_drake.runs.metrics import phases_of

CLOSING = ["duration=6", *SHORT, "capture.closing={}"]


def closed(*given: str):
    return simulate(load_scenario("tumbling_capture", [*CLOSING, *given]), check_stability=False)


@pytest.mark.long
def test_a_target_is_drawn_in_and_captured():
    record = closed("capture.closing.preload=50")
    data = record.dataset
    counts = {name: part.sizes["time"] for name, part in phases_of(data).items()}
    assert counts == {"approach": 100, "closing": 100, "stop": 401}
    assert record.ending.status != "growing"
    assert np.abs(data["error"].values[-100:]).max() < 2e-3
    offset = np.linalg.norm(data["gripper_offset"].values[:, 3:], axis=1)
    assert offset[101] > 0.01
    assert offset[198] < 0.2 * offset[101]  # the springs have centred it
    assert not data["contact_force"].values[:100].any()
    assert not data["contact_force"].values[200:].any()
    # action is reaction: with the target, momentum is that of the external forces
    for size in record.metrics["momentum_residual"].values():
        assert size < 1e-5
    gripper = record.metrics["gripper"]
    assert gripper["closings"] == 1
    assert 0.0 < gripper["peak_force"] <= 2.0 * 0.3 * 50.0 * 1.001
    assert record.grasp["miss"]["velocity"] < 0.01
    # what is measured at the grasp is where the stop begins
    assert np.abs(data["error"].values[200]).max() < 1e-3


@pytest.mark.long
def test_a_weak_gripper_lets_it_slip_and_the_servicer_retreats():
    again = "capture.retreat={tries: 1, duration: 3, distance: 0.05}"
    record = closed("capture.closing.preload=0.1", again)
    assert record.ending.status == record.outcome.status == "slipped"
    assert record.ending.is_failure
    assert record.grasp is None
    data = record.dataset
    assert list(phases_of(data)) == ["approach", "closing", "retreat"]
    apart = data["target_position"].values - data["position"].values[:, 4:7]
    moved = np.linalg.norm(apart, axis=1)
    assert moved[-1] > moved[200] + 0.04
    # the target drifts freely after the contact
    drift = np.diff(data["target_position"].values[200:], n=2, axis=0)
    assert np.abs(drift).max() < 1e-5
    for size in record.metrics["momentum_residual"].values():
        assert size < 1e-5


def test_a_missed_target_is_left_at_once():
    record = closed("capture.envelope.position=0.01")
    assert record.outcome.status == "missed"
    assert record.outcome.time == record.dataset["time"].values[-1] == 0.99
    assert record.metrics["gripper"] == {"closings": 0, "peak_force": 0.0, "peak_torque": 0.0}


@pytest.mark.slow
def test_the_loops_of_a_run_are_freed():
    def alive():
        gc.collect()
        return sum(isinstance(each, Closing) for each in gc.get_objects())

    before = alive()
    again = "capture.retreat={tries: 1, duration: 1, distance: 0.05}"
    record = closed("capture.envelope.position=0.01", again)
    assert list(phases_of(record.dataset)) == ["approach", "retreat"]
    assert alive() == before


@pytest.mark.long
def test_the_second_try_captures_what_a_push_made_the_first_one_miss():
    file = Path(__file__).parents[3] / "docs" / "animate.py"
    spec = importlib.util.spec_from_file_location("animate", file)
    animate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(animate)
    record = animate.missed_at_first("supervisor={}")
    phases = phases_of(record.dataset)
    assert list(phases) == ["approach", "retreat", "approach_2", "closing_2", "stop"]
    assert record.outcome.completed
    assert record.metrics["gripper"]["closings"] == 1
    assert np.abs(record.dataset["error"].values[-100:]).max() < 2e-3
    # the supervisor takes the empty gripper for what it is, at whatever time
    modes = {name: set(part["mode"].values.ravel()) for name, part in phases.items()}
    stop = modes.pop("stop")
    assert set.union(*modes.values()) == {Mode.APPROACH}
    assert stop == {Mode.GRASP, Mode.STOP, Mode.HOLD}


@pytest.mark.parametrize(
    ("given", "key"),
    [
        ("capture.closing.time=0.123", "capture.closing"),
        ("capture.closing.hold=30", "capture.closing"),
        ("capture.closing.axis=[0, 0, 0]", "capture.closing.axis"),
        ("capture.retreat={tries: 0}", "capture.retreat.tries"),
    ],
)
def test_settings_that_cannot_be(given, key):
    with pytest.raises(ScenarioError, match=key):
        load_scenario("tumbling_capture", [*CLOSING, given])


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


@pytest.mark.long
def test_the_approach_meets_a_target_that_is_not_where_it_is_expected():
    record = measured(*APART, "capture.envelope={position: 0.02, angle: 0.05}")
    data = record.dataset
    assert "stop" in phases_of(data)
    # within three standard deviations, by and large
    images = slice(100, 400)
    error, known = data["target_error"].values[images], data["target_deviation"].values[images]
    assert np.mean(np.abs(error) < 3.0 * known) > 0.95
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
    assert "abandoned" in record.outcome.message


@pytest.mark.long
def test_the_next_try_goes_by_the_estimate_alone(monkeypatch):
    """Nothing that is planned after a miss knows the target's true inertia and centre of mass."""
    found = []

    def planned(now, start, first):
        found.append((now.own.known, now.own.path, now.sample, now.own.scenario))

    monkeypatch.setattr(retreat, "next_try", planned)
    # unlike the nominal one, and turning fast enough to tell
    record = measured(
        "duration=24",
        "capture.envelope.position=1e-4",
        "capture.retreat={tries: 2, duration: 2}",
        "capture.rate=[0.12, -0.1, 0.14]",
        "payload.truth.inertia=[4.0, 9.0, 12.0, 0, 0, 0]",
        "payload.truth.center_of_mass=[0.2, -0.1, 0.3]",
    )
    assert record.outcome.status == "missed"
    [(known, path, sample, scenario)] = found
    now, last = known.motion[sample], known.motion[-1]
    assert np.abs(now - path[sample]).max() > 1e-4
    time, samples = sample * scenario.sample_time, len(path) - sample
    by_truth = coast(scenario, now, time=time, samples=samples, onward=True)[-1]
    unlike = np.abs(by_truth - last).max()
    estimate = Target.from_motion(now, scenario.payload.nominal)
    assert unlike > 0.005  # rad: planned by the truth, it would be rounding
    assert not np.allclose(known.arm, scenario.payload.truth.center_of_mass, atol=1e-4)
    assert not np.allclose(known.arm, estimate.arm, atol=1e-4)  # it learned
