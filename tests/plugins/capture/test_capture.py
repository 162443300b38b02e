"""Runs through a grasp: what is carried over it, what is recorded, and what the record keeps of
mechanics.
"""

import dataclasses

import numpy as np
import pytest
from near_captures import SHORT
from numpy.testing import assert_allclose
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from ffsm_drake import RunRecord, load_scenario, override_scenario, simulate
from ffsm_drake.common.errors import FfsmError
from ffsm_drake.common.numbers import number
from ffsm_drake.mission import make_mission
from ffsm_drake.plugins.analysis import analyze
from ffsm_drake.plugins.capture.contact import coast, planned_contact
from ffsm_drake.plugins.capture.grasping import seen_from
from ffsm_drake.plugins.capture.page import grasp_of
from ffsm_drake.runs.dataset import make_table
from ffsm_drake.runs.metrics import momentum_residual, phases_of
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.runs.simulate import make_record
from ffsm_drake.scenario import NOTHING, MassProperties, Payload, Scenario
from ffsm_drake.show.results import results_of
from ffsm_drake.spacecraft.craft import make_nominal_plant, make_true_plant
from ffsm_drake.spacecraft.mass_properties import set_payload, spatial_inertia
from ffsm_drake.systems.controllers import make_law

SCENARIO = load_scenario("tumbling_capture", ["duration=6", *SHORT])
GRASP = 200  # the sample


@pytest.fixture(scope="module")
def rollout():
    return make_rollout(SCENARIO)


@pytest.fixture(scope="module")
def log(rollout):
    return rollout.run()


@pytest.fixture(scope="module")
def record(log):
    return make_record(log, start=0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["sensing.position_bias={base_position_x: 0.3}"], "position 0.1"),
        (["sensing.position_bias={base_rotation_x: 0.2}"], "angle 0."),
        (["capture.envelope.velocity=1e-6"], "velocity "),
        (["capture.envelope.angular_velocity=1e-7"], "angular_velocity "),
    ],
)
def test_a_target_beyond_the_envelope_is_missed(given, words):
    missed = simulate(override_scenario(SCENARIO, given), check_stability=False)
    assert missed.ending.status == missed.outcome.status == "missed"
    assert missed.ending.is_failure
    assert f"{words}" in missed.ending.sentence
    assert "capture.envelope." in missed.ending.sentence
    assert missed.grasp is None
    assert set(missed.dataset["phase"].values.tolist()) == {"approach"}
    wide = "capture.envelope={position: null, angle: null, velocity: null, angular_velocity: null}"
    held = simulate(override_scenario(SCENARIO, [*given, wide]), check_stability=False)
    assert held.outcome.status != "missed"
    assert "stop" in held.dataset["phase"].values.tolist()


def test_one_run_goes_through_the_grasp(log, record):
    data = record.dataset
    assert record.outcome.message == "completed 6 s"
    assert_allclose(data["time"].values, 0.01 * np.arange(601), atol=1e-12)
    assert data["phase"].values.tolist() == ["approach"] * GRASP + ["stop"] * 401
    assert np.array_equal(data["velocity"].values[GRASP], log.grasp.contact.grasp.velocity)
    assert np.array_equal(data["position"].values[GRASP], log.grasp.contact.q)
    jump = np.abs(np.diff(data["velocity"].values, axis=0))[GRASP - 1]
    usual = np.abs(np.diff(data["velocity"].values[: GRASP - 20], axis=0)).max(axis=0)
    assert jump[8] > 10.0 * usual[8]  # as nowhere else
    # It comes to rest: within flight_sensors' noise.
    assert np.abs(data["velocity"].values[-50:]).max() < 2e-3
    assert np.abs(data["error"].values[-50:, 3:6]).max() < 1e-3


