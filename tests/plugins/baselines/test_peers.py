"""The robots of two published predictive controllers: their numbers, runs and limits.

GargiDas2026/MATLAB_Planar_Free_Floating_SMS (planar) and reis-alex/SpaceRobot (with wheels).
"""

import importlib
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from ffsm_drake import load_scenario

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
# Casadi_SQP_data.mat of the first: torques of its first 80 ms, N m, and [turn; x; y; joints] then
TORQUES = np.array(
    [
        [5.0, 1.5463369803097509, 0.12163994367025871],
        [5.0, 2.5, 0.6058055173665433],
        [5.0, 2.5, 0.6059074774462877],
        [4.8403905553201385, 2.5, 0.6319880820145296],
        [4.5746266191509255, 2.5, 0.6753921177313477],
        [4.533630619195811, 2.5, 0.6821004118953564],
        [2.4770738962649155, 1.355074274153803, 0.3664061015294781],
        [0.8241022934323833, 0.45391657384639794, 0.12345799282545027],
    ]
)
AFTER = [
    -0.016779016293605273, -0.05733724789936386, -0.0006270346050974625,
    0.04581020451250726, -0.012030004637333462, -0.0029744726278146364,
]  # fmt: skip
# and at its end, after 10 s, with the first joint at 50 deg
TURNED, MOVED = -0.36200916, (-0.05121183, -0.01223927)  # rad, m
# mass, moments, centre in the body of benchmarks/small_wheels that it belongs to
WHEEL = (0.065, 0.065, 0.1322)
BASE = [
    (100.0, (40.0, 20.0, 40.0), (0.0, 0.0, 0.0)),
    *((4.0, np.roll(WHEEL, k), (0.0, 0.0, 0.0)) for k in range(3)),
    (1.97, (35e-4, 7e-4, 4e-4), (0.25, 0.0, 0.45)),
]
HAND = [
    (1.17, (7e-4, 924e-4, 273e-4), (0.0, 0.0, 0.3)),
    (2.0, (1.0, 1.0, 1.0), (0.0, 0.0, 0.6)),
]


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("peers")


@pytest.mark.smoke
def test_stored_torques_move_the_planar_robot_as_published(peers):
    rows = peers.moved(lambda k, x: TORQUES[k], len(TORQUES))
    np.testing.assert_allclose(rows[-1, :6], AFTER, atol=1e-14)


def test_published_pd_ends_where_it_does_in_its_figures(peers):
    """x -0.055 m, y 0.0076 m, 0.218 rad; its text reads 0.009 m, which is about the peak."""
    record = peers.planar(-30.0, law=peers.Pd)
    place = record.dataset["position"].values[:, 4:6]
    assert place[-1] == pytest.approx([-0.0551, 0.0076], abs=1e-4)
    assert 0.009 < place[:, 1].max() < 0.010
    assert peers.turn_of_base(record)[-1] == pytest.approx(0.218, abs=5e-4)
    linear, angular = peers.drift(record)
    assert 0.0 < linear < 6.21e-5  # published of the fourth-order method at the same step
    assert 0.0 < angular < 4.46e-9


@pytest.mark.slow
def test_sliding_mode_with_the_published_gains_ends_there_too(peers):
    record = peers.planar(-30.0, law=peers.Smc)
    assert peers.turn_of_base(record)[-1] == pytest.approx(0.218, abs=5e-4)
    assert peers.arrived(record) < 2.0


@pytest.mark.slow
def test_predictive_control_ends_where_the_stored_one_does_and_earlier(peers):
    record = peers.planar(
        50.0, peers.LIMIT, "controller=mpc", f"controllers.mpc={peers.PUBLISHED_WEIGHTS}",
        "duration=10",
    )  # fmt: skip
    assert record.dataset["position"].values[-1, 4:6] == pytest.approx(MOVED, abs=2e-5)
    assert peers.turn_of_base(record)[-1] == pytest.approx(TURNED, abs=5e-5)
    torque = np.abs(record.dataset["applied_force"].values[:, -3:])
    assert (torque <= peers.TORQUE * (1.0 + 1e-9)).all()
    assert (torque.max(axis=0)[:2] >= peers.TORQUE[:2] * (1.0 - 1e-6)).all()
    assert peers.arrived(record) < 3.04  # the better of the two stored


def test_bodies_of_the_robot_with_wheels_are_the_sums_of_the_published_ones(peers):
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(BENCHMARKS / "small_wheels" / "servicer.urdf"))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for name, parts in (("base", BASE), ("link_3", HAND)):
        total = np.zeros((6, 6))
        for mass, moments, center in parts:
            lever = np.cross(np.eye(3), center)  # [center]x
            total += np.block(
                [
                    [np.diag(moments) - mass * lever @ lever, -mass * lever],
                    [mass * lever, mass * np.eye(3)],
                ]
            )
        body = plant.GetBodyByName(name).CalcSpatialInertiaInBodyFrame(context)
        found = body.CopyToFullMatrix6()
        np.testing.assert_allclose(np.abs(found), np.abs(total), rtol=1e-6, atol=1e-7)
    scenario = load_scenario(peers.WHEELS)
    inertias = [unit.inertia for unit in scenario.wheels.units.values()]
    assert inertias == [WHEEL[2]] * 3


@pytest.mark.parametrize(
    ("controller", "overrides", "at_once"),
    [
        pytest.param("tde_aismc", ["reference.duration=50", "duration=52"], False,
                     marks=pytest.mark.long),
        pytest.param("mpc", ["reference.duration=20", "duration=30"], True, marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_tool_comes_to_the_published_place_within_the_published_limits(
    peers, controller, overrides, at_once
):
    weights = f"controllers.mpc={peers.WEIGHTS}"
    given = [f"controller={controller}", *overrides, *([weights] if at_once else [])]
    used = peers.on_the_wheels(peers.flown(load_scenario(peers.WHEELS, given), at_once=at_once))
    assert used["tool off, m"] < 1e-4  # published to 0.1 mm
    assert used["wheels, N m"] <= 0.175
    assert used["joints, N m"] <= 50.0
    assert used["rate, rad/s"] <= 0.09 * (1.0 + 1e-3)
    assert used["base, deg"] < (2.0 if at_once else 1e-3)  # published: 50
    if at_once:
        assert used["arrived, s"] < 1.01 * 0.98 * np.deg2rad(120.0) / 0.09  # at the limit of rate
