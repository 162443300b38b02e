"""Compiled runs held to Drake's."""

import numpy as np

from ffsm_drake import load_scenario, simulate_many

# share of a signal's largest value, or of one unit
SAME = {
    "position": 1e-10, "velocity": 1e-10, "error": 1e-10,  # m, rad, and per second
    "thruster_given": 1e-6,  # the solution of a linear program with a tolerance of 1e-7
}  # fmt: skip
OTHERS = 1e-7


def check(scenarios, *, called=False):
    """Equal to Drake's runs but for rounding; the law is traced, called, or (None) either. Returns
    the records.
    """
    found = simulate_many(scenarios, engine="compiled")
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert record.outcome == other.outcome
        completed = other.outcome.status not in ("diverged", "failed")
        engine = "compiled" if completed else "drake (the run fails or diverges)"
        name, how, _ = record.engine.partition(" (law called: ")
        assert name == engine
        assert called is None or bool(how) == (called and completed)
        assert set(record.dataset.variables) == set(other.dataset.variables)
        for name in other.dataset.coords:
            assert record.dataset[name].values.tolist() == other.dataset[name].values.tolist()
        for name, values in other.dataset.data_vars.items():
            if values.dtype == float:
                bound = SAME.get(name, OTHERS) * max(1.0, float(np.abs(values).max()))
                own = record.dataset[name].values
                assert np.array_equal(np.isnan(own), np.isnan(values)), name
                assert np.nanmax(np.abs(own - values.values)) < bound, name
            else:
                assert record.dataset[name].equals(values), name
        assert list(differing(record.metrics, other.metrics)) == []
        assert list(differing(record.grasp, other.grasp)) == []
    return found


def differing(found, expected, place=""):
    """Places in plain data where numbers differ by more than rounding, or anything else differs."""
    if isinstance(expected, dict | list):
        keys = expected if isinstance(expected, dict) else range(len(expected))
        if len(found) != len(expected):
            yield place
        for key in keys:
            yield from differing(found[key], expected[key], f"{place}.{key}")
    elif not (
        np.isclose(found, expected, rtol=1e-6, atol=1e-9, equal_nan=True)
        if isinstance(expected, float)
        else found == expected
    ):
        yield f"{place}: {found}, not {expected}"


def of_seeds(name, given, each):
    """A scenario with a seed for each of some further overrides."""
    return [load_scenario(name, [f"random_seed={k}", *given, *own]) for k, own in enumerate(each)]
