"""Coordinate names, mappings by name and group, and the rotation-vector error."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ffsm_drake.common.errors import ScenarioError
from ffsm_drake.common.so3 import rotation_error, rotation_error_rate
from ffsm_drake.spacecraft.coordinates import (
    Coordinates,
    error_rate,
    position_error,
    position_errors,
)

COORDINATES = Coordinates(("joint_1", "slider"), ("rad", "m"))


@pytest.mark.smoke
def test_the_more_specific_key_wins():
    values = {"joint_1": 3.0, "all": 1.0, "base_position": 2.0, "base_position_y": 5.0}
    assert COORDINATES.vector(values, key="k").tolist() == [1, 1, 1, 2, 5, 2, 3, 1]


def test_defaults_and_missing_values():
    assert COORDINATES.vector({"joints": 1.0}, key="k", default=0.0).tolist() == [0] * 6 + [1, 1]
    with pytest.raises(
        ScenarioError,
        match=r"k: gives no value for base_rotation_x, "
        r".* and \d more; add",
    ):
        COORDINATES.vector({"joints": 1.0}, key="k")
    with pytest.raises(
        ScenarioError,
        match=r"k\.joint_9: unknown coordinate; valid here: all, "
        r"base_rotation",
    ):
        COORDINATES.vector({"all": 1.0, "joint_9": 2.0}, key="k")


def test_names_groups_and_units_line_up():
    assert len(COORDINATES.names) == len(COORDINATES.group_of) == len(COORDINATES.units) == 8
    assert len(COORDINATES.position_names) == 9
    assert dict(zip(COORDINATES.names, COORDINATES.units, strict=True))["slider"] == "m"
    assert dict(zip(COORDINATES.names, COORDINATES.group_of, strict=True))["slider"] == "joints"


@pytest.mark.smoke
def test_rotation_error_is_the_world_frame_logarithm():
    rng = np.random.default_rng(0)
    for _ in range(200):
        desired, actual = Rotation.random(2, rng=rng)
        expected = (desired * actual.inv()).as_rotvec()
        # measured quaternions are not of unit length
        scaled = 1.3 * actual.as_quat(scalar_first=True)
        assert rotation_error(desired.as_quat(scalar_first=True), scaled) == pytest.approx(
            expected, abs=1e-12
        )
        assert rotation_error(-desired.as_quat(scalar_first=True), scaled) == pytest.approx(
            expected, abs=1e-12
        )


def test_tiny_rotations_keep_their_precision():
    desired = Rotation.from_rotvec([1e-9, -2e-9, 3e-9]).as_quat(scalar_first=True)
    assert rotation_error(desired, np.array([1.0, 0, 0, 0])) == pytest.approx(
        (1e-9, -2e-9, 3e-9), rel=1e-9
    )
    assert rotation_error(desired, desired) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.0999, 0.1001, 1.0, 3.0, 3.14])
@pytest.mark.smoke
def test_rate_of_the_rotation_error_is_its_derivative(angle):
    """By central differences, both attitudes turning at constant angular velocities in the world
    frame.
    """
    rng, h = np.random.default_rng(7), 1e-5
    for _ in range(20):
        actual, (axis, w_d, w) = Rotation.random(rng=rng), rng.normal(size=(3, 3))
        # so slow that the difference's own error is small up to angles near pi
        w_d, w = 1e-3 * w_d, 1e-3 * w
        desired = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)) * actual

        def error(t, desired=desired, actual=actual, w_d=w_d, w=w):
            moved = (Rotation.from_rotvec(t * w_d) * desired, Rotation.from_rotvec(t * w) * actual)
            return np.array(rotation_error(*(each.as_quat(scalar_first=True) for each in moved)))

        rate = rotation_error_rate(tuple(error(0.0)), w_d, w)
        assert rate == pytest.approx(
            (error(h / 1e-3) - error(-h / 1e-3)) / (2 * h / 1e-3), abs=1e-9
        )
        # the angle's own rate
        assert np.dot(rate, error(0.0)) == pytest.approx(np.dot(w_d - w, error(0.0)), abs=1e-15)


def test_rate_of_an_error_is_a_difference_but_for_the_rotation():
    error, v_d, v = np.random.default_rng(8).normal(size=(3, 8))
    rate = error_rate(error, v_d, v)
    assert rate[3:].tolist() == (v_d - v)[3:].tolist()
    assert rate[:3].tolist() == list(rotation_error_rate(tuple(error[:3]), v_d[:3], v[:3]))


def test_position_error_is_desired_minus_actual():
    q = np.array([1.0, 0, 0, 0, 1, 2, 3, 0.1, 0.2])
    q_d = q + np.array([0, 0, 0, 0, 1, 0, 0, 0, 0.5])
    assert position_error(q_d, q).tolist() == pytest.approx([0, 0, 0, 1, 0, 0, 0, 0.5])


def test_many_position_errors_at_once_are_those_of_one_by_one():
    rng = np.random.default_rng(4)
    q_d, q = rng.normal(size=(2, 50, 9))
    q[0] = q_d[0]  # no rotation at all
    q[1, :4] = -q_d[1, :4]
    q[2, :4] = q_d[2, :4] + 1e-9 * rng.normal(size=4)
    expected = np.array([position_error(a, b) for a, b in zip(q_d, q, strict=True)])
    assert position_errors(q_d, q) == pytest.approx(expected, rel=1e-13, abs=1e-24)
    assert not position_errors(q_d, q)[0].any()
