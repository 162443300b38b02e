"""A covering array: few rows in which every allowed pair of values of two factors occurs."""

import itertools


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

    Greedy: a row begins with a pair that is still missing, and takes for every other factor the
    value that brings most missing pairs.
    """
    missing = dict.fromkeys(allowed_pairs(factors, refused))
    rows = []
    while missing:
        row = dict(next(iter(missing)))
        for factor in factors:
            if factor in row:
                continue
            trials = [{**row, factor: value} for value in factors[factor]]
            fitting = [trial for trial in trials if not is_refused(trial, refused)]
            row = max(fitting, key=lambda trial: len(pairs_of(trial) & missing.keys()))
        for pair in pairs_of(row):
            missing.pop(pair, None)
        rows.append({factor: row[factor] for factor in factors})
    return rows