def test_momentum_is_that_of_both_on_both_sides(record):
    data, ledger = record.dataset, record.grasp
    for name in ("linear_momentum", "angular_momentum", "spin"):
        before, after = np.array(ledger["before"][name]), np.array(ledger["after"][name])
        assert np.linalg.norm(after - before) <= 1e-12 * np.linalg.norm(before)
        assert np.linalg.norm(before) > 0.05
    assert ledger["after"]["kinetic_energy"] < ledger["before"]["kinetic_energy"]
    # The record's sums agree with it, from each side; between two samples the thrusters give a
    # little.
    for name in ("linear_momentum", "angular_momentum"):
        values = data[name].values
        assert_allclose(values[GRASP], ledger["after"][name], rtol=1e-12)
        force = np.abs(data["generalized_force"].values[GRASP - 1, :6]).max()
        assert np.linalg.norm(values[GRASP] - values[GRASP - 1]) < 0.01 * 6 * (force + 0.5)
    energy = data["kinetic_energy"].values
    assert energy[GRASP] == pytest.approx(ledger["after"]["kinetic_energy"], rel=1e-12)
    assert energy[GRASP - 1] == pytest.approx(ledger["before"]["kinetic_energy"], rel=1e-2)
    assert len(phases_of(data)) == 2
    residuals = [momentum_residual(part) for part in phases_of(data).values()]
    for name, size in record.metrics["momentum_residual"].items():
        assert size == max(np.linalg.norm(residual[name], axis=1).max() for residual in residuals)
        assert size < 1e-6


def test_the_ledger_counts_the_wheels(run):
    """No torque acts on a wheel about its axis at the grasp: its momentum is the same on both sides
    of it.
    """
    units = (
        "{x: {axis: [1, 0, 0], initial_momentum: 3}, y: {axis: [0, 1, 0]}, z: {axis: [0, 0, 1]}}"
    )
    record = run("tumbling_capture", *SHORT, "duration=2.2", f"actuation.wheels={{units: {units}}}")
    data, ledger = record.dataset, record.grasp
    stored = np.array(ledger["stored_momentum"])
    assert np.linalg.norm(stored) > 1.0
    assert np.array_equal(stored, data["stored_momentum"].values[GRASP])
    # The ledger's is that of the bodies, to which the record's adds what is stored.
    assert_allclose(
        data["angular_momentum"].values[GRASP],
        np.array(ledger["after"]["angular_momentum"]) + stored,
        rtol=1e-12,
    )
    for name in ("angular_momentum", "spin"):
        assert_allclose(ledger["after"][name], ledger["before"][name], atol=1e-12)
    # Between two samples torques and forces of a few N m and N act.
    change = data["angular_momentum"].values[GRASP - 1] - stored
    change -= ledger["before"]["angular_momentum"]
    assert np.linalg.norm(change) < 0.2
    section = grasp_of(results_of([record])[0])
    assert section["budget"][0].startswith("Momentum after the planned grasp: ")
    rows = {row[0]: row[1:3] for row in section["ledger"]}
    assert (
        rows["Stored in actuators, in addition [N m s]"]
        == [", ".join(number(each) for each in stored)] * 2
    )


def test_the_target_tumbles_freely_up_to_the_grasp(record):
    data = record.dataset.isel(time=slice(GRASP))
    # Alike about every axis, it turns about a fixed one, and its centre rests.
    assert_allclose(
        data["target_position"].values,
        data["target_position"].values[:1] + np.zeros((GRASP, 3)),
        atol=1e-12,
    )
    turns = Rotation.from_quat(data["target_quaternion"].values, scalar_first=True)
    w = turns[0].apply(SCENARIO.capture.rate)
    expected = Rotation.from_rotvec(np.outer(data["time"].values, w)) * turns[0]
    assert (expected * turns.inv()).magnitude().max() < 1e-9
    # It is met where it is, but for what the arm misses it by, which stays.
    pose = record.dataset.isel(time=[GRASP - 1, GRASP])
    step = np.diff(pose["target_position"].values, axis=0)[0]
    assert np.linalg.norm(step) == pytest.approx(record.grasp["miss"]["position"], rel=1e-6)
    assert 1e-6 < record.grasp["miss"]["position"] < 3e-3
    assert 1e-6 < record.grasp["miss"]["angle"] < 3e-3


def test_what_the_arm_misses_by_stays_in_the_payload(log):
    model = make_true_plant(
        dataclasses.replace(
            SCENARIO, payload=dataclasses.replace(SCENARIO.payload, truth=log.grasp.payload)
        )
    )
    model.plant.SetPositions(model.context, log.grasp.contact.q)
    body = model.plant.GetBodyByName("debris")
    place = body.EvalPoseInWorld(model.context) @ np.array(log.grasp.payload.center_of_mass)
    assert_allclose(place, log.grasp.target[-1, 4:7], atol=1e-12)


