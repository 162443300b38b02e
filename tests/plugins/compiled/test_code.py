"""Compiled functions: their accuracy, and copies that do not depend on each other."""

import functools
import math

import numpy as np
import pytest
from compiled_equations import compiled, of_copies, text_of, text_of_traced
from drawn_trees import drawn_tree
from tape_cases import halved

from ffsm_drake.common.choice import repeated
from ffsm_drake.plugins.compiled.compiling import registers
from ffsm_drake.plugins.compiled.registers import Registers
from ffsm_drake.plugins.equations.equations import mass_matrix
from ffsm_drake.plugins.equations.tree import Reader
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape, cosine, sine


@functools.cache
def code_of(name, tree):
    return compiled(name, tree)


@pytest.mark.slow
def test_the_code_of_thirty_joints_is_no_longer_than_it_must():
    # it takes the compiler a time in proportion to its lines; see docs/speed.md
    few, many = (
        text_of("derivative", Registers(8), Reader(drawn_tree(7, joints)).tree).count("\n")
        for joints in (5, 30)
    )
    assert many < 8 * few


@pytest.mark.smoke
def test_angles_are_within_an_ulp():
    tape = Tape()
    (angle,) = tape.inputs("q", 1)
    text = text_of_traced(registers(), tape, {"q": 1}, [sine(angle), cosine(angle)])
    turn = of_copies(text, registers(), 1, 2)
    random = np.random.default_rng(1)
    angles = np.concatenate(
        [
            random.uniform(-10.0, 10.0, 4000),
            random.uniform(-1e6, 1e6, 4000),
            np.arange(-40, 41) * math.pi / 4,
            [0.0, -0.0, 1e-300, 1e-9, 5e-324],
        ]
    )
    found = turn(angles[:, None])
    expected = np.array([[math.sin(x), math.cos(x)] for x in angles])
    assert (np.abs(found - expected) <= np.spacing(np.abs(expected))).all()
    angles[:] = np.resize([np.nan, np.inf, -np.inf, 1e6, 2e9, 1e308], angles.shape)
    assert np.isnan(turn(angles[:, None])).all()


@pytest.mark.smoke
def test_a_copy_that_is_not_finite_leaves_the_others_alone():
    plant = drawn_tree(1, 2)
    reader = Reader(plant)
    tree, random = reader.tree, np.random.default_rng(2)
    own = np.tile(reader.parameters(plant.CreateDefaultContext()), (11, 1))
    q, v = (random.normal(size=(11, n)) for n in (plant.num_positions(), plant.num_velocities()))
    force = random.normal(size=v.shape)
    expected = code_of("derivative", tree)(q, v, force, own)
    q[3], v[7], force[8] = np.nan, np.inf, np.nan
    q[9] = 0.0  # no rotation
    found = code_of("derivative", tree)(q, v, force, own)
    sound = [0, 1, 2, 4, 5, 6, 10]
    np.testing.assert_array_equal(found[sound], expected[sound])
    assert not np.isfinite(found[[3, 7, 8, 9]]).all(axis=1).any()


@pytest.mark.smoke
def test_a_copy_has_its_bits_in_any_lane():
    plant = drawn_tree(2, 2)
    reader = Reader(plant)
    tree, random = reader.tree, np.random.default_rng(2)
    own = reader.parameters(plant.CreateDefaultContext())[None] * random.uniform(1, 2, (16, 1))
    q, v = (random.normal(size=(16, n)) for n in (plant.num_positions(), plant.num_velocities()))
    whole = [
        code_of("derivative", tree)(q, v, v, own),
        code_of("mass_matrix", tree)(q, own),
        code_of("bias", tree)(q, v, own),
    ]
    for size in (1, 5, 8):
        for first in range(0, 16 - size, size):
            part = slice(first, first + size)
            given = q[part], v[part], v[part], own[part]
            np.testing.assert_array_equal(code_of("derivative", tree)(*given), whole[0][part])
            matrices = code_of("mass_matrix", tree)(q[part], own[part])
            np.testing.assert_array_equal(matrices, whole[1][part])
            np.testing.assert_array_equal(
                code_of("bias", tree)(q[part], v[part], own[part]), whole[2][part]
            )


@pytest.mark.parametrize("width", [2, 4, 8])
def test_registers_of_any_width_give_the_same_bits(width):
    tree = Reader(drawn_tree(2, 2)).tree
    random = np.random.default_rng(3)
    rows = tree.num_positions, tree.num_parameters
    q, own = (random.uniform(0.5, 1.0, size=(11, count)) for count in rows)
    found = compiled("mass_matrix", tree, width)(q, own)
    np.testing.assert_array_equal(found, code_of("mass_matrix", tree)(q, own))


@pytest.mark.parametrize("width", [1, 8])
def test_copies_leave_a_loop_one_by_one(width):
    """Each has what it has on numbers, whatever the others do; within a loop there is another."""
    tape, of = Tape(), Registers(width)

    def step(state, fixed):
        inner = halved(state["x"], 3)
        return {"goes": inner[0] > fixed["least"], "x": inner}

    def nested(x):
        return repeated(step, {"goes": True, "x": x}, {"least": np.array(2.0)}, most=20)["x"]

    row = [*nested(inputs(tape, "x", (2,)))]
    run = of_copies(text_of_traced(of, tape, {"x": 2}, row), of, 1, 2)
    values = 10.0 ** np.random.default_rng(1).uniform(-2, 8, size=(19, 2))
    values[3] = np.nan
    expected = [nested(each) for each in values]
    np.testing.assert_array_equal(run(values), expected)


def test_compiled_equations_are_those_on_numbers():
    plant = drawn_tree(3, 3)
    reader, random = Reader(plant), np.random.default_rng(0)
    q, own = (
        random.normal(size=plant.num_positions()),
        reader.parameters(plant.CreateDefaultContext()),
    )
    expected = np.ravel(mass_matrix(reader.tree, q, own))
    found = code_of("mass_matrix", reader.tree)(q[None], own[None])[0]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
