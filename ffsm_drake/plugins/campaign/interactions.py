"""Interactions: what two drawn values explain of an outcome together, beyond each alone.

The estimates use the cases of a campaign, no further runs. The outcome is projected onto products
of orthonormal polynomials of two values: the second-order terms of a high-dimensional model
representation (Li, Rosenthal, Rabitz 2001, doi 10.1021/jp010450t). The level of chance is that of
a wild bootstrap with random signs (Liu 1988, doi 10.1214/aos/1176351062), as the scatter of a
failure depends on the values.
"""

import dataclasses
import itertools

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from scipy.stats import rankdata

DEGREE = 4  # of a polynomial of a value, with enough cases
_CASES_EACH = 5  # least number of cases for each coefficient of the additive model
_MOST_VALUES, _MOST_CASES = 24, 4000
_SIGNS = 400  # draws of the bootstrap
_CONFIDENCE = 0.95


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interactions:
    """Shares of the variance of an outcome that are due to interactions of two values."""

    # first, second (names), share, chance, matters, and the quadrant about the medians with the
    # largest outcome: ``sides`` of the two ("high, low"), ``observed`` and ``additive`` mean there
    pairs: pd.DataFrame
    together: pd.Series  # by name: sum over the pairs with this value
    together_chance: float


def interactions(values: pd.DataFrame, outcome: np.ndarray, *, seed: int) -> Interactions:
    """Return the interactions of independent values (n, k) in an outcome (n,) that varies.

    The share of a pair is the second-order Sobol index as far as polynomials up to DEGREE follow
    it, thus rather too small; its mean is zero without an interaction. The level ``chance`` is
    exceeded by any pair in one of twenty campaigns without interactions, ``together_chance`` by the
    sum of any value. Of more than 24 values those that correlate most are used, of more than 4,000
    cases a random part.
    """
    generator = np.random.default_rng(seed)
    values, outcome = _bounded(values, outcome, generator)
    n, k = values.shape
    degree = min(DEGREE, (n // _CASES_EACH - 1) // max(k, 1))
    if degree < 1 or k < 2:
        return _nothing(values)
    bases = [_basis(values[name].to_numpy(), degree) for name in values]
    model = np.column_stack([np.ones(n), *bases])
    fit = model @ np.linalg.lstsq(model, outcome)[0]
    rest, variance = outcome - fit, outcome.var()
    signs = generator.choice((-1.0, 1.0), (_SIGNS, n))
    rows, largest = [], np.full(_SIGNS, -np.inf)
    sums, by_chance = np.zeros(k), np.zeros((k, _SIGNS))
    for i, j in itertools.combinations(range(k), 2):
        share, drawn = _share(bases[i], bases[j], rest / variance**0.5, signs)
        largest = np.maximum(largest, drawn)
        for each in (i, j):
            sums[each] += share
            by_chance[each] += drawn
        pair = values.iloc[:, [i, j]]
        rows.append((*pair.columns, share, *_excess(pair, outcome, fit)))
    names = ["first", "second", "share", "sides", "observed", "additive"]
    chance = float(np.quantile(largest, _CONFIDENCE))
    pairs = pd.DataFrame(rows, columns=names).assign(chance=chance)
    pairs = pairs.assign(matters=pairs["share"] > chance)
    return Interactions(
        pairs=pairs.sort_values("share", ascending=False, kind="stable", ignore_index=True),
        together=pd.Series(sums, index=values.columns),
        together_chance=float(np.quantile(by_chance.max(axis=0), _CONFIDENCE)),
    )


def _bounded(
    values: pd.DataFrame, outcome: np.ndarray, generator: np.random.Generator
) -> tuple[pd.DataFrame, np.ndarray]:
    if len(values) > _MOST_CASES:
        kept = np.sort(generator.choice(len(values), _MOST_CASES, replace=False))
        values, outcome = values.iloc[kept], outcome[kept]
    values = values.loc[:, values.nunique() > 1]
    if values.shape[1] > _MOST_VALUES:
        sizes = values.rank().corrwith(pd.Series(outcome, index=values.index)).abs()
        values = values[sizes.nlargest(_MOST_VALUES).index]
    return values, outcome


def _nothing(values: pd.DataFrame) -> Interactions:
    names = ["first", "second", "share", "sides", "observed", "additive", "chance", "matters"]
    together = pd.Series(0.0, index=values.columns)
    pairs = pd.DataFrame(columns=names).astype({"matters": bool})
    return Interactions(pairs=pairs, together=together, together_chance=np.inf)


def _basis(values: np.ndarray, degree: int) -> np.ndarray:
    """Polynomials of the ranks (n, at most degree), orthonormal on the sample, without the
    constant.
    """
    scores = 2.0 * (rankdata(values) - 0.5) / values.size - 1.0
    most = min(degree, np.unique(values).size - 1)
    orthogonal, _ = np.linalg.qr(np.polynomial.legendre.legvander(scores, most))
    return np.sqrt(values.size) * orthogonal[:, 1:]


def _share(
    first: np.ndarray, second: np.ndarray, rest: np.ndarray, signs: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the share of a pair, less its mean without an interaction, and the shares (_SIGNS,)
    with random signs of the residuals (n,).
    """
    terms = (first[:, :, None] * second[:, None, :]).reshape(rest.size, -1)
    terms = terms * rest[:, None] / rest.size
    noise = (terms**2).sum()
    drawn = signs @ terms
    return float((terms.sum(axis=0) ** 2).sum() - noise), (drawn**2).sum(axis=1) - noise


def _excess(pair: pd.DataFrame, outcome: np.ndarray, fit: np.ndarray) -> tuple[str, float, float]:
    """Return the quadrant about the medians with the largest outcome, of those where it is above
    the additive model, in words, with the mean of the outcome and of the model there.
    """
    high = (pair > pair.median()).to_numpy()
    found = list[tuple[str, float, float]]()
    for sides in itertools.product((False, True), repeat=2):
        if (here := (high == sides).all(axis=1)).any():
            words = ", ".join("high" if side else "low" for side in sides)
            found.append((words, outcome[here].mean(), fit[here].mean()))
    above = [each for each in found if each[1] > each[2]]
    return max(above or found, key=lambda each: each[1])
