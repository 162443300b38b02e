"""The published robot with two six-joint arms."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from ffsm_drake import PlantModel, load_scenario, make_true_plant, simulate
from ffsm_drake.spacecraft.plant import find_frame

# As published, of the left arm: the turn (roll, pitch, yaw, degrees) to each joint, which turns
# about z, the way from it to the next one, and the first joints.
TURNS = [(0, -90, 0), (0, 90, 0), (0, 0, 0), (-90, 0, 0), (90, 0, 0), (-90, 0, 0)]
WAYS = [(0, 0, 0.1), (0, 0.2, 0), (0, 0.2, 0), (0, 0, 0.1), (0, 0.08, 0), (0, 0, 0.05)]
START = np.array([0.0, np.pi / 3, -4 * np.pi / 9, 0.0, -7 * np.pi / 18, 0.0])


@pytest.fixture(scope="module")
def model() -> PlantModel:
    return make_true_plant(load_scenario("tohoku_arms"))


@pytest.mark.parametrize(("side", "sign"), [("left", 1.0), ("right", -1.0)])
def test_the_hands_are_where_the_published_frames_put_them(
    model: PlantModel, side: str, sign: float
) -> None:
    for joints in (START, *np.random.default_rng(0).uniform(-2.0, 2.0, (3, 6))):
        place, turn = np.array([-0.15757 * sign, 0.08, 0.0]), Rotation.identity()
        for k, (rpy, way, angle) in enumerate(zip(TURNS, WAYS, sign * joints, strict=True)):
            mirrored = sign if k < 2 else 1.0
            turn = turn * Rotation.from_euler("xyz", mirrored * np.array(rpy), degrees=True)
            turn = turn * Rotation.from_euler("z", angle)
            place = place + turn.apply(way)
            model.plant.GetJointByName(f"{side}_{k + 1}").set_angle(model.context, angle)
        hand = find_frame(model.plant, f"servicer::{side}_hand", key="hand")
        found = hand.CalcPoseInWorld(model.context)
        assert_allclose(found.translation(), place, atol=1e-9)
        assert_allclose(found.rotation().matrix(), turn.as_matrix(), atol=1e-9)


def test_the_mass_is_the_published_one(model: PlantModel) -> None:
    bars = 2700.0 * np.pi * 0.015**2 * 0.68
    whole = 8.0 + 2.0 * (bars + 5 * 0.1 + 0.5) + 2.34844
    assert model.plant.CalcTotalMass(model.context) == pytest.approx(whole, rel=1e-9)


@pytest.mark.long
def test_both_hands_catch_the_cube() -> None:
    run = simulate(load_scenario("tohoku_arms", ["duration=12", "reference.duration=8"]))
    assert run.ending.is_settled
    assert run.metrics["contacts"]["gap"] < 1e-9
    assert run.metrics["contacts"]["force"] < 0.1
