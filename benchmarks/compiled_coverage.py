"""Which shipped scenarios and laws are compiled, and how far their runs are from Drake's.

    python benchmarks/compiled_coverage.py [SCENARIO ...] [--laws LAW ...] [--duration 2]
    python benchmarks/compiled_coverage.py [SCENARIO ...] --rounding [--laws LAW ...]

Prints two tables in Markdown. The first has, for each scenario, the largest difference of position
and velocity over all compiled laws, and of any variable of the record, as a share of its largest
value. The second has the laws, with the line for which a law is called or kept on Drake.

With --rounding each scenario runs to its end, with its own law or with LAW. Its differences are
divided by those of Drake's own runs with another last bit of the initial posture. Each driven entry
is changed by 2^-52 times its size or 1, whichever is larger, with random signs in four runs.
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
_LAST_BIT = 2.0**-52
_NUDGES = 4  # runs of Drake with another last bit


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


def nudged(scenario: Scenario, random: np.random.Generator) -> Scenario:
    """A scenario with another last bit in each driven entry of the initial posture."""

    def changed(value: float) -> float:
        return value + random.choice((-_LAST_BIT, _LAST_BIT)) * max(1.0, abs(value))

    posture, undriven = scenario.initial_posture, scenario.undriven
    given: dict[str, object] = {
        "joints": {name: changed(value) for name, value in posture.joints.items()}
    }
    if "base_position" not in undriven:
        given["base_position"] = [changed(value) for value in posture.base_position]
    if "base_rotation" not in undriven:
        given["base_rpy"] = [changed(value) for value in posture.base_rpy]
    return scenario.replace(initial_posture=given)


def row_of_rounding(scenario: Scenario, name: str) -> str:
    """A row of the table of --rounding."""
    expected = simulate(scenario, check_stability=False)
    found = simulate(scenario, engine="compiled", check_stability=False)
    apart, random = differences(found, expected), np.random.default_rng(0)
    own = defaultdict[str, float](float)
    for _ in range(_NUDGES):
        again = simulate(nudged(scenario, random), check_stability=False)
        for variable, value in differences(again, expected).items():
            own[variable] = max(own[variable], value)
    state, of_drake = (max(each[part] for part in _STATE) for each in (apart, own))
    ratios = {variable: value / own[variable] for variable, value in apart.items() if own[variable]}
    worst = max(ratios, key=ratios.__getitem__)
    return (
        f"| `{name}`, {scenario.controller} | {state:.1e} | {of_drake:.1e} | "
        f"{state / of_drake:.2g} | {ratios[worst]:.2g} (`{worst}`) |"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=list(shipped_scenarios()))
    parser.add_argument("--laws", nargs="*", default=None)
    parser.add_argument("--duration", type=float, default=2.0, help="of the runs, s")
    parser.add_argument("--rounding", action="store_true")
    given = parser.parse_args()
    if given.rounding:
        print("| scenario, law | compiled | Drake, last bit changed | ratio | any variable |")
        print("|---|---|---|---|---|")
        for name in given.names:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for law in given.laws or [load_scenario(name).controller]:
                    scenario = load_scenario(name, [f"controller={law}"])
                    print(row_of_rounding(scenario, name), flush=True)
        return
    laws, rows = given.laws or shipped_names("controller"), list[str]()
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
