"""A run's attitude and orbit as CCSDS messages, read back by a reader of their own."""

import datetime
import re

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

from ffsm_drake import RunRecord, load_scenario, simulate
from ffsm_drake.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    overrides = ["duration=0.3", "environment={altitude: 500e3, hill_rpy: [0.3, 0.2, -1.0]}"]
    simulate(load_scenario("postcapture", overrides), check_stability=False).save(folder)
    return folder


def export(folder, path):
    return CliRunner().invoke(main, ["export", str(path), str(folder)])


def read(path):
    """Keywords, times since the first (s), and numbers (n, ...)."""
    keys, times, rows = {}, [], []
    for line in path.read_text(encoding="ascii").splitlines():
        if found := re.fullmatch(r"([A-Z_0-9]+) = (.+)", line):
            keys[found[1]] = found[2]
        elif re.match(r"\d{4}-", line):
            stamp, *numbers = line.split()
            times.append(datetime.datetime.fromisoformat(stamp))
            rows.append([float(number) for number in numbers])
    first = datetime.datetime.fromisoformat(keys["START_TIME"])
    assert datetime.datetime.fromisoformat(keys["STOP_TIME"]) == times[-1]
    return keys, [(time - first).total_seconds() for time in times], np.array(rows)


@pytest.mark.smoke
def test_attitude(folder, tmp_path):
    assert export(folder, tmp_path / "run.aem").exit_code == 0
    keys, times, rows = read(tmp_path / "run.aem")
    record = RunRecord.load(folder)
    assert keys["ATTITUDE_DIR"] == "A2B"
    np.testing.assert_allclose(times, record.dataset.time.values, atol=1e-6)
    # from A to B takes components in A to those in B: of the base's axes these are unit vectors
    axes = Rotation.from_quat(record.positions().base_quaternion.values, scalar_first=True)
    for k in (0, -1):
        x, y, z, w = rows[k]
        to_b = Rotation.from_quat([x, y, z, w]).inv().as_matrix()
        np.testing.assert_allclose(to_b @ axes[k].as_matrix(), np.eye(3), atol=1e-12)


@pytest.mark.smoke
def test_orbit(folder, tmp_path):
    assert export(folder, tmp_path / "run.oem").exit_code == 0
    keys, times, rows = read(tmp_path / "run.oem")
    assert keys["CENTER_NAME"] == "EARTH"
    place, speed = np.split(rows, 2, axis=1)
    assert np.linalg.norm(place[0]) == pytest.approx(6878.1363, abs=0.01)  # km
    # mu of the Earth over the radius, km/s
    assert np.linalg.norm(speed[0]) == pytest.approx(np.sqrt(398600.4418 / 6878.1363), abs=1e-3)
    moved = np.gradient(place, times, axis=0, edge_order=2)
    np.testing.assert_allclose(moved[1:-1], speed[1:-1], atol=1e-6)


def test_without_an_orbit_one_line_says_so(tmp_path):
    scenario = load_scenario("postcapture", ["duration=0.05"])
    simulate(scenario, check_stability=False).save(tmp_path / "run")
    result = export(tmp_path / "run", tmp_path / "run.oem")
    assert result.exit_code == 2
    assert "environment.altitude" in result.output
    assert not (tmp_path / "run.oem").exists()
