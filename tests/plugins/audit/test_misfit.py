"""Choice among drawn mistakes: a name is given only if it is better than the others."""

import math

import numpy as np
import pytest

from ffsm_drake.plugins.audit.checks import AMBIGUOUS
from ffsm_drake.plugins.audit.misfit import Mistake, named, swing


def wave(draw):
    """A drawn smooth path (n, 1) with a swing of 1."""
    rate, phase = draw.uniform(1.0, 9.0, 3), draw.uniform(0.0, 6.0, 3)
    path = np.sin(np.linspace(0.0, 1.0, 200)[:, None] * rate + phase).sum(axis=1, keepdims=True)
    return path / swing(path)


def across(draw, path):
    """A drawn path with a swing of 1 that no size of another path explains."""
    own, other = path - path.mean(), wave(draw)
    other = other - other.mean()
    other = other - own * (own * other).sum() / (own**2).sum()
    return other / swing(other)


def mistake(cause, *columns):
    return Mistake(cause=cause, text=f"{cause} {{0}}", columns=columns)


def chosen(missed, mistakes, doubt):
    return named(missed, np.zeros_like(missed), mistakes, doubt)


@pytest.mark.parametrize("doubt", [1e-4, math.inf])
def test_a_name_is_given_only_if_one_explains_the_most(doubt):
    """Others that leave 1 to 2 % of the residual are no reason to name one of them."""
    for seed in range(8):
        draw = np.random.default_rng(seed)
        true, count = wave(draw), draw.integers(2, 5)
        others = [
            mistake(f"other_{i}", true + draw.uniform(0.01, 0.02) * across(draw, true))
            for i in range(count)
        ]
        found = chosen(true, others, doubt)
        assert found.cause == AMBIGUOUS, seed
        assert str(found).endswith("; none of these explains all of it")
        others.insert(draw.integers(count + 1), mistake("true", true))
        assert chosen(true, others, doubt).cause == "true", seed
        twins = [mistake("true", true), mistake("twin", true)]
        both = "true or twin" if math.isfinite(doubt) else AMBIGUOUS
        assert chosen(true + 1e-6 * wave(draw), twins, doubt).cause == both, seed


@pytest.mark.parametrize("doubt", [1e-6, math.inf])
def test_fewer_sizes_are_preferred_only_if_they_leave_about_as_little(doubt):
    """As an offset leaves 0.5 to 5 % of a spring with a small stiffness."""
    for seed in range(8):
        draw = np.random.default_rng(seed)
        large = wave(draw)
        small = across(draw, large)
        missed = large + draw.uniform(0.005, 0.05) * small
        mistakes = [mistake("offset", large), mistake("spring", small, large)]
        assert chosen(missed, mistakes, doubt).cause == "spring", seed
        assert chosen(large, mistakes, doubt).cause == "offset", seed
