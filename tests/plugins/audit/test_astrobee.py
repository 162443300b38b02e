"""A log of a flight: Astrobee in the ISS, 12 February 2016, "return journey while rotating".

suyoung1222/Astrobee-Dataset-Tool at 9e3ecd0, ``ff_return_journey_rot``: 503 poses of a "pseudo
ground truth" from cameras, and 6359 rows of the IMU in 101.6 s. The repository has no licence, so
the log is not kept here. It contains no commands, forces or masses: it can confirm kinematics and a
model of sensors, not dynamics.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from gyro_fit import Log, white_density
from outside_data import outside_file
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario
from ffsm_drake.plugins.audit.verdict import audit

SOURCE = ("suyoung1222/Astrobee-Dataset-Tool", "9e3ecd0")
FOLDER = "Astrobee-ISS-Datasets/ff_return_journey_rot"
EXAMPLE = Path(__file__).parents[3] / "examples" / "astrobee_imu.yaml"
# Any rigid body: without efforts, its mass and inertia do not change the answers that are tested.
BODY = """<robot name="astrobee"><link name="body"><inertial><mass value="9.6"/>
<inertia ixx="0.15" iyy="0.14" izz="0.16" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
COLUMNS = [
    "time",
    *(f"base_position_{axis}" for axis in "xyz"),
    *(f"base_quaternion_{axis}" for axis in "wxyz"),
    *(f"base_angular_velocity_{axis}" for axis in "xyz"),
]


def table(name):
    """Time stamps, ns (n), and the other columns (n, k)."""
    lines = outside_file(*SOURCE, f"{FOLDER}/{name}.txt").splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    return np.array([int(row[0]) for row in rows]), np.array([row[1:] for row in rows], dtype=float)


@pytest.fixture(scope="module")
def flight():
    """Positions (n, 3), accelerations (m, 3), m/s^2, and the log of attitudes and gyro."""
    (stamps, poses), (gyro_stamps, imu) = table("groundtruth"), table("imu")
    times, gyro_times = ((each - stamps[0]) * 1e-9 for each in (stamps, gyro_stamps))
    log = Log(gyro_times, imu[:, :3], times, Rotation.from_quat(poses[:, 3:]))
    return poses[:, :3], imu[:, 3:], log


def audited(folder, positions, log, rates):
    rows = np.column_stack([log.times, positions, log.attitudes.as_quat()[:, [3, 0, 1, 2]], rates])
    np.savetxt(folder / "log.csv", rows, "%.9f", ",", header=",".join(COLUMNS), comments="")
    (folder / "body.urdf").write_text(BODY)
    return audit(folder / "log.csv", folder / "body.urdf")


def test_what_the_log_is(flight):
    positions, acceleration, log = flight
    assert (len(positions), len(log.gyro_times)) == (503, 6359)
    assert log.times[-1] == pytest.approx(101.62, abs=0.01)
    assert np.linalg.norm(acceleration.mean(axis=0)) == pytest.approx(0.366, abs=2e-3)


@pytest.mark.long
def test_the_audit_finds_the_axes_of_the_gyro(flight, tmp_path):
    """As it is logged. With the identified axes, bias and delay removed, there is none."""
    positions, _, log = flight
    own = log.fit()
    found = audited(tmp_path, positions, log, log.rates(log.times))
    assert set(found.causes) == {"dropped_samples", "axes"}  # one pose of 504 is missing
    line = next(each.statement for each in found.checks if each.cause == "axes")
    turn = np.array([float(each) for each in re.search(r"\[(.*)\]", line)[1].split(",")])
    away = own.axes * Rotation.from_rotvec(np.radians(turn))
    assert np.degrees(away.magnitude()) < 1.0
    assert np.degrees(own.axes.magnitude()) == pytest.approx(89.6, abs=0.2)
    rates = own.axes.inv().apply(log.rates(log.times - own.delay) - own.bias)
    assert audited(tmp_path, positions, log, rates).causes == ("dropped_samples",)


@pytest.mark.long
def test_the_example_has_the_identified_sensors(flight):
    """Bias within two standard errors, delay within half a sample, noise within a quarter."""
    positions, _, log = flight
    found, sensing = log.fit(), load_scenario(EXAMPLE).sensing
    bias = [sensing.velocity_bias[f"base_rotation_{axis}"] for axis in "xyz"]
    assert (np.abs(found.bias - bias) < 2.0 * found.spread).all()
    assert found.delay == pytest.approx(sensing.position_delay_time["base_rotation"], abs=5e-3)
    assert np.median(np.diff(log.times)) == pytest.approx(
        sensing.position_period_time["base_rotation"], rel=0.02
    )
    period = np.median(np.diff(log.gyro_times))
    density = sensing.velocity_noise_density["base_rotation"]
    assert white_density(log.gyro, period) == pytest.approx(density, rel=0.1)
    attitude, _, walk = log.noise(found)
    assert attitude == pytest.approx(sensing.position_noise["base_rotation"], rel=0.25)
    assert walk == pytest.approx(sensing.velocity_bias_walk["base_rotation"], rel=0.25)
    place = white_density(positions, 1.0, order=5)
    assert place == pytest.approx(sensing.position_noise["base_position"], rel=0.15)


@pytest.mark.long
@pytest.mark.parametrize("steps", [2, 20])
def test_the_identification_is_the_same_over_other_windows(flight, steps):
    """Windows of 0.4 and 4 s, compared with 1 s."""
    *_, log = flight
    usual, found = log.fit(), log.fit(steps)
    assert np.degrees((usual.axes.inv() * found.axes).magnitude()) < 0.2
    assert (np.abs(usual.bias - found.bias) < 2.0 * usual.spread).all()
    assert found.delay == pytest.approx(usual.delay, abs=2e-3)
