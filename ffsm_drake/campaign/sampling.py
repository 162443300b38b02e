"""Points of the unit cube and seeds of the cases, both determined by the campaign's seed."""

import numpy as np
from scipy.stats import qmc

SAMPLINGS = ("latin_hypercube", "sobol", "random")
# Keeps quantiles of unbounded distributions finite: SciPy's points may touch zero.
_INSIDE = 2.0**-40


def unit_points(sampling: str, *, cases: int, dimensions: int, seed: int) -> np.ndarray:
    """Points (cases, dimensions) in the open unit cube."""
    if dimensions == 0:
        return np.empty((cases, 0))
    generator = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    if sampling == "random":
        points = generator.random((cases, dimensions))
    else:
        kind = qmc.LatinHypercube if sampling == "latin_hypercube" else qmc.Sobol
        points = kind(dimensions, seed=generator).random(cases)
    return np.clip(points, _INSIDE, 1.0 - _INSIDE)


def case_seed(seed: int, case: int) -> int:
    """The scenario's random_seed of one case: 31 bits of NumPy's SeedSequence(seed, spawn_key=(1, case))."""
    return int(np.random.SeedSequence(seed, spawn_key=(1, case)).generate_state(1)[0]) >> 1
