"""Compiled code of one spacecraft against Drake."""

import functools
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
from ffsm_drake.plugins.compiled.code import function
from ffsm_drake.plugins.compiled.compiling import Code, registers
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations.equations import bias, derivative, mass_matrix
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.generated.comparison import Differences
from ffsm_drake.plugins.generated.copies import model_of
from ffsm_drake.plugins.generated.kernels import Kernels, module_text
from ffsm_drake.scenario import MassProperties, shipped_scenarios
from ffsm_drake.spacecraft.coordinates import tracking_errors
from ffsm_drake.spacecraft.dynamics import NotCovered
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.nominal import make_nominal_plant
from ffsm_drake.spacecraft.plant import make_plant
from ffsm_drake.tape.numbers import Tape, cosine, sine

QUICK = ("postcapture", "flexible_panels")
# Positions of a drawn tree with prismatic joints are large: Drake's own errors grow with them.
DRAWN = 1e-13


@functools.cache
def kernels_of(tree):
    return Kernels(tree)


def differences(plant):
    return Differences(kernels_of(Reader(plant).tree), plant)


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
    assert found.mass_matrix < 1e-14
    assert found.bias < 1e-14
    assert found.position_rates < 1e-15
    assert found.residual < 1e-13
    assert found.largest == max(vars(found).values())


@pytest.mark.smoke
@pytest.mark.parametrize("joints", [1, 4])
def test_drawn_trees_agree(joints):
    assert differences(drawn_tree(joints, joints)).largest < DRAWN


@pytest.mark.long
@pytest.mark.parametrize("joints", range(2, 31, 4))
def test_larger_drawn_trees_agree(joints):
    assert differences(drawn_tree(100 + joints, joints)).largest < DRAWN


@pytest.mark.slow
def test_the_code_of_thirty_joints_is_no_longer_than_it_must():
    # it takes the compiler a time in proportion to its lines; see docs/speed.md
    few, many = (
        module_text(Registers(8), Reader(drawn_tree(7, joints)).tree).count("\n")
        for joints in (5, 30)
    )
    assert many < 8 * few


def test_the_equations_hold_for_plain_numbers():
    """They are those that are traced: with numbers, they need no compiler."""
    plant = drawn_tree(3, 3)
    reader, context = Reader(plant), plant.CreateDefaultContext()
    random = np.random.default_rng(0)
    q, v = random.normal(size=plant.num_positions()), random.normal(size=plant.num_velocities())
    force, own = random.normal(size=v.size), reader.parameters(context).tolist()
    plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
    plant.get_applied_generalized_force_input_port().FixValue(context, force)
    given = reader.tree, q.tolist()
    rates = plant.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(
        derivative(*given, v.tolist(), force.tolist(), own), rates, rtol=1e-11, atol=1e-11
    )
    np.testing.assert_allclose(mass_matrix(*given, own), plant.CalcMassMatrix(context), atol=1e-11)
    np.testing.assert_allclose(
        bias(*given, v.tolist(), own), plant.CalcBiasTerm(context), atol=1e-11
    )


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
def test_angles_are_within_an_ulp():
    tape = Tape()
    (angle,) = tape.inputs("q", 1)
    results = {"out": [sine(angle), cosine(angle)]}
    text = function(registers(), "turn", tape, {"q": 1}, results)
    code = Code(lambda: text)
    random = np.random.default_rng(1)
    angles = np.concatenate(
        [
            random.uniform(-10.0, 10.0, 4000),
            random.uniform(-1e6, 1e6, 4000),
            np.arange(-40, 41) * math.pi / 4,
            [0.0, -0.0, 1e-300, 1e-9, 5e-324],
        ]
    )
    found = np.zeros((angles.size, 2))
    turn, size = code.function("turn", 2), angles.size
    turn(angles.ctypes.data, found.ctypes.data, size)
    expected = np.array([[math.sin(x), math.cos(x)] for x in angles])
    assert (np.abs(found - expected) <= np.spacing(np.abs(expected))).all()
    angles[:] = np.resize([np.nan, np.inf, -np.inf, 1e6, 2e9, 1e308], angles.shape)
    turn(angles.ctypes.data, found.ctypes.data, size)
    assert np.isnan(found).all()


