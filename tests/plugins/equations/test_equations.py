"""The equations of one spacecraft on numbers, against Drake."""

import math

import numpy as np
import pytest
from drawn_trees import drawn_tree
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BallRpyJoint,
    FixedOffsetFrame,
    LinearSpringDamper,
    PrismaticJoint,
    QuaternionFloatingJoint,
    RevoluteJoint,
    RevoluteSpring,
    ScrewJoint,
    SpatialInertia,
)

from ffsm_drake import load_scenario
from ffsm_drake.common.so3 import composed
from ffsm_drake.plugins.equations import comparison, errors
from ffsm_drake.plugins.equations.comparison import differences
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.spacecraft.coordinates import tracking_errors
from ffsm_drake.spacecraft.plant import make_plant

QUICK = ("postcapture", "flexible_panels")
# Positions of a drawn tree with prismatic joints are large: Drake's own errors grow with them.
DRAWN = 1e-13


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow)
        for name in shipped_scenarios()
    ],
)
@pytest.mark.parametrize("flexible", [False, True])
def test_every_shipped_spacecraft_agrees(name, flexible):
    found = differences(make_plant(load_scenario(name).model, flexible=flexible))
    assert found.pop("residual") < 1e-13
    assert found.pop("position_rates") < 1e-15
    assert max(found.values()) < 1e-14
    assert set(found) == {"mass_matrix", "bias", "errors"}


@pytest.mark.smoke
@pytest.mark.parametrize("joints", [1, 4])
def test_drawn_trees_agree(joints):
    assert max(differences(drawn_tree(joints, joints)).values()) < DRAWN


@pytest.mark.long
@pytest.mark.parametrize("joints", range(2, 31, 4))
def test_larger_drawn_trees_agree(joints):
    assert max(differences(drawn_tree(100 + joints, joints)).values()) < DRAWN


def hinge():
    """A base with one joint."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    base, arm = (
        plant.AddRigidBody(name, SpatialInertia.SolidBoxWithMass(m, 1.0, 2.0, 3.0))
        for name, m in (("base", 50.0), ("arm", 5.0))
    )
    plant.AddJoint(RevoluteJoint("joint", base.body_frame(), arm.body_frame(), [0, 0, 1]))
    return plant, base, arm


@pytest.mark.smoke
def test_tracking_errors_of_any_size_are_those_of_numpy():
    random, nq, nv = np.random.default_rng(4), 9, 8
    desired, actual = (random.normal(size=(1001, nq + nv)) for _ in range(2))
    angles = np.concatenate(
        [10.0 ** random.uniform(-16, 0, 500), random.uniform(0.0, 2.0 * math.pi, 499), [0, 0]]
    )
    axes = random.normal(size=(angles.size, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.hstack([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axes])
    turns[-1] = [0.0, 1.0, 0.0, 0.0]  # half a turn
    actual[-1, :4] = [1.0, 0.0, 0.0, 0.0]
    desired[:, :4] = composed(turns, actual[:, :4])
    actual[100] = np.nan
    rows = list(zip(desired, actual, strict=True))
    found = np.array([np.hstack(errors.tracking_errors(*each, nq)) for each in rows])
    expected = np.array([np.hstack(tracking_errors(*each, nq)) for each in rows])
    lengths = np.linalg.norm(expected[:, :3], axis=1)[:, None]
    assert np.isnan(found[100]).all()
    near = np.abs(found - expected)[:, :3] <= 2e-15 * lengths
    assert np.delete(near, 100, axis=0).all()
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=1e-11)


def with_gravity(plant, base, arm):
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -9.81])


def with_ball(plant, base, arm):
    other = plant.AddRigidBody("other", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
    plant.AddJoint(BallRpyJoint("ball", arm.body_frame(), other.body_frame()))


def with_screw(plant, base, arm):
    other = plant.AddRigidBody("other", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
    plant.AddJoint(ScrewJoint("screw", arm.body_frame(), other.body_frame(), [1, 0, 0], 0.1, 0.0))


def with_damper(plant, base, arm):
    plant.AddForceElement(LinearSpringDamper(base, np.ones(3), arm, np.zeros(3), 1.0, 10.0, 1.0))


def with_two_springs(plant, base, arm):
    for _ in range(2):
        plant.AddForceElement(RevoluteSpring(plant.GetJointByName("joint"), 0.0, 1.0))


def with_another_base(plant, base, arm):
    plant.AddRigidBody("free", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))


def with_rail(plant, base, arm):
    other = plant.AddRigidBody("other", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
    rail = PrismaticJoint("rail", plant.world_frame(), other.body_frame(), [1, 0, 0])
    plant.AddJoint(rail)


def with_placed_base(plant, base, arm):
    frame = plant.AddFrame(
        FixedOffsetFrame("at", base.body_frame(), RigidTransform(Quaternion(), [1.0, 0.0, 0.0]))
    )
    plant.AddJoint(QuaternionFloatingJoint("floating", plant.world_frame(), frame))


def test_code_that_takes_long_to_make_is_refused():
    with pytest.raises(NotCovered, match="61 joints"):
        Reader(drawn_tree(0, 61))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (with_gravity, "gravity"),
        (with_ball, "joint 'ball' of type ball_rpy"),
        (with_screw, "joint 'screw' of type screw"),
        (with_damper, "force element LinearSpringDamper"),
        (with_two_springs, "two springs on joint 'joint'"),
        (with_another_base, "one floating base"),
        (with_rail, "joint 'rail', apart from the floating base"),
        (with_placed_base, "one floating base"),
    ],
)
def test_what_is_not_covered_is_refused_in_a_line(change, said):
    plant, *bodies = hinge()
    change(plant, *bodies)
    plant.Finalize()
    with pytest.raises(NotCovered) as caught:
        Reader(plant)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_equations_that_differ_from_drake_are_refused(monkeypatch):
    plant = drawn_tree(11, 1)
    tree = Reader(plant).tree
    monkeypatch.setattr(comparison, "LARGEST_DIFFERENCE", 1e-20)
    with pytest.raises(NotCovered, match="differ from Drake"):
        comparison.held_to_drake(tree, plant=plant)
    monkeypatch.undo()
    comparison.held_to_drake(tree, plant=plant)
