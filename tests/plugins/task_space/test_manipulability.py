"""Dynamic manipulability and singularities: published figures, roots of a determinant."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from ffsm_drake import load_scenario, make_true_plant
from ffsm_drake.plugins.task_space.manipulability import (
    manipulability,
    manipulability_along,
    singularities_along,
)
from ffsm_drake.spacecraft.free_floating import free_floating
from ffsm_drake.spacecraft.nominal import PlantModel


@pytest.fixture(scope="module")
def planar() -> PlantModel:
    return make_true_plant(load_scenario("planar_detumble"))


@pytest.mark.smoke
def test_singular_values_of_the_planar_servicer(planar: PlantModel) -> None:
    """Figures on which three independent codes agree; the other three rows are zero."""
    q = np.r_[1.0, np.zeros(6), -0.72, 1.2, 0.72]
    jacobian = planar.calc_jacobian(q, "debris::target")
    generalized = free_floating(planar, q).generalized_jacobian(jacobian)
    moving = manipulability(generalized)
    assert_allclose(moving.singular_values, [1.4495055, 0.2280188, 0.1798853], rtol=0, atol=5e-8)
    assert moving.measure == pytest.approx(abs(np.linalg.det(generalized[[1, 3, 5]])), rel=1e-12)
    fixed = manipulability(jacobian[:, 6:])
    assert_allclose(fixed.singular_values, [2.5926565, 0.8278465, 0.2735772], rtol=0, atol=5e-8)
    # In a plane it can only be short of motion in the plane.
    assert_allclose(moving.lost[[0, 2, 4]], 0.0, rtol=0, atol=1e-12)
    assert manipulability(generalized, task="position").smallest == pytest.approx(0.0, abs=1e-12)
    # Lengths of rotations: in attitude alone they scale all, in position none.
    for task, factor in (("attitude", 2.0), ("position", 1.0)):
        near, far = (
            manipulability(generalized, task=task, length=length).singular_values
            for length in (1.0, 2.0)
        )
        assert_allclose(far, factor * near, rtol=1e-12, atol=1e-15)


def test_singularities_along_a_motion(planar: PlantModel) -> None:
    """Joint 2 swings through the stretched arm; the fixed-base arm is singular at another instant
    than the free one.
    """
    times = np.linspace(0.0, 4.0, 21)

    def positions(some: np.ndarray) -> np.ndarray:
        joints = np.stack(
            [np.full_like(some, -0.72), 1.2 - 0.6 * some, np.full_like(some, 0.72)], axis=1
        )
        return np.hstack([np.tile(np.r_[1.0, np.zeros(6)], (some.size, 1)), joints])

    def determinant(time: float) -> float:
        q = positions(np.array([time]))[0]
        jacobian = planar.calc_jacobian(q, "debris::target")
        return float(
            np.linalg.det(free_floating(planar, q).generalized_jacobian(jacobian)[[1, 3, 5]])
        )

    found = singularities_along(planar, positions, times, "debris::target", below=1e-6)
    crossings = [
        brentq(determinant, first, last, xtol=1e-12)
        for first, last in itertools.pairwise(times)
        if determinant(first) * determinant(last) < 0
    ]
    assert len(crossings) == 1
    assert abs(crossings[0] - 2.0) > 0.1  # when joint 2 is straight
    assert_allclose([each.time for each in found], crossings, rtol=0, atol=1e-7)
    sampled = manipulability_along(planar, positions(times), "debris::target")
    assert sampled.smallest.min() > 1e-4  # between the samples
    q = positions(np.array([found[0].time]))[0]
    jacobian = free_floating(planar, q).generalized_jacobian(
        planar.calc_jacobian(q, "debris::target")
    )
    assert_allclose(found[0].lost @ jacobian, 0.0, rtol=0, atol=1e-6)
    assert not singularities_along(planar, positions, times, "debris::target", below=1e-12)


@pytest.mark.parametrize("name", ["postcapture", "seven_joint", "planar_detumble"])
def test_dynamic_singularities_do_not_depend_on_the_bases_pose(name: str) -> None:
    scenario = load_scenario(name)
    model, rng = make_true_plant(scenario), np.random.default_rng(17)
    attitudes = Rotation.random(20, random_state=17).as_quat()
    joints = rng.uniform(-np.pi, np.pi, (20, len(model.coordinates.joints)))
    q = np.hstack([attitudes, rng.uniform(-3, 3, (20, 3)), joints])
    moved = q.copy()
    moved[:, :4], moved[:, 4:7] = q[::-1, :4], -q[:, 4:7]
    here, there = (
        manipulability_along(model, each, scenario.payload.body).singular_values
        for each in (q, moved)
    )
    assert_allclose(there, here, rtol=1e-10, atol=1e-12)