@pytest.mark.smoke
def test_mass_properties_in_another_frame():
    properties = MassProperties(
        mass=3.0, center_of_mass=[0.1, -0.2, 0.3], inertia=[1.0, 1.2, 1.4, 0.1, -0.05, 0.2]
    )
    X_QP = RigidTransform(
        RotationMatrix(Rotation.from_rotvec([0.3, -0.5, 0.7]).as_matrix()), [0.4, 0.1, -0.2]
    )
    moved = spatial_inertia(properties).ReExpress(X_QP.rotation()).Shift(-X_QP.translation())
    assert_allclose(
        spatial_inertia(seen_from(properties, X_QP)).CopyToFullMatrix6(),
        moved.CopyToFullMatrix6(),
        atol=1e-12,
    )


def test_a_free_target_keeps_its_momentum_and_energy():
    properties = MassProperties(
        mass=50.0, center_of_mass=[0.2, -0.1, 0.3], inertia=[12.0, 9.0, 7.0, 1.5, -0.8, 0.6]
    )
    X_WP = RigidTransform(
        RotationMatrix(Rotation.from_rotvec([0.2, 0.4, -0.9]).as_matrix()), [1.0, 2.0, 3.0]
    )
    twist = np.array([0.1, -0.2, 0.15, 0.02, 0.01, -0.03])
    scenario = Scenario(payload=Payload(truth=properties), sample_time=0.01)
    at_grasp = [*X_WP.rotation().ToQuaternion().wxyz(), *X_WP.translation()]
    states = coast(scenario, np.array([*at_grasp, *twist]), time=10.0, samples=1000)
    assert states.shape == (1000, 13)

    def kept(q, v):
        turn = RotationMatrix(Rotation.from_quat(q[:4], scalar_first=True).as_matrix())
        momentum = spatial_inertia(properties).ReExpress(turn).CopyToFullMatrix6() @ v
        return [*(momentum[:3] + np.cross(q[4:], momentum[3:])), *momentum[3:], momentum @ v]

    expected = kept(np.array(at_grasp), twist)
    for state in states[::111]:
        assert_allclose(kept(state[:7], state[7:]), expected, rtol=1e-7)
    assert np.ptp(states[:, 7]) > 0.02  # it tumbles
    # One sample after the last it is at the grasp.
    last = states[-1]
    assert_allclose(last[4:7] + 0.01 * twist[3:], at_grasp[4:], atol=1e-5)


def test_the_first_force_after_the_grasp_is_no_other_than_before(log):
    force = log.generalized_force
    steps = np.abs(force[GRASP] - force[GRASP - 1])
    # 0.1 N m on the bare wrist is 25 rad/s^2; taken for an acceleration of wrist and target it
    # would be 1000 N m.
    assert steps.max() < 5.0
    assert np.abs(force[GRASP : GRASP + 100]).max() < 8.0


@pytest.mark.parametrize("controller", ["tdc", "asmc", "aismc", "computed_torque"])
def test_every_controller_goes_through_the_grasp(controller):
    # One without an estimate holds nothing against 0.1 N m on the bare wrist, and feels the noise
    # as it is.
    overrides = ["disturbance.amplitude_scale=0", f"controller={controller}", "duration=2.5"]
    gains = "{k_d: 14, k_s: 14}" if controller == "asmc" else "{k_d: 10, k_p: 25}"
    overrides += [f"controllers.{controller}={gains}"]
    overrides += (
        ["sensing.velocity_noise=1e-6", "sensing.position_noise=1e-6"]
        if controller == "computed_torque"
        else []
    )
    overrides += (
        ["controllers.aismc.k_s_initial=5", "controllers.aismc.k_s_max=5"]
        if controller == "aismc"
        else []
    )
    log = make_rollout(override_scenario(SCENARIO, overrides)).run()
    assert log.outcome.completed
    assert log.time.size == 251
    assert np.abs(log.generalized_force[GRASP:]).max() < 15.0


ESTIMATORS = {"kalman": [], "late": ["sensing.delay=2"], "coupled": ["estimator.kind=coupled"]}