@pytest.mark.smoke
def test_tracking_errors_of_any_size_are_those_of_numpy():
    tree = Reader(drawn_tree(3, 2)).tree
    random = np.random.default_rng(4)
    size = tree.num_positions + tree.num_velocities
    desired, actual = (random.normal(size=(4001, size)) for _ in range(2))
    angles = np.concatenate(
        [10.0 ** random.uniform(-16, 0, 2000), random.uniform(0.0, 2.0 * math.pi, 1999), [0, 0]]
    )
    axes = random.normal(size=(angles.size, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.hstack([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axes])
    turns[-1] = [0.0, 1.0, 0.0, 0.0]  # half a turn
    actual[-1, :4] = [1.0, 0.0, 0.0, 0.0]
    desired[:, :4] = composed(turns, actual[:, :4])
    actual[100] = np.nan
    found = kernels_of(tree).calculated("tracking_errors", desired, actual)
    expected = np.hstack(tracking_errors(desired, actual, tree.num_positions))
    lengths = np.linalg.norm(expected[:, :3], axis=1)[:, None]
    assert np.isnan(found[100]).all()
    near = np.abs(found - expected)[:, :3] <= 2e-15 * lengths
    assert np.delete(near, 100, axis=0).all()
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=1e-11)


@pytest.mark.smoke
def test_a_copy_that_is_not_finite_leaves_the_others_alone():
    plant = drawn_tree(1, 2)
    reader = Reader(plant)
    kernels, random = kernels_of(reader.tree), np.random.default_rng(2)
    own = np.tile(reader.parameters(plant.CreateDefaultContext()), (11, 1))
    q, v = (random.normal(size=(11, n)) for n in (plant.num_positions(), plant.num_velocities()))
    force = random.normal(size=v.shape)
    expected = kernels.calculated("derivative", q, v, force, own)
    q[3], v[7], force[8] = np.nan, np.inf, np.nan
    q[9] = 0.0  # no rotation
    found = kernels.calculated("derivative", q, v, force, own)
    sound = [0, 1, 2, 4, 5, 6, 10]
    np.testing.assert_array_equal(found[sound], expected[sound])
    assert not np.isfinite(found[[3, 7, 8, 9]]).all(axis=1).any()


@pytest.mark.smoke
def test_a_copy_has_its_bits_in_any_lane():
    plant = drawn_tree(2, 2)
    reader = Reader(plant)
    kernels, random = kernels_of(reader.tree), np.random.default_rng(2)
    own = reader.parameters(plant.CreateDefaultContext())[None] * random.uniform(1, 2, (16, 1))
    q, v = (random.normal(size=(16, n)) for n in (plant.num_positions(), plant.num_velocities()))
    whole = [
        kernels.calculated("derivative", q, v, v, own),
        kernels.calculated("mass_matrix", q, own),
        kernels.calculated("bias", q, v, own),
    ]
    for size in (1, 5, 8):
        for first in range(0, 16 - size, size):
            part = slice(first, first + size)
            given = q[part], v[part], v[part], own[part]
            np.testing.assert_array_equal(kernels.calculated("derivative", *given), whole[0][part])
            matrices = kernels.calculated("mass_matrix", q[part], own[part])
            np.testing.assert_array_equal(matrices, whole[1][part])
            np.testing.assert_array_equal(
                kernels.calculated("bias", q[part], v[part], own[part]), whole[2][part]
            )


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


@pytest.mark.parametrize("width", [2, 4, 8])
def test_registers_of_any_width_give_the_same_bits(width):
    tree = Reader(drawn_tree(2, 2)).tree
    random = np.random.default_rng(3)
    rows = tree.num_positions, tree.num_parameters
    q, own = (random.uniform(0.5, 1.0, size=(11, count)) for count in rows)
    found = Kernels(tree, width).calculated("mass_matrix", q, own)
    np.testing.assert_array_equal(found, kernels_of(tree).calculated("mass_matrix", q, own))


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


def test_a_copy_takes_another_payload():
    scenario = load_scenario("postcapture")
    models = [make_nominal_plant(scenario), make_nominal_plant(scenario)]
    both = model_of(models, kernels_of(Reader(models[0].plant).tree))
    q = np.tile([1.0, *np.zeros(11)], (2, 1))
    before = both.calc_mass_matrix(q).copy()
    heavier = MassProperties(mass=150.0, inertia=[20.0, 20.0, 20.0])
    set_payload(models[1].plant, models[1].context, body=scenario.payload.body, properties=heavier)
    both.take(1)
    after = both.calc_mass_matrix(q)
    assert (after[0] == before[0]).all()
    np.testing.assert_allclose(after[1], models[1].calc_mass_matrix(q[1]), rtol=1e-12, atol=1e-12)
    assert after[1, 3, 3] == pytest.approx(before[1, 3, 3] + 150.0 - 80.0)
