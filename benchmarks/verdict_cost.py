"""What the verdict on a mission costs, over a run of the same scenario.

    python benchmarks/verdict_cost.py [SCENARIO ...] [--repeats 3] [--commands] [--maps]

Processor time, minima of repeats that take turns, because a machine's speed changes from minute to
minute. In one process: ``validate`` (the verdict with its rehearsal) and ``stability`` (with
margins) over a run of the mission until its record is made, all without reading files; beside them
how many sample maps were made, by finite differences, and how many loops were built for them.
``--commands`` also takes whole commands as a user starts them: ``ffsm validate`` and ``ffsm
stability`` over ``ffsm run`` with its files. ``--maps`` compares the linear loops of ``ffsm
stability`` with exact derivatives to those by finite differences, their code already compiled.
"""

import argparse
import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

from startup import HERE, processor_time

from ffsm_drake import Scenario, load_scenario
from ffsm_drake.cli.common import EXIT_UNSTABLE
from ffsm_drake.plugins.design.stability import linearization
from ffsm_drake.plugins.design.stability.adaptation import expected_gains
from ffsm_drake.plugins.design.stability.linear_loop import LinearLoop
from ffsm_drake.plugins.design.stability.linearization import Linearizer
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import shipped_scenarios


class Counted:
    """Counts what is linearised, and for how many loops, within a ``with`` block."""

    def __enter__(self) -> "Counted":
        self._at, self._begin = Linearizer.at, Linearizer.__init__
        self._loops, self.built = list[LinearLoop](), 0

        def at(linearizer: Linearizer, *arguments: Any, **named: Any) -> LinearLoop:
            self._loops.append(self._at(linearizer, *arguments, **named))
            return self._loops[-1]

        def begin(linearizer: Linearizer, *arguments: Any, **named: Any) -> None:
            self.built += 1
            self._begin(linearizer, *arguments, **named)

        Linearizer.at, Linearizer.__init__ = at, begin  # type: ignore[method-assign]
        return self

    def __exit__(self, *exception: object) -> None:
        Linearizer.at, Linearizer.__init__ = self._at, self._begin  # type: ignore[method-assign]

    @property
    def maps(self) -> int:
        """Sample maps that were made; of a common period each kind of sample once."""
        return len({id(each) for loop in self._loops for each in loop.samples})


def linear_part(scenario: Scenario) -> bool:
    """Linearise as ``stability`` does; returns whether the maps are exact."""
    with Linearizer(scenario) as linearizer:
        linearizer.along(held=expected_gains(linearizer))
        linearizer.along()
        return linearizer.is_exact


def maps(scenario: Scenario, repeats: int) -> str:
    """The ratio of exact maps to finite differences."""
    if not linear_part(scenario):
        return "not exact"
    seconds: dict[bool, list[float]] = {True: [], False: []}
    find = linearization.traced_sample
    try:
        for _ in range(repeats):
            for is_exact, times in seconds.items():
                linearization.traced_sample = find if is_exact else lambda *_: None
                start = time.process_time()
                linear_part(scenario)
                times.append(time.process_time() - start)
    finally:
        linearization.traced_sample = find
    exact, differences = min(seconds[True]), min(seconds[False])
    return f"exact {exact * 1e3:.1f} ms, {exact / differences:.3f} of finite differences"


def in_process(scenario: Scenario, repeats: int) -> str:
    """Ratios of the verdicts to a run, and what they count."""
    parts: dict[str, Callable[[], object]] = {
        "run": lambda: simulate(scenario, check_stability=False),
        "validate": lambda: verdict(scenario),
        "stability": lambda: verdict(scenario, margins=True),
    }
    seconds, counts = {name: list[float]() for name in parts}, dict[str, str]()
    for _ in range(repeats):
        for name, part in parts.items():
            with Counted() as counted:
                start = time.process_time()
                part()
                seconds[name].append(time.process_time() - start)
            counts[name] = f"{counted.maps} maps, {counted.built} loops"
    least = {name: min(values) for name, values in seconds.items()}
    told = [
        f"{name} {least[name] / least['run']:.2f} ({counts[name]})"
        for name in ("validate", "stability")
    ]
    return f"run {least['run']:.2f} s; {'; '.join(told)}"


def commands(name: str, repeats: int) -> str:
    """Ratios of whole commands."""
    seconds = dict[str, list[float]]()
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repeats):
            for words in (["run", "--out", folder], ["validate"], ["stability"]):
                command = ["-m", "ffsm_drake", words[0], name, *words[1:]]
                took = processor_time(command, HERE, f"{folder}/compiled", codes=(0, EXIT_UNSTABLE))
                seconds.setdefault(words[0], []).append(took)
    least = {name: min(values) for name, values in seconds.items()}
    told = [f"{name} {least[name] / least['run']:.2f}" for name in ("validate", "stability")]
    return f"commands: run {least['run']:.2f} s; {'; '.join(told)}"


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("scenarios", nargs="*", help="default: all that are shipped")
    parser.add_argument("--repeats", type=int, default=3, help="of each (default: 3)")
    parser.add_argument("--commands", action="store_true", help="whole commands, too")
    parser.add_argument("--maps", action="store_true", help="exact maps over differences, alone")
    options = parser.parse_args(argv)
    warnings.simplefilter("ignore")
    for name in options.scenarios or shipped_scenarios():
        if options.maps:
            print(f"{name}: {maps(load_scenario(name), options.repeats)}", flush=True)
            continue
        print(f"{name}: {in_process(load_scenario(name), options.repeats)}", flush=True)
        if options.commands:
            print(f"{name}: {commands(name, options.repeats)}", flush=True)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