@pytest.mark.parametrize("kind", ESTIMATORS)
@pytest.mark.parametrize("controller", ["tde_aismc", "aismc", "asmc"])
def test_accelerations_go_on_as_the_forces_that_they_took(kind, controller):
    scenario = override_scenario(
        SCENARIO, ["estimator.kind=kalman", f"controller={controller}", *ESTIMATORS[kind]]
    )
    held = make_nominal_plant(scenario)
    alone = make_nominal_plant(scenario)
    set_payload(alone.plant, alone.context, body="debris::debris", properties=NOTHING)
    after, before = make_law(make_mission(scenario), held), make_law(make_mission(scenario), alone)
    rng = np.random.default_rng(4)
    state = {
        name: rng.uniform(0.1, 1.0, np.shape(value))
        for name, value in before.initial_state().items()
    }
    contact = planned_contact(make_mission(scenario), make_true_plant(scenario))
    q, v_d = contact.q, contact.grasp.velocity
    new = after.resume(state, before, np.concatenate([q, v_d]))
    assert set(new) == set(state)
    H, H_alone = held.calc_mass_matrix(q), alone.calc_mass_matrix(q)
    # the same force, the same momentum
    for name in ("estimated_negative_n", "estimated_error_rate"):
        assert_allclose(H @ new[name], H_alone @ state[name], rtol=1e-9)
    assert np.array_equal(new["estimated_error"], state["estimated_error"])
    if "integral_error" in state:
        scale = after.dynamics.k_p * state["reaching_gain"]
        assert_allclose(
            H @ (scale * new["integral_error"]),
            H_alone @ (scale * state["integral_error"]),
            rtol=1e-9,
        )
    if "switching_gain" in state:  # bounds every force that it bounded before
        signs = rng.choice([-1.0, 1.0], (100, 11))
        needed = np.linalg.solve(H, H_alone @ (signs * state["switching_gain"]).T).T
        assert (np.abs(needed) <= new["switching_gain"] * (1 + 1e-9)).all()
    if kind == "late":
        # The last sample's errors were made with the velocity before: they count from the one
        # after.
        past = new["past"].reshape(2, 11, 2)
        jump = v_d - state["delayed_desired_velocity"]
        assert_allclose(past[1, :, 0], state["estimated_error_rate"] + jump, rtol=1e-12)


def test_late_sensors_bring_what_was_before_the_grasp():
    settings = [
        "sensing.delay=3",
        "estimator.kind=kalman",
        "disturbance.amplitude_scale=0",
        "controller=tdc",
    ]
    settings += ["controllers.tdc={k_d: 6, k_p: 9}", "duration=3", "estimator.walk=0.01"]
    log = make_rollout(override_scenario(SCENARIO, settings)).run()
    assert log.outcome.completed
    velocity = slice(12, 23)
    before = log.series["state"][GRASP - 3, velocity]
    assert_allclose(log.series["measurement"][GRASP, velocity], before, atol=5e-3)
    assert np.abs(log.generalized_force[GRASP : GRASP + 30]).max() < 10.0


@pytest.mark.long
def test_a_run_has_the_bits_of_a_fresh_build(rollout, log):
    other = override_scenario(SCENARIO, ["random_seed=5", "duration=2.5"])
    assert rollout.accepts(other)
    changed = rollout.run(other)
    again = rollout.run()
    fresh = make_rollout(other).run()
    for one, same in ((again, log), (changed, fresh)):
        assert all(np.array_equal(one.series[name], values) for name, values in same.series.items())
    assert not np.array_equal(changed.error, log.error[: changed.error.shape[0]])
    heavy = override_scenario(SCENARIO, ["payload.truth.mass=120", "duration=2.2"])
    assert rollout.accepts(heavy)
    one, same = rollout.run(heavy), make_rollout(heavy).run()
    assert all(np.array_equal(one.series[name], values) for name, values in same.series.items())
    assert not rollout.accepts(override_scenario(SCENARIO, ["payload.nominal.mass=90"]))


