"""Which shipped scenarios and laws are compiled, and how far their runs are from Drake's.

    python benchmarks/compiled_coverage.py [SCENARIO ...] [--laws LAW ...] [--duration 2]

Prints two tables in Markdown. The first has, for each scenario, the largest difference of position
and velocity over all compiled laws, and of any variable of the record, as a share of its largest
value. The second has the laws, with the line for which a law is called or kept on Drake.
"""

import argparse
import warnings
from collections import defaultdict

import numpy as np

from ffsm_drake import RunRecord, Scenario, load_scenario, simulate
from ffsm_drake.common.errors import FfsmError, one_line
from ffsm_drake.runs.engine import NotCovered
from ffsm_drake.scenario import shipped_scenarios
from ffsm_drake.systems.registry import shipped_names

_LEAST = 1e-3  # scale of a variable, so that zero has one
_STATE = ("position", "velocity")


def differences(found: RunRecord, expected: RunRecord) -> dict[str, float]:
    """The largest difference of each variable, as a share of its largest value."""
    made = {}
    for name, values in expected.dataset.data_vars.items():
        if values.dtype == float and values.size:
            scale = max(float(np.abs(values).max()), _LEAST)
            made[str(name)] = float(np.abs(found.dataset[name] - values).max()) / scale
    return made


def compared(scenario: Scenario) -> tuple[str, dict[str, float]]:
    """How a run ends, or the reason why it is not compiled, and ``differences``."""
    try:
        found = simulate(scenario, engine="compiled", check_stability=False)
    except NotCovered as error:
        return error.what, {}
    except FfsmError as error:
        return f"fails: {one_line(error)}", {}
    if not found.engine.startswith("compiled"):
        return "diverges", {}
    return found.engine, differences(found, simulate(scenario, check_stability=False))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=list(shipped_scenarios()))
    parser.add_argument("--laws", nargs="*", default=list(shipped_names("controller")))
    parser.add_argument("--duration", type=float, default=2.0, help="of the runs, s")
    given = parser.parse_args()
    laws, rows = given.laws, list[str]()
    of_law = defaultdict[str, list[str]](list)
    for name in given.names:
        ends, worst = dict[str, str](), defaultdict[str, float](float)
        for law in laws:
            overrides = [f"controller={law}", f"duration={given.duration}"]
            try:
                scenario = load_scenario(name, overrides)
            except FfsmError:  # a capture takes longer
                scenario = load_scenario(name, overrides[:1])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                ends[law], found = compared(scenario)
            for variable, value in found.items():
                worst[variable] = max(worst[variable], value)
        compiled = [law for law in laws if ends[law].startswith("compiled")]
        if not compiled:
            (reason,) = set(ends.values())
            rows.append(f"| `{name}` | not covered: {reason} | | |")
            continue
        state, variable = max(worst[each] for each in _STATE), max(worst, key=worst.__getitem__)
        rows.append(f"| `{name}` | {len(compiled)} laws | {state:.1e} | {worst[variable]:.1e} "
                    f"(`{variable}`) |")  # fmt: skip
        for law in laws:
            of_law[law].append(ends[law])
    print("| scenario | compiled | position, velocity | any variable |\n|---|---|---|---|")
    print("\n".join(rows))
    print("\n| law | compiled in | remarks |\n|---|---|---|")
    for law, ends_of in of_law.items():
        others = ", ".join(sorted({end for end in ends_of if end != "compiled"}))
        count = sum(end.startswith("compiled") for end in ends_of)
        print(f"| `{law}` | {count} of {len(ends_of)} scenarios | {others} |")


if __name__ == "__main__":
    main()
