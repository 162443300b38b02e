"""Interactions of drawn values, against functions whose Sobol indices are known."""

import itertools

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from scipy.stats import qmc

from ffsm_drake.plugins.campaign.interactions import interactions

PI = np.pi


def ishigami(rng):
    """Ishigami and Homma 1990, with drawn constants."""
    a, b = rng.uniform(2.0, 9.0), rng.uniform(0.03, 0.15)

    def function(u):
        x = PI * (2.0 * u - 1.0)
        return np.sin(x[:, 0]) * (1.0 + b * x[:, 2] ** 4) + a * np.sin(x[:, 1]) ** 2

    pair = 8.0 * b**2 * PI**8 / 225.0
    variance = a**2 / 8.0 + b * PI**4 / 5.0 + b**2 * PI**8 / 18.0 + 0.5
    return function, 3, {(0, 2): pair / variance}


def sobol_g(rng):
    """Sobol and Saltelli's product of |4 x - 2|, with drawn constants."""
    k = 4
    a = rng.uniform(0.0, 5.0, k)
    single = 1.0 / (3.0 * (1.0 + a) ** 2)
    variance = np.prod(1.0 + single) - 1.0

    def function(u):
        return np.prod((np.abs(4.0 * u - 2.0) + a) / (1.0 + a), axis=1)

    pairs = itertools.combinations(range(k), 2)
    return function, k, {(i, j): single[i] * single[j] / variance for i, j in pairs}


def product(rng):
    """A product of three values with drawn means; a fourth does nothing."""
    means = rng.uniform(0.2, 1.0, 3)
    single = 1.0 / 12.0
    shares = single / means**2
    variance = np.prod(1.0 + shares) - 1.0

    def function(u):
        return np.prod(u[:, :3] - 0.5 + means, axis=1)

    pairs = itertools.combinations(range(3), 2)
    return function, 4, {(i, j): shares[i] * shares[j] / variance for i, j in pairs}


def drawn(rng, n, k):
    return qmc.LatinHypercube(k, rng=rng).random(n)


def shares_of(u, outcome, seed):
    names = [f"x{i}" for i in range(u.shape[1])]
    found = interactions(pd.DataFrame(u, columns=names), outcome, seed=seed)
    index = {name: i for i, name in enumerate(names)}
    pairs = {tuple(sorted((index[p.first], index[p.second]))): p for p in found.pairs.itertuples()}
    return found, pairs


@pytest.mark.smoke
@pytest.mark.parametrize("make", [ishigami, sobol_g, product])
@pytest.mark.parametrize("seed", range(4))
def test_shares_are_the_second_order_indices(make, seed):
    """Where they are large beyond chance and within 0.05, and none is reported that is not."""
    rng = np.random.default_rng([5, seed])
    function, k, known = make(rng)
    u = drawn(rng, 1500, k)
    found, pairs = shares_of(u, function(u), seed)
    for pair, row in pairs.items():
        expected = known.get(pair, 0.0)
        assert row.share == pytest.approx(expected, abs=0.05), pair
        if expected > 0.05:
            assert row.matters, pair
        if expected == 0.0:
            assert row.share < 2.0 * row.chance
    for i in range(k):
        expected = sum(share for pair, share in known.items() if i in pair)
        assert found.together[f"x{i}"] == pytest.approx(expected, abs=0.08)


ADDITIVE = {
    "edge": lambda rng, u: (u[:, 0] > rng.uniform(0.6, 0.9)).astype(float),
    "probability": lambda rng, u: (rng.random(len(u)) < 0.1 + 0.8 * u[:, 0]).astype(float),
    "rare": lambda rng, u: (rng.random(len(u)) < 0.3 * (u[:, 0] > 0.8) + 0.1 * u[:, 1]).astype(
        float
    ),
    "long tails": lambda rng, u: (
        u[:, 0] ** 2 + np.sin(6.0 * u[:, 1]) + 0.3 * rng.standard_t(3, len(u))
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", ADDITIVE)
def test_noise_is_not_called_an_interaction(kind):
    """In 5 % of campaigns at most, up to what 60 draws of at most 8 % can show."""
    draws, alarms = 60, 0
    for seed in range(draws):
        rng = np.random.default_rng([6, seed])
        u = drawn(rng, int(rng.integers(80, 400)), int(rng.integers(2, 6)))
        outcome = ADDITIVE[kind](rng, u)
        if outcome.min() < outcome.max():
            alarms += shares_of(u, outcome, seed)[0].pairs["matters"].any()
    assert alarms <= stats.binom.ppf(0.999, draws, 0.08)


@pytest.mark.parametrize("seed", range(5))
def test_two_harmless_values_that_fail_together_are_found(seed):
    """Among others; the quadrant in which they fail is named."""
    rng = np.random.default_rng([7, seed])
    k = int(rng.integers(4, 10))
    u = drawn(rng, 400, k)
    i, j = sorted(rng.choice(k, 2, replace=False))
    sides, edge = rng.integers(0, 2, 2), rng.uniform(0.55, 0.7)
    inside = [
        np.where(side, u[:, each], 1.0 - u[:, each]) > edge
        for each, side in zip((i, j), sides, strict=True)
    ]
    found, _ = shares_of(u, (inside[0] & inside[1]).astype(float), seed)
    first = found.pairs.iloc[0]
    assert {first["first"], first["second"]} == {f"x{i}", f"x{j}"}
    assert first.matters
    side_of = dict(zip((f"x{i}", f"x{j}"), np.where(sides, "high", "low"), strict=True))
    assert first.sides == f"{side_of[first['first']]}, {side_of[first['second']]}"
    assert first.observed > first.additive


def test_few_cases_and_constant_values_give_no_interaction():
    rng = np.random.default_rng(8)
    u = pd.DataFrame(drawn(rng, 12, 4), columns=list("abcd"))
    assert interactions(u, (u["a"] > 0.5).to_numpy(float), seed=0).pairs.empty
    u = pd.DataFrame(drawn(rng, 200, 2), columns=list("ab")).assign(b=1.0)
    found = interactions(u, (u["a"] > 0.5).to_numpy(float), seed=0)
    assert found.pairs.empty
    assert not (found.together > found.together_chance).any()


@pytest.mark.long
def test_many_values_and_cases_are_bounded():
    """Values with few levels, too."""
    rng = np.random.default_rng(9)
    u = pd.DataFrame(drawn(rng, 5000, 30)).rename(columns="x{}".format)
    u["x3"] = np.round(2.0 * u["x3"])
    outcome = ((u["x3"] == 2.0) ^ (u["x7"] > 0.5)).to_numpy(float) + u["x7"].to_numpy()
    found = interactions(u + 0.0, outcome, seed=0)
    first = found.pairs.iloc[0]
    assert {first["first"], first["second"]} == {"x3", "x7"}
    assert len(found.pairs) == 24 * 23 // 2
