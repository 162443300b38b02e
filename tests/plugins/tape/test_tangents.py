"""Derivatives on a tape: against central differences of NumPy's own numbers."""

import numpy as np
import pytest
from tape_cases import CASES, evaluated

from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Symbol, Tape
from ffsm_drake.plugins.tape.tangents import tangents

STEP = 1e-5


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_differences(name):
    tape, random = Tape(), np.random.default_rng(7)
    x = inputs(tape, "x", (4,))
    flat = [each for result in CASES[name](x) for each in np.asarray(result, object).ravel()]
    direction = tape.inputs("d", 4)
    seeds = {symbol.index: way for symbol, way in zip(x, direction, strict=True)}
    slopes = np.array(tangents(tape, flat, seeds), dtype=object)
    for _ in range(5):
        values, way = random.uniform(-0.9, 2.0, size=4), random.normal(size=4)
        both = {"x": values, "d": way}
        found = evaluated(tape, both, slopes)

        def at(step, values=values, way=way):
            results = CASES[name](values + step * way)
            return np.concatenate([np.ravel(np.asarray(each, dtype=float)) for each in results])

        expected = (at(STEP) - at(-STEP)) / (2.0 * STEP)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_a_choice_needs_no_derivative_of_what_it_leaves():
    """A norm at zero has none."""
    tape = Tape()
    x = inputs(tape, "x", (2,))
    length = np.sqrt(x @ x)
    guarded = np.where(length > 1e-9, x / length, x)
    (way,) = tape.inputs("d", 1)
    slopes = tangents(tape, list(guarded), {x[0].index: way})
    assert isinstance(slopes[0], Symbol)
    with np.errstate(all="ignore"):
        found = evaluated(tape, {"x": np.zeros(2), "d": np.ones(1)}, np.array(slopes, object))
    assert found.tolist() == [1.0, 0.0]


def test_roots_and_powers_at_zero_have_the_slope_of_both_sides():
    tape = Tape()
    x = inputs(tape, "x", (2,))
    results = [np.sqrt(x @ x), (np.abs(x[0]) ** 0.3) * x[1], np.abs(x[0]) ** 1.5]
    ways = tape.inputs("d", 2)
    slopes = tangents(tape, results, {x[k].index: ways[k] for k in range(2)})
    with np.errstate(all="ignore"):
        found = evaluated(tape, {"x": np.zeros(2), "d": np.ones(2)}, np.array(slopes, object))
    assert found.tolist() == [0.0, 0.0, 0.0]
