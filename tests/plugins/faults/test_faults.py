"""Faults: each kind does what it says, what is drawn can break, and none costs nothing."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from scipy.spatial.transform import Rotation

from ffsm_drake import (
    ScenarioError,
    design,
    load_scenario,
    simulate,
    simulate_many,
    stability,
)
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.runs.exceeded_limits import run_remarks
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Fault, Faults, thrusters_of
from ffsm_drake.spacecraft.coordinates import position_error
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.faults import settle_faults

TIME = 0.2  # s
NAME = "thrusters_and_wheels"
LOADED = load_scenario(NAME)


def scenario_with(unit, kind, *overrides, time=TIME, **more):
    event = {"unit": unit, "kind": kind, "time": [time], **more}
    return load_scenario(NAME, ["duration=0.4", {"faults": {"events": {"it": event}}}, *overrides])


def run(*arguments, **more):
    """The log, and which of its samples have the fault."""
    log = make_rollout(scenario_with(*arguments, **more)).run()
    return log, log.time > TIME - 1e-9


@pytest.fixture(scope="module")
def whole():
    return make_rollout(load_scenario(NAME, ["duration=0.4"])).run()


@pytest.fixture(scope="module")
def coordinates():
    return make_nominal_plant(LOADED).coordinates


def test_no_fault_changes_no_bit(whole):
    log = make_rollout(load_scenario(NAME, ["duration=0.4", "faults={}"])).run()
    for name, values in whole.series.items():
        assert np.array_equal(values, log.series[name]), name


@pytest.mark.parametrize(
    ("unit", "kind"),
    [
        ("thrusters.a_x", "stuck_on"),
        ("wheels.wheel_1", "stops"),
        ("sensing.joint_2", "silent"),
        ("joints.joint_2", "jammed"),
    ],
)
def test_before_a_fault_nothing_differs(whole, unit, kind):
    log, broken = run(unit, kind)
    for name in ("state", "measurement", "applied_force"):
        assert np.array_equal(log.series[name][~broken], whole.series[name][~broken]), name
    assert not np.array_equal(log.series["state"], whole.series["state"])


@pytest.mark.parametrize(
    ("kind", "size", "least", "most"),
    [
        ("stuck_on", None, 1.0, 1.0),
        ("stuck_off", None, 0.0, 0.0),
        ("leaking", None, 0.2, 1.0),
        ("leaking", 0.7, 0.7, 1.0),
        ("weak", None, 0.0, 0.5),
        ("weak", 0.9, 0.0, 0.1),
    ],
)
def test_thrusters(kind, size, least, most):
    units = thrusters_of(LOADED.actuation.thrusters)
    for index, name in enumerate(list(units)[:2]):
        log, broken = run(f"thrusters.{name}", kind, "actuation.wheels=null", size=size)
        level = log.series["thruster_force"][:, index] / units[name].force
        assert level[broken].min() >= least - 1e-12
        assert level[broken].max() <= most + 1e-12
        # what pushes is the sum of them all
        directions = np.array([unit.direction for unit in units.values()])
        pushed = log.series["thruster_force"] @ directions
        turned = RotationMatrix(Quaternion(log.series["state"][0, :4])).matrix()  # hardly on
        assert log.series["applied_force"][:, 3:6] == pytest.approx(pushed @ turned.T, abs=0.05)


def test_the_law_hears_of_what_was_told_to_a_stuck_thruster():
    """An estimator that heard of the true force would take the fault out as if it knew it."""
    states = []
    for kind in ("stuck_on", "stuck_off"):
        log, broken = run("thrusters.a_x", kind, "actuation.wheels=null")
        first = np.flatnonzero(broken)[0]
        states.append(log.series["generalized_force"][: first + 1])
    assert np.array_equal(*states)


def test_a_wheel_that_stops():
    # by hand: a bearing that takes the motor's 1 N m takes 0.2 N m s in 20 samples
    turning = "actuation.wheels.units.wheel_1.initial_momentum=1.0"
    log, broken = run("wheels.wheel_1", "stops", turning, "duration=0.8")
    momentum = log.series["wheel_momentum"][:, 0]
    assert momentum[~broken].min() > 0.5
    assert np.all(log.series["wheel_torque"][broken, 0] == 0.0)
    braking = momentum[broken][:20]
    assert np.diff(braking) == pytest.approx(np.full(19, -0.01), rel=1e-9)
    log, broken = run("wheels.wheel_1", "stops")
    assert np.abs(log.series["wheel_momentum"][-5:, 0]).max() < 1e-3


@pytest.mark.parametrize("kind", ["frozen", "silent", "biased"])
@pytest.mark.parametrize(
    "sensor", ["base_rotation", "base_position", "joint_2", "base_rotation_velocity"]
)
def test_sensors(coordinates, sensor, kind):
    size = {"size": 0.3} if kind == "biased" else {}
    log, broken = run(f"sensing.{sensor}", kind, **size)
    nq, nv = len(coordinates.position_names), len(coordinates.names)
    measured, state = log.series["measurement"], log.series["state"]
    turns = [position_error(m, s) for m, s in zip(measured[:, :nq], state[:, :nq], strict=True)]
    error = np.hstack([turns, measured[:, nq:] - state[:, nq:]])
    name = sensor.removesuffix("_velocity")
    at = [index for index, each in enumerate(coordinates.names) if each.startswith(name)]
    entries = np.array(at) + (nv if sensor != name else 0)
    others = np.delete(np.arange(2 * nv), entries)
    assert np.abs(error[:, others]).max() < 0.01
    if kind == "biased":
        off = error[broken][:, entries]
        if len(at) == 3:  # of the base, in its axes
            off = Rotation.from_quat(state[broken][:, [1, 2, 3, 0]]).inv().apply(off)
        assert off.mean(axis=0) == pytest.approx(0.3 / np.sqrt(len(at)), abs=0.003)
        return
    columns = np.arange(4) if entries[0] == 0 else entries + 1
    last = measured[~broken][-1, columns]
    assert np.all(measured[broken][:, columns] == last)


@pytest.mark.smoke
def test_a_sensor_that_falls_silent_says_so():
    """An estimator that hears of it goes on without it; a frozen one it believes."""
    kalman = ("estimator.kind=kalman", "sensing.position_period=2")
    ends = {}
    for kind in ("silent", "frozen"):
        log, _ = run("sensing.joint_2_velocity", kind, *kalman)
        ends[kind] = log.series["generalized_force"]
    assert not np.array_equal(ends["silent"], ends["frozen"])


def test_a_jammed_joint(coordinates):
    log, _ = run("joints.joint_2", "jammed", "duration=0.6", time=0.3)
    rate = log.series["state"][:, len(coordinates.position_names) + 6 + 1]
    at = int(np.searchsorted(log.time, 0.3 - 1e-9))
    assert abs(rate[at]) > 1e-6
    # it stops with a time constant of 0.02 s, of two steps of the integrator, whatever else acts
    assert rate[at + 4] == pytest.approx(rate[at] * np.exp(-2.0), rel=0.03)
    assert np.abs(rate[-5:]).max() < 1e-4 * abs(rate[at])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31 - 1), st.sampled_from(["any", "thrusters", "wheels", "sensing"]))
def test_what_is_drawn_can_break(coordinates, seed, unit):
    faults = Faults(events={"it": Fault(unit=unit, time=[1.0, 5.0])}, seed=seed)
    scenario = dataclasses.replace(LOADED, faults=faults)
    drawn = settle_faults(scenario, coordinates)
    assert drawn == settle_faults(scenario, coordinates)
    assert drawn == settle_faults(drawn, coordinates)  # what is settled stays
    fault = drawn.faults.events["it"]
    assert unit in ("any", fault.unit.partition(".")[0])
    assert 1.0 <= fault.time[0] <= 5.0
    assert "any" not in (fault.unit, fault.kind)


@pytest.mark.parametrize(
    ("given_", "said"),
    [
        ({"unit": "thrusters.a_q"}, "no 'thrusters.a_q' breaks here"),
        ({"unit": "wheels", "kind": "leaking"}, "'leaking' is no fault of wheels"),
        ({"unit": "joint_2", "kind": "silent"}, "did you mean 'sensing.joint_2'"),
        ({"unit": "joint_2", "kind": "jammed"}, "did you mean 'joints.joint_2'"),
    ],
)
def test_what_cannot_break(coordinates, given_, said):
    scenario = LOADED.replace(faults={"events": {"it": given_}})
    with pytest.raises(ScenarioError, match=said):
        settle_faults(scenario, coordinates)


@pytest.mark.parametrize("ask", [simulate, stability, verdict, design])
@pytest.mark.parametrize("unit", ["thrusters.a_q", "wheels.wheel_9", "sensing.joint_9", "joint_1"])
def test_a_wrong_name_shows_before_anything_takes_time(monkeypatch, ask, unit):
    def refused(*arguments, **more):
        raise AssertionError("linearised")

    for method in ("at", "along", "follow"):
        monkeypatch.setattr(Linearizer, method, refused)
    with pytest.raises(ScenarioError, match=f"no '{unit}' breaks here"):
        ask(LOADED.replace(faults={"events": {"it": {"unit": unit}}}))


@pytest.mark.parametrize(
    ("name", "faults", "said"),
    [
        (NAME, {"events": {"it": {"time": [3.0, 1.0]}}}, "must not end before it begins"),
        (NAME, {"events": {"it": {"time": [1e4]}}}, "is after the end of the run"),
    ],
)
def test_refused(name, faults, said):
    with pytest.raises(ScenarioError, match=said):
        load_scenario(name).replace(faults=faults)


@pytest.mark.slow
def test_many_runs_are_those_alone_and_a_run_says_what_broke():
    scenario = scenario_with("thrusters.a_x", "leaking")
    alone = simulate(scenario)
    for record in simulate_many([scenario, scenario]):
        assert record.dataset.equals(alone.dataset)
    assert "thrusters.a_x: leaking since 0.20 s" in run_remarks(alone)
    cut = dataclasses.replace(alone, dataset=alone.dataset.isel(time=slice(0, 15)))
    assert not any("leaking" in remark for remark in run_remarks(cut))


@pytest.mark.slow
def test_what_breaks_in_the_approach_stays_so_with_the_target_held():
    event = {"unit": "sensing.joint_2", "kind": "frozen", "time": [2.9]}
    overrides = ["capture.approach.duration=3", "duration=5", {"faults": {"events": {"it": event}}}]
    log = make_rollout(load_scenario("tumbling_capture", overrides)).run()
    broken = log.time > 2.9 - 1e-9
    column = list(log.coordinates.position_names).index("joint_2")
    assert log.time[-1] > 3.1  # beyond the grasp
    assert np.all(
        log.series["measurement"][broken, column] == log.series["measurement"][289, column]
    )
    assert np.ptp(log.series["state"][broken, column]) > 1e-3


def test_runs_of_several_seeds_have_their_own_drawn_faults():
    given = ["duration=0.1", "faults.events={stop: {unit: wheels, kind: stops, time: [0.04]}}"]
    scenarios = [load_scenario(NAME, [f"random_seed={seed}", *given]) for seed in range(3)]
    for scenario, record in zip(scenarios, simulate_many(scenarios), strict=True):
        alone = simulate(scenario, check_stability=False)
        assert record.dataset.drop_attrs().equals(alone.dataset.drop_attrs())
