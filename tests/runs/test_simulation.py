"""Runs and their records: alignment, reproducibility, saving, early ends, physics balances."""

import json

import netCDF4
import numpy as np
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw
from scipy.spatial.transform import Rotation

from ffsm_drake import (
    ControlLaw,
    RunRecord,
    load_scenario,
    make_nominal_plant,
    override_scenario,
    simulate,
)
from ffsm_drake.mission import make_mission
from ffsm_drake.spacecraft.coordinates import error_rate, position_error
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import base_rpy, make_plant


@pytest.mark.parametrize("of", ["position", "measured_position", "desired_position"])
def test_positions_come_apart_by_name_and_unit(run, tmp_path, of):
    record = run("postcapture")
    record.save(tmp_path)
    whole = record.dataset[of]
    for parts in (record.positions(of), RunRecord.load(tmp_path).positions(of)):
        for name, values in parts["joint_position"].to_series().unstack().items():
            assert np.array_equal(values, whole.sel(position_name=name))
        assert set(parts["joint_position"]["unit"].values) == {"rad"}
        for axis in "xyz":
            along = parts["base_position"].sel(axis=axis)
            assert np.array_equal(along, whole.sel(position_name=f"base_position_{axis}"))
        for part in "wxyz":
            turn = parts["base_quaternion"].sel(quaternion=part)
            assert np.array_equal(turn, whole.sel(position_name=f"base_quaternion_{part}"))
    assert "\n" not in repr(record)
    assert repr(record.scenario) in repr(record)


@pytest.mark.smoke
def test_dataset_is_labelled_and_complete(run):
    data = run("postcapture").dataset
    assert data.sizes == {"time": 2001, "position_name": 12, "coordinate": 11, "axis": 3}
    assert data["time"].values == pytest.approx(0.01 * np.arange(2001), abs=1e-9)
    assert data["coordinate"].values[0] == "base_rotation_x"
    assert set(data.data_vars) == {
        "position",
        "velocity",
        "measured_position",
        "measured_velocity",
        "desired_position",
        "desired_velocity",
        "desired_acceleration",
        "error",
        "error_rate",
        "generalized_force",
        "applied_force",
        "disturbance_force",
        "sliding_variable",
        "reaching_gain",
        "switching_gain",
        "end_effector_position",
        "desired_end_effector_position",
        "base_rpy",
        "desired_base_rpy",
        "linear_momentum",
        "angular_momentum",
        "kinetic_energy",
    }
    for name, variable in data.data_vars.items():
        assert variable.attrs["units"], name
        assert variable.attrs["long_name"], name
        assert np.isfinite(variable.values).all(), name


@pytest.mark.parametrize("controller", ["tdc", "asmc", "aismc", "tde_aismc"])
def test_every_sample_satisfies_the_control_law(run, controller):
    """Recomputing the law from the recorded measurements gives the recorded force: the record is
    aligned.
    """
    from ffsm_drake.systems.controllers import make_law

    record = run("postcapture", f"controller={controller}", "duration=3")
    data, scenario = record.dataset, record.scenario
    nominal = make_nominal_plant(scenario)
    law = make_law(make_mission(scenario), nominal).dynamics
    state = law.initial_state()
    q, v = data["measured_position"].values, data["measured_velocity"].values
    tau = data["generalized_force"].values
    for k in range(data.sizes["time"]):
        for name in ("reaching_gain", "switching_gain"):
            if name in state:
                assert data[name].values[k] == pytest.approx(state[name], rel=1e-9), (name, k)
        e = position_error(data["desired_position"].values[k], q[k])
        e_dot = error_rate(e, data["desired_velocity"].values[k], v[k])
        u, state = law.step(e, e_dot, data["desired_acceleration"].values[k], state)
        if "sliding_variable" in state:
            assert data["sliding_variable"].values[k] == pytest.approx(
                state["sliding_variable"], abs=1e-12
            )
        previous = (
            tau[k - 1] - nominal.calc_mass_matrix(q[k]) @ ((v[k] - v[k - 1]) / 0.01)
            if k
            else np.zeros(11)
        )
        assert tau[k] == pytest.approx(previous + nominal.calc_mass_matrix(q[k]) @ u, abs=1e-9), k


