"""NumPy code on symbols: its tape gives what NumPy gives, or the code is refused with one line."""

import math

import numpy as np
import pytest
from tape_cases import CASES, evaluated, halved

from ffsm_drake.common.choice import repeated
from ffsm_drake.plugins.tape.arrays import Traced, inputs, traced
from ffsm_drake.plugins.tape.numbers import NotTraceable, Tape, number
from ffsm_drake.plugins.tape.programs import Program
from ffsm_drake.plugins.tape.tangents import tangents


@pytest.mark.parametrize("name", CASES)
def test_the_tape_gives_what_numpy_gives(name):
    tape, random = Tape(), np.random.default_rng(5)
    results = CASES[name](inputs(tape, "x", (4,)))
    for _ in range(5):
        values = random.uniform(-0.9, 2.0, size=4)
        for found, expected in zip(results, CASES[name](values), strict=True):
            assert np.allclose(evaluated(tape, values, found), expected, rtol=1e-12, atol=1e-14)


REFUSED = {
    "a branch": lambda x: 1.0 if x[0] > 0.0 else 2.0,
    "a branch on all": lambda x: 1.0 if (x > 0.0).all() else 2.0,
    "float": lambda x: float(x[0]),
    "math": lambda x: math.sqrt(x[0]),
    "an index": lambda x: np.eye(4)[int(x[0])],
    "a mask": lambda x: x[x > 0.0],
    "an array of numbers": lambda x: np.zeros(4).__setitem__(0, x[0]),
    "out": lambda x: np.add(x, x, out=np.zeros(4)),
    "eigenvalues": lambda x: np.linalg.eigh(np.outer(x, x)),
    "sorted": lambda x: np.sort(x),
    "whole numbers": lambda x: x.astype(int),
    "an order": lambda x: np.linalg.norm(x, 1),
    "changed": lambda x: x.__setitem__(0, 1.0),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_needs_a_value_is_refused(name):
    x = inputs(Tape(), "x", (4,))
    x.setflags(write=False)
    with pytest.raises((NotTraceable, ValueError)):
        REFUSED[name](x)


@pytest.mark.smoke
def test_equal_operations_are_one():
    tape = Tape()
    x = inputs(tape, "x", (2,))
    assert (x[0] + x[1]) is (x[1] + x[0])
    assert number(x[0] - x[0]) == 0.0
    assert isinstance(traced([x[0], 1.0]) * 2.0, Traced)


@pytest.mark.parametrize("most", [3, 40])
def test_loops_give_what_they_give_on_numbers(most):
    """Equal loops are one. A loop has no derivative."""
    tape, random = Tape(), np.random.default_rng(2)
    x = inputs(tape, "x", (2,))
    twice = halved(halved(x, most), most)
    assert len(tape.loops) == 1
    for _ in range(5):
        values = random.uniform(0.1, 1e4, size=2)
        expected = halved(halved(values, most), most)
        np.testing.assert_array_equal(evaluated(tape, values, twice), expected)
    with pytest.raises(NotTraceable, match="derivative of a loop"):
        tangents(tape, [twice[0]], {x[0].index: 1.0})
    with pytest.raises(NotTraceable, match="another sample"):
        repeated(lambda state, fixed: {"x": state["x"] + x[0]}, {"x": x[:1]}, {}, most=1)


@pytest.mark.parametrize("name", ["sums", "products", "quotients"])
def test_a_program_computes_many_inputs_at_once(name):
    tape, columns = Tape(), np.random.default_rng(1).normal(size=(4, 5))
    x = inputs(tape, "x", (4,))
    results = [*np.concatenate([np.ravel(each) for each in CASES[name](x)])]
    found = np.stack(np.broadcast_arrays(*Program(tape, results).run({"x": columns})))
    expected = [evaluated(tape, column, results) for column in columns.T]
    np.testing.assert_allclose(found.T, expected, rtol=1e-15, atol=1e-15)
    with pytest.raises(NotTraceable, match="a program with abs"):
        Program(tape, [*np.abs(x)])