def test_another_centre_of_mass_needs_another_plan():
    scenario = load_scenario(
        "tumbling_capture", ["capture.approach=null", "controller=tdc", "duration=0.05"]
    )
    with_truth = lambda **values: dataclasses.replace(  # noqa: E731
        scenario,
        payload=dataclasses.replace(
            scenario.payload, truth=dataclasses.replace(scenario.payload.truth, **values)
        ),
    )
    rollout = make_rollout(scenario)
    assert rollout.accepts(with_truth(mass=120.0))
    moved = with_truth(center_of_mass=[0.1, 0.0, 0.0])
    assert not rollout.accepts(moved)  # the grasped point of the target moves otherwise
    start = make_rollout(moved).run().series["desired_state"][0]
    assert np.abs(start - rollout.run().series["desired_state"][0]).max() > 1e-4


@pytest.mark.smoke
def test_without_an_approach_it_begins_with_the_grasp():
    scenario = override_scenario(
        SCENARIO, ["capture.approach=null", "duration=1", "initial_velocity.joint_2=0.001"]
    )
    record = simulate(scenario, check_stability=False)
    contact = planned_contact(make_mission(scenario), make_true_plant(scenario))
    assert set(record.dataset["phase"].values.tolist()) == {"stop"}
    expected = contact.grasp.velocity + 1e-3 * (np.arange(11) == 7)
    assert_allclose(record.dataset["velocity"].values[0], expected, atol=1e-15)
    planned = planned_contact(make_mission(scenario), make_nominal_plant(scenario)).grasp.velocity
    assert_allclose(record.dataset["desired_velocity"].values[0], planned, atol=1e-15)
    assert np.abs(planned - contact.grasp.velocity).max() > 1e-4  # which the controller is not told
    assert record.grasp["time"] == 0.0
    assert record.grasp["miss"]["position"] == 0.0


def test_braked_joints_stop_at_the_grasp():
    scenario = override_scenario(
        SCENARIO, ["capture.approach=null", "duration=0.5", "capture.joints=braked"]
    )
    record = simulate(scenario, check_stability=False)
    assert not record.dataset["velocity"].values[0, 6:].any()
    assert set(record.grasp["brake_impulse"]) == {f"joint_{i}" for i in range(1, 6)}
    assert np.abs(record.dataset["velocity"].values[0, :6]).max() > 1e-4


def test_a_run_that_diverges_before_the_grasp(tmp_path):
    scenario = override_scenario(SCENARIO, ["divergence_speed=0.1"])
    record = simulate(scenario, check_stability=False)
    assert record.outcome.status == "diverged"
    assert record.outcome.time < 2.0
    assert set(record.dataset["phase"].values.tolist()) == {"approach"}
    assert record.grasp is None
    loaded = RunRecord.load(record.save(tmp_path))
    assert loaded.grasp is None
    assert loaded.dataset.identical(record.dataset)
    with pytest.raises(FfsmError, match="the run ended before the grasp"):
        analyze(record)


def test_a_record_keeps_the_grasp(record, tmp_path):
    loaded = RunRecord.load(record.save(tmp_path))
    assert loaded.grasp == record.grasp
    assert loaded.metrics == record.metrics
    assert set(loaded.metrics["phases"]) == {"approach", "stop"}
    stop = loaded.metrics["phases"]["stop"]
    effort = np.abs(record.dataset["generalized_force"].values[GRASP:])
    assert stop["peak_effort"]["joints"] == effort[:, 6:].max()
    assert stop["isv"] == pytest.approx(0.01 * (effort[:-1] ** 2).sum(), rel=1e-12)


def test_findings_are_about_the_stop(record):
    analysis = analyze(record)
    assert analysis.series["time"].values[0] == 2.0
    momentum = next(finding for finding in analysis.findings if "momentum" in finding.key)
    assert momentum.verdict == "holds"


@pytest.mark.slow
def test_an_automatic_duration_is_recorded_as_it_was():
    scenario = override_scenario(
        SCENARIO, ["capture.approach=null", "duration=0.2", "reference.duration=auto"]
    )
    record = simulate(scenario, check_stability=False)
    assert scenario.reference.duration is None
    assert 0.1 < record.scenario.reference.duration < 3.0
    again = simulate(record.scenario, check_stability=False)
    assert again.dataset.identical(record.dataset)
    assert make_table(make_rollout(scenario).run()).to_dataset().identical(record.dataset)
