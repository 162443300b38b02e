"""Compiled runs held to Drake's."""

import numpy as np

from ffsm_drake import load_scenario, simulate_many

# share of a signal's largest value, or of one unit
SAME = {"position": 1e-10, "velocity": 1e-10, "error": 1e-10}  # m, rad, and per second
OTHERS = 1e-7


def check(scenarios):
    """Equal to Drake's runs but for rounding. Returns the records."""
    found = simulate_many(scenarios, engine="compiled")
    for record, other in zip(found, simulate_many(scenarios), strict=True):
        assert record.outcome == other.outcome
        completed = other.outcome.status == "completed"
        assert record.engine == ("compiled" if completed else "drake (the run fails or diverges)")
        assert record.dataset.attrs.keys() == other.dataset.attrs.keys()
        assert set(record.dataset.variables) == set(other.dataset.variables)
        for name, values in other.dataset.data_vars.items():
            if values.dtype == float:
                bound = SAME.get(name, OTHERS) * max(1.0, float(np.abs(values).max()))
                difference = np.abs(record.dataset[name].values - values.values).max()
                assert difference < bound, name
            else:
                assert record.dataset[name].equals(values), name
    return found


def of_seeds(name, given, count):
    """A scenario with so many seeds."""
    return [load_scenario(name, [f"random_seed={k}", *given]) for k in range(count)]