@pytest.mark.smoke
def test_motion_follows_from_the_recorded_forces(run):
    """True plant, recorded tau and tau_d: the acceleration over a period is the change of
    velocity.
    """
    record = run("postcapture", "controller=tdc", "sensing.velocity_noise=0", "duration=5")
    data, scenario = record.dataset, record.scenario
    plant = make_plant(scenario.model)
    context = plant.CreateDefaultContext()
    set_payload(plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
    v = data["velocity"].values
    for k in range(0, 500, 24):
        average = [
            0.5 * (data[name].values[k] + data[name].values[k + 1])
            for name in ("position", "velocity")
        ]
        plant.SetPositions(context, average[0])
        plant.SetVelocities(context, average[1])
        disturbance = 0.5 * (
            data["disturbance_force"].values[k] + data["disturbance_force"].values[k + 1]
        )
        force = data["generalized_force"].values[k] + disturbance
        acceleration = np.linalg.solve(
            plant.CalcMassMatrix(context), force - plant.CalcBiasTerm(context)
        )
        assert (v[k + 1] - v[k]) / 0.01 == pytest.approx(acceleration, abs=2e-6), k


@pytest.mark.slow
def test_same_seed_same_bits_other_seed_other_bits(tmp_path):
    scenario = load_scenario("postcapture", ["duration=2"])
    first, second = (simulate(scenario, check_stability=checked) for checked in (True, False))
    assert first.dataset.identical(second.dataset)
    assert first.metrics == second.metrics
    first.save(tmp_path / "a")
    second.save(tmp_path / "b")
    assert (tmp_path / "a/record.nc").read_bytes() == (tmp_path / "b/record.nc").read_bytes()
    other = simulate(override_scenario(scenario, ["random_seed=1"]), check_stability=False)
    assert not np.array_equal(
        first.dataset["measured_velocity"], other.dataset["measured_velocity"]
    )
    assert not np.array_equal(first.dataset["position"], other.dataset["position"])


@pytest.mark.smoke
def test_save_and_load(run, tmp_path):
    record = run("postcapture")
    loaded = RunRecord.load(record.save(tmp_path / "new" / "folder"))
    assert loaded.dataset.identical(record.dataset)
    assert loaded.metrics == record.metrics
    assert loaded.outcome == record.outcome
    written = sorted(path.name for path in (tmp_path / "new" / "folder").iterdir())
    assert written == ["manifest.json", "metrics.json", "record.nc"]
    metrics = json.loads((tmp_path / "new/folder/metrics.json").read_text())
    assert metrics["itae"] == record.metrics["itae"]
    manifest = json.loads((tmp_path / "new/folder/manifest.json").read_text())
    assert manifest["random_seed"] == 0
    assert manifest["scenario"]["controllers"]["tde_aismc"]["k_s_max"] == {"all": 70.0}
    assert set(manifest["software"]) >= {"drake", "ffsm-drake", "numpy", "python"}
    assert manifest["wall_time"]["advance_to"] > 0


def test_the_netcdf_file_is_plain_enough_for_matlab(run, tmp_path):
    """Numeric variables are doubles, names are character arrays."""
    run("postcapture").save(tmp_path)
    with netCDF4.Dataset(tmp_path / "record.nc") as file:
        assert file.data_model == "NETCDF4"
        assert file["error"].dimensions == ("time", "coordinate")
        assert file["error"].dtype == np.float64
        assert file["coordinate"].dtype == np.dtype("S1")
        assert file["coordinate"][:][6] == "joint_1"
        assert {variable.dtype.kind for variable in file.variables.values()} <= {"f", "S"}


def test_interruption_keeps_the_record(run):
    def interrupt(time, duration):
        if time >= 1.0:
            raise KeyboardInterrupt

    whole = run("postcapture", "duration=2")
    record = simulate(
        load_scenario("postcapture", ["duration=2"]), progress=interrupt, check_stability=False
    )
    assert record.outcome.status == "interrupted"
    assert 0.9 < record.outcome.time < 1.1
    n = record.dataset.sizes["time"]
    assert np.array_equal(record.dataset["position"], whole.dataset["position"][:n])
    assert np.array_equal(
        record.dataset["generalized_force"][:-1], whole.dataset["generalized_force"][: n - 1]
    )
    assert record.metrics["itae"] > 0


def test_watching_does_not_change_the_bits():
    times = []
    scenario = load_scenario("postcapture", ["duration=2"])
    watched = simulate(
        scenario, progress=lambda time, duration: times.append(time), check_stability=False
    )
    assert watched.dataset.identical(simulate(scenario, check_stability=False).dataset)
    assert times == pytest.approx([0.0, 1.0, 2.0], abs=0.02)


class NanOnJoint2(ControlLaw):
    def step(self, sample, state):
        return np.where(np.arange(11) == 7, np.nan, sample.e), state


class Huge(ControlLaw):
    def step(self, sample, state):
        return np.full(11, 1e300), state


def test_a_state_that_is_not_finite_stops_the_run():
    """A force that is not a number ends the run with a message that names the coordinate."""
    record = simulate(
        load_scenario("postcapture", ["duration=1"]), blocks={"controller": NanOnJoint2}
    )
    assert record.outcome.status == "diverged"
    assert record.outcome.coordinate == "joint_2"
    assert "diverged at t = 0.00 s: the force on joint_2 is nan" in record.outcome.message
    assert record.dataset.sizes["time"] >= 1
    assert record.metrics["itae"] == 0.0


@pytest.mark.parametrize("name", ["thrusters_only", "thrusters_and_wheels"])
def test_a_force_that_actuators_cannot_compute_is_divergence(name):
    """The command is finite; the allocation overflows."""
    scenario = load_scenario(name, ["duration=0.1"])
    record = simulate(scenario, blocks={"controller": Huge}, check_stability=False)
    assert record.outcome.status == "diverged"
    assert "the force on base_" in record.outcome.message


def test_momentum_and_energy_balance(run):
    """The exact plant keeps momentum to rounding; the work of all forces is the change of
    energy.
    """
    record = run("postcapture", "sensing.velocity_noise=0", "controller=aismc", "duration=5")
    residual = record.metrics["momentum_residual"]
    assert residual["linear"] < 1e-8
    assert residual["angular"] < 1e-7
    # Euler's error is seen
    assert run("paper", "duration=5").metrics["momentum_residual"]["linear"] > 1e-4
    data = record.dataset
    v, tau, tau_d = (
        data[name].values for name in ("velocity", "generalized_force", "disturbance_force")
    )
    average = 0.5 * (v[1:] + v[:-1])
    work = np.sum(average * (tau[:-1] + 0.5 * (tau_d[1:] + tau_d[:-1]))) * 0.01
    energy = data["kinetic_energy"].values
    assert work == pytest.approx(energy[-1] - energy[0], abs=1e-4 * energy.max())


def apart(rpy, quaternions):
    """The largest difference of quaternions, but for their sign and norm."""
    composed = Rotation.from_euler("xyz", rpy).as_quat(scalar_first=True)
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.minimum(np.abs(composed - unit), np.abs(composed + unit)).max()


def test_base_angles_are_the_attitude():
    """At drawn attitudes, and at and beside pitches of 90 degrees, where they are Drake's too."""
    rng = np.random.default_rng(0)
    beside = [sign * np.pi / 2 + off for sign in (1, -1) for off in (0.0, 1e-15, -1e-9, 1e-8, 1e-5)]
    pitches = np.repeat([*beside, *rng.uniform(-1.5, 1.5, 20)], 50)
    roll, yaw = rng.uniform(-np.pi, np.pi, (2, pitches.size))
    q = Rotation.from_euler("xyz", np.column_stack([roll, pitches, yaw])).as_quat(scalar_first=True)
    q *= rng.choice([-1.0, 1.0], (len(q), 1)) * rng.uniform(0.9, 1.1, (len(q), 1))
    found = base_rpy(np.hstack([q, np.zeros((len(q), 8))]))
    assert apart(found, q) < 1e-14
    assert np.abs(found).max() <= np.pi + 1e-15
    drakes = np.array(
        [RollPitchYaw(Quaternion(each / np.linalg.norm(each))).vector() for each in q]
    )
    away = np.abs(np.abs(pitches) - np.pi / 2) > 0.05
    assert found[away] == pytest.approx(drakes[away], abs=1e-13)


def test_recorded_attitudes_are_the_recorded_quaternions(run):
    """Through a pitch of 90 degrees: angles, and the error's rotation vector."""
    start, end = "[0.1, 1.5707963267948966, 0.7]", "[0.3, 1.2, 0.2]"
    record = run("flight_sensors", "reference.duration=2", "duration=2", "actuation.limit=null",
                 "reference.base_rotation=eigenaxis", f"initial_posture.base_rpy={start}",
                 f"target_posture.base_rpy={end}")  # fmt: skip
    data = record.dataset
    q, desired = (data[name].values[:, :4] for name in ("position", "desired_position"))
    assert apart(data["base_rpy"].values, q) < 1e-9
    assert apart(data["desired_base_rpy"].values, desired) < 1e-9
    assert data["base_rpy"].values[0, 1] == pytest.approx(np.pi / 2, abs=1e-7)
    back = Rotation.from_rotvec(data["error"].values[:, :3])
    back *= Rotation.from_quat(q, scalar_first=True)
    assert (back.inv() * Rotation.from_quat(desired, scalar_first=True)).magnitude().max() < 1e-9


def test_final_posture_is_the_target(run):
    data = run("postcapture").dataset
    assert data["base_rpy"].values[-1] == pytest.approx([0, 0, 0], abs=1e-7)
    target = np.deg2rad([-25, 65, 50, 65, -25])
    assert data["position"].values[-1, 7:] == pytest.approx(target, abs=1e-7)
    assert data["velocity"].values[-1] == pytest.approx(np.zeros(11), abs=1e-4)
