"""Statistics of laws on the same seeds: intervals, paired tests against one law, and Holm's
correction. They cover the seeds, thus noise sequences; not other gains, payloads or missions.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import stats

from ffsm_drake.plugins.campaign.statistics import CONFIDENCE, Interval, paired_proportions

REFERENCE = "tde_aismc"  # the law of the paper
COMPARED = ("itae", "isv")  # metrics whose ratio to the reference's is tested
SETTLED = "settled"
FEWEST = 6  # pairs: with fewer, no signed-rank interval of 95 % is finite


def share(count: int, runs: int) -> Interval:
    """Return a share of runs with Wilson's score interval (1927)."""
    found = stats.binomtest(count, runs).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(value=count / runs, low=float(found.low), high=float(found.high))


def mean(values: Sequence[float]) -> Interval:
    """Return the mean of values (n,), n > 0, with Student's interval; a single one has none
    (NaN).
    """
    sample = np.array(values)
    half = math.nan
    if sample.size > 1:
        quantile = stats.t.ppf(0.5 + 0.5 * CONFIDENCE, sample.size - 1)
        half = float(quantile * sample.std(ddof=1) / math.sqrt(sample.size))
    value = float(sample.mean())
    return Interval(value=value, low=value - half, high=value + half)


def signed_rank(differences: np.ndarray) -> tuple[Interval, float]:
    """Return the Hodges-Lehmann estimate of the centre of paired differences (n,), n >= FEWEST,
    its interval, and the p-value of no difference, both from the exact distribution of Wilcoxon's
    signed-rank statistic (Hollander, Wolfe, Chicken 2014, sections 3.1 to 3.3).

    The differences may have any symmetric distribution. Ties count as halves.
    """
    n = differences.size
    first, second = np.triu_indices(n)
    walsh = np.sort(0.5 * (differences[first] + differences[second]))
    at_most = _at_most(n)
    positive = float((walsh > 0.0).sum() + 0.5 * (walsh == 0.0).sum())
    tail = at_most[math.ceil(min(positive, walsh.size - positive))]
    outside = int(np.searchsorted(at_most, 0.5 * (1.0 - CONFIDENCE), side="right"))
    return Interval(
        value=float(np.median(walsh)), low=float(walsh[outside - 1]), high=float(walsh[-outside])
    ), min(1.0, 2.0 * float(tail))


@functools.cache
def _at_most(n: int) -> np.ndarray:
    """Chance that the sum of the positive ranks of n differences is at most its index."""
    ways = np.ones(1)  # of the signs, by the sum
    for rank in range(1, n + 1):
        ways = np.pad(ways, (0, rank)) + np.pad(ways, (rank, 0))
    return np.cumsum(ways) / 2.0**n


def discordant(first: int, second: int) -> float:
    """P-value of equal success rates on the same cases, of which only one law settled ``first``
    and only the other ``second``: McNemar's exact test.
    """
    return float(stats.binomtest(first, first + second).pvalue) if first + second else 1.0


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values adjusted for the number of tests (Holm 1979): rejecting below 5 % calls any
    difference by chance with at most 5 %.
    """
    order, largest, adjusted = np.argsort(p), 0.0, [1.0] * len(p)
    for done, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - done) * p[index]))
        adjusted[index] = largest
    return adjusted


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compared:
    """A quantity of a law compared with that of REFERENCE on the same seeds."""

    value: Interval  # without a correction
    neutral: float  # value of equal laws
    pairs: int
    p: float  # without and with Holm's correction
    adjusted: float = math.nan

    @property
    def finding(self) -> str:
        """``larger`` or ``smaller`` than the reference's, or ``within noise``."""
        if not self.adjusted < 1.0 - CONFIDENCE:
            return "within noise"
        return "larger" if self.value.value > self.neutral else "smaller"


Rows = Sequence[Mapping[str, Any]]  # the results of a law by seed


def compared(rows: Rows, reference: Rows) -> dict[str, Compared]:
    """Return what can be compared: the difference of the shares of ``SETTLED`` runs, and the ratio
    of each metric of ``COMPARED`` over the seeds that both laws settled, if there are enough.
    """
    one, other = (
        np.array([row["outcome"] == SETTLED for row in each]) for each in (rows, reference)
    )
    only = int((one & ~other).sum()), int((other & ~one).sum())
    shares = paired_proportions(*only, one.size)
    found = {SETTLED: Compared(value=shares, neutral=0.0, pairs=one.size, p=discordant(*only))}
    both = [int(k) for k in np.flatnonzero(one & other)]
    if len(both) < FEWEST:
        return found
    for metric in COMPARED:
        values = np.array([[each[k][metric] for k in both] for each in (rows, reference)])
        if values.min() <= 0.0:
            continue
        inside, p = signed_rank(np.subtract(*np.log(values)))
        ends = {name: math.exp(value) for name, value in dataclasses.asdict(inside).items()}
        found[metric] = Compared(value=Interval(**ends), neutral=1.0, pairs=len(both), p=p)
    return found


def corrected(found: Mapping[Any, Mapping[str, Compared]]) -> dict[Any, dict[str, Compared]]:
    """Return comparisons with Holm's correction over all of them; ``found`` is by any key."""
    flat = [(key, name, each) for key, some in found.items() for name, each in some.items()]
    made: dict[Any, dict[str, Compared]] = {key: {} for key in found}
    for (key, name, each), p in zip(flat, holm([each.p for _, _, each in flat]), strict=True):
        made[key][name] = dataclasses.replace(each, adjusted=p)
    return made
