"""Kinematics of frames, against Drake, and singular values of traced code, against NumPy."""

import numpy as np
import pytest
from pydrake.multibody.tree import FrameIndex

from ffsm_drake import load_scenario, make_nominal_plant
from ffsm_drake.common.so3 import matrix_of
from ffsm_drake.plugins.equations import frames
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.tape.arrays import traced


@pytest.mark.parametrize("name", ["postcapture", "seven_joint", "ets_vii"])
def test_frames_move_as_those_of_drake(name):
    model, random = make_nominal_plant(load_scenario(name)), np.random.default_rng(1)
    reader, plant = Reader(model.plant), model.plant
    for index in range(1, plant.num_frames()):  # the first is the world's
        frame = plant.get_frame(FrameIndex(index))
        place, tree = reader.place_of(frame), reader.tree
        q, v = random.normal(size=plant.num_positions()), random.normal(size=plant.num_velocities())
        rotation, origin = frames.pose(tree, place, q)
        given = tree, place, q
        for found, expected in (
            ([*frames.quaternion_of(rotation), *origin], model.calc_frame_pose(q, frame)),
            (frames.jacobian(*given), model.calc_jacobian(q, frame)),
            (
                frames.bias_acceleration(*given, v),
                model.calc_bias_acceleration(q, v, frame),
            ),
        ):
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize("turn", range(4))
def test_quaternions_of_half_turns(turn):
    """At half a turn, and near it, another entry is the largest."""
    for near in (0.0, 1e-9, 1e-3):
        expected = np.array([near * (i != turn) + (i == turn) for i in range(4)])
        expected = expected / np.linalg.norm(expected)
        found = frames.quaternion_of(matrix_of(expected))
        assert min(np.abs(found - sign * expected).max() for sign in (1.0, -1.0)) < 1e-15


@pytest.mark.parametrize("shape", [(6, 5), (3, 7), (6, 7), (1, 1), (3, 3)])
def test_singular_values_are_those_of_numpy(shape):
    random = np.random.default_rng(2)
    for _ in range(5):
        matrix = random.normal(size=shape) * 10.0 ** random.uniform(-4.0, 1.0, size=shape[1])
        if random.random() < 0.5:
            matrix[:, -1] = matrix[:, 0]  # a direction is missing
        left, sizes, right = (
            np.asarray(each, float) for each in np.linalg.svd(traced(matrix), full_matrices=False)
        )
        expected = np.linalg.svd(matrix, compute_uv=False)
        np.testing.assert_allclose(sizes, expected, rtol=0.0, atol=1e-14 * expected[0])
        np.testing.assert_allclose(left * sizes @ right, matrix, rtol=0.0, atol=1e-14 * expected[0])
