"""A covering array: few rows in which every allowed pair of values of two factors occurs."""

import itertools
from random import Random

_TRIED, _MOST = 8, 1000  # rows, of which one is taken; times


def pairs_of(row):
    """All pairs of (factor, value) of a row, as frozen sets."""
    return {frozenset(pair) for pair in itertools.combinations(row.items(), 2)}


def is_refused(row, refused):
    """Whether a row holds all of a refused combination: frozen sets of (factor, value)."""
    return any(combination <= row.items() for combination in refused)


def allowed_pairs(factors, refused):
    """Every pair of values of two factors that is not refused, in their order."""
    return [
        frozenset({(one, a), (other, b)})
        for one, other in itertools.combinations(factors, 2)
        for a, b in itertools.product(factors[one], factors[other])
        if not is_refused({one: a, other: b}, refused)
    ]


def covering_array(factors, refused):
    """Rows, factor -> value, without any refused combination, that hold all allowed pairs.

    Greedy: of a few rows that begin with a pair that is still missing and take for every other
    factor, in some order, the value that brings most missing pairs, the one that brings most.
    """
    random, missing = Random(0), dict.fromkeys(allowed_pairs(factors, refused))
    rows = []
    for _ in range(_MOST):
        if not missing:
            return rows
        begun = random.choices(list(missing), k=_TRIED)
        tried = [_completed(dict(pair), factors, refused, missing, random) for pair in begun]
        tried = [row for row in tried if row is not None]  # the others can be tried again
        if not tried:
            continue
        row = max(tried, key=lambda row: len(pairs_of(row) & missing.keys()))
        for pair in pairs_of(row):
            missing.pop(pair, None)
        rows.append({factor: row[factor] for factor in factors})
    raise ValueError(f"no row holds {missing}")


def _completed(row, factors, refused, missing, random):
    """A row of a first pair; None if at last no value fits."""
    for factor in random.sample(list(factors), len(factors)):
        if factor in row:
            continue
        values = random.sample(factors[factor], len(factors[factor]))
        trials = [{**row, factor: value} for value in values]
        fitting = [trial for trial in trials if not is_refused(trial, refused)]
        if not fitting:
            return None
        row = max(fitting, key=lambda trial: len(pairs_of(trial) & missing.keys()))
    return row
