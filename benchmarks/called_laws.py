"""What a control sample costs whose law is called by the compiled run, because it cannot be traced.

    python benchmarks/called_laws.py [--repeats 5] [--duration 5]

Processor time of a sample and run in microseconds, medians of the repeats, which take turns. Runs
of ``postcapture`` differ in their seed. ``limited`` keeps the joints' limits, so that programs are
solved. ``branches`` is PD+ control with a branch on a value for each coordinate.
"""

import argparse
import dataclasses
import statistics
import sys
import time
import warnings

import numpy as np

from ffsm_drake import load_scenario, simulate_many
from ffsm_drake.mission import Mission
from ffsm_drake.runs.batches import run_many
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.controllers.law import Sample, State
from ffsm_drake.systems.controllers.laws.pd_plus import PdPlus

CASES = {
    "pd_plus": ("pd_plus", ()),
    "branches": ("called_laws:Branches", ()),
    "mpc": ("mpc", ()),
    "mpc, limited": ("mpc", ("actuation.limit={joints: 0.05}",)),
    "nmpc": ("nmpc", ()),
}
WAYS = {"Drake, one": ("drake", 1, 1), "Drake, 16": ("drake", 16, 16),
        "compiled, one": ("compiled", 1, 1), "compiled, 16": ("compiled", 16, 16)}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Branches(PdPlus):
    """PD+ control that a trace cannot follow."""

    def step(self, sample: Sample, state: State) -> tuple[np.ndarray, State]:
        force, memory = super().step(sample, state)
        for i in range(force.size):
            if abs(sample.e[i]) > 1.0:
                force[i] *= 0.5
        return force, memory


def cost(scenarios: list[Scenario], engine: str, batch: int) -> float:
    """Processor time of a sample and run, microseconds."""
    samples = sum(each.num_control_periods + 1 for each in scenarios)
    start = time.process_time()
    for _ in run_many([*map(Mission, scenarios)], engine=engine, batch=batch):
        pass
    return 1e6 * (time.process_time() - start) / samples


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--duration", type=float, default=5.0, help="of the runs, s")
    given = parser.parse_args()
    sys.modules["called_laws"] = sys.modules[__name__]
    warnings.simplefilter("ignore")
    print(f"| law | {' | '.join(WAYS)} |\n|---|{'---|' * len(WAYS)}")
    for name, (law, more) in CASES.items():
        words = [f"controller={law}", f"duration={given.duration}", *more]
        scenarios = [load_scenario("postcapture", [*words, f"random_seed={k}"]) for k in range(16)]
        for count in (1, 16):  # code, and its comparison with Drake
            simulate_many(scenarios[:count], engine="compiled")
        found: dict[str, list[float]] = {way: [] for way in WAYS}
        for _ in range(given.repeats):
            for way, (engine, count, batch) in WAYS.items():
                found[way].append(cost(scenarios[:count], engine, batch))
        medians = " | ".join(f"{statistics.median(each):.0f}" for each in found.values())
        print(f"| {name} | {medians} |")


if __name__ == "__main__":
    main()
