"""Intervals and tests of laws on the same seeds, against SciPy, enumeration and drawn samples."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from ffsm_drake.plugins.benchmark.paired import (
    FEWEST,
    discordant,
    holm,
    mean,
    share,
    signed_rank,
)

SYMMETRIC = {
    "normal": lambda rng, n: rng.normal(size=n),
    "long tails": lambda rng, n: rng.standard_t(2, size=n),
    "uniform": lambda rng, n: rng.uniform(-1.0, 1.0, size=n),
    "two peaks": lambda rng, n: rng.choice([-1.0, 1.0], n) + 0.2 * rng.normal(size=n),
}


def least_covered(draws, confidence=0.95):
    """Number of covered draws that a true coverage falls below once in a thousand."""
    return stats.binom.ppf(1e-3, draws, confidence)


@pytest.mark.parametrize("n", [FEWEST, 9, 20, 33])
def test_signed_ranks_are_those_of_scipy(n):
    rng = np.random.default_rng([1, n])
    for _ in range(20):
        sample = rng.normal(rng.uniform(-1.0, 1.0), 1.0, n)
        inside, p = signed_rank(sample)
        assert p == pytest.approx(stats.wilcoxon(sample, method="exact").pvalue, rel=1e-9)
        assert inside.low <= inside.value <= inside.high
        assert (inside.low > 0.0 or inside.high < 0.0) == (p <= 0.05)
        assert signed_rank(-sample)[1] == pytest.approx(p)


@pytest.mark.smoke
@pytest.mark.parametrize("kind", SYMMETRIC)
def test_the_interval_of_signed_ranks_covers(kind):
    """At least as often as it says, and not always."""
    rng = np.random.default_rng([2, len(kind)])
    draws, covered, alarms = 400, 0, 0
    for _ in range(draws):
        inside, _ = signed_rank(3.0 + SYMMETRIC[kind](rng, 20))
        covered += inside.low <= 3.0 <= inside.high
        alarms += signed_rank(SYMMETRIC[kind](rng, 20))[1] <= 0.05
    assert least_covered(draws) <= covered < draws
    assert 0 < alarms <= draws - least_covered(draws)


def test_equal_values_are_no_difference():
    inside, p = signed_rank(np.zeros(20))
    assert (inside.value, inside.low, inside.high, p) == (0.0, 0.0, 0.0, 1.0)


def test_the_interval_of_a_mean_covers():
    rng = np.random.default_rng(3)
    samples = rng.normal(2.0, 0.3, size=(400, 20))
    found = [mean(sample) for sample in samples]
    assert sum(each.low <= 2.0 <= each.high for each in found) >= least_covered(400)
    assert found[0].high == pytest.approx(
        stats.ttest_1samp(samples[0], 0.0).confidence_interval().high
    )
    assert math.isnan(mean([1.0]).low)


@pytest.mark.parametrize(("count", "runs"), [(0, 20), (20, 20), (7, 20), (1, 3)])
def test_shares_have_wilsons_interval(count, runs):
    """The bounds solve (p - q)^2 = z^2 q (1 - q) / n."""
    found = share(count, runs)
    for q in (found.low, found.high):
        assert (found.value - q) ** 2 == pytest.approx(
            stats.norm.ppf(0.975) ** 2 * q * (1.0 - q) / runs, abs=1e-12
        )


@pytest.mark.parametrize(("first", "second"), [(0, 0), (5, 0), (6, 1), (3, 3)])
def test_mcnemar_is_exact(first, second):
    """Over all signs of the discordant cases."""
    n, distance = first + second, abs(first - second)
    signs = itertools.product((-1, 1), repeat=n)
    expected = sum(abs(sum(each)) >= distance for each in signs) / 2**n
    assert discordant(first, second) == pytest.approx(expected)


def test_holm_keeps_the_chance_of_any_false_finding():
    """Of 40 tests without a difference; a clear one among them is still found."""
    rng = np.random.default_rng(4)
    families = rng.uniform(size=(400, 40))
    false = sum(min(holm(p)) < 0.05 for p in families)
    assert 0 < false <= 400 - least_covered(400)
    families[:, 0] = 1e-6
    assert all(holm(p)[0] < 0.05 for p in families)
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
