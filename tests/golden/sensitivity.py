"""How far rounding moves each number of the golden record: ``python tests/golden/sensitivity.py
[NAME...]`` measures it anew and writes ``sensitivity/NAME.json``.

Each run is repeated with initial state, payload, disturbance, noise and every measurement changed
in their last bits, in many draws, and on the instructions of several processors.
"""

import argparse
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import golden

sys.path.append(str(Path(__file__).parents[1]))
from children import finished

# Names of processors to OpenBLAS, whose products round differently, and instructions that NumPy
# leaves out; empty: what is here.
PROCESSORS: dict[str, Mapping[str, str]] = {
    "this": {},
    "Nehalem": {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3"},
    "Sandybridge": {"OPENBLAS_CORETYPE": "Sandybridge"},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": "X86_V4"},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
}
DRAWS = 3  # on each processor


def moves(name: str, seeds: Sequence[int]) -> Any:
    """How far the runs of a scenario are from the golden record, at most over some draws; a
    negative seed changes no bits.
    """
    expected = golden.read(golden.RUNS / f"{name}.json")["runs"]
    found = None
    for seed in seeds:
        drawn = None if seed < 0 else seed
        runs = golden.all_results(name, golden.run(name, seed=drawn), seed=drawn)
        found = golden.further_moves(
            found, golden.moves_between(with_all(expected), golden.plain(runs))
        )
    return found


def with_all(runs: Any) -> Any:
    """The runs of the golden record, each with all its variables."""
    first = next(iter(runs.values()))
    return {
        law: {**of_law, "samples": _spelled_out(of_law["samples"], first["samples"])}
        if "samples" in of_law
        else of_law
        for law, of_law in runs.items()
    }


def _spelled_out(samples: Any, first: Any) -> Any:
    return {
        name: first[name] if values == "as above" else values for name, values in samples.items()
    }


def measured(name: str, draws: int) -> Any:
    """The moves of a scenario over all processors, in processes of their own."""
    found = None
    for number, (processor, environment) in enumerate(PROCESSORS.items()):
        seeds = [-1, *range(number * draws, (number + 1) * draws)]
        command = [sys.executable, __file__, "--seeds", *map(str, seeds), "--", name]
        done = finished(command, env={**os.environ, **environment}, check=True, longest=1800)
        found = golden.further_moves(found, json.loads(done.stdout))
        print(f"{name}: {processor}", file=sys.stderr, flush=True)
    return found


def rounded_up(tree: Any) -> Any:
    """Numbers with two digits, none smaller than it was."""
    if isinstance(tree, dict):
        return {key: rounded_up(value) for key, value in tree.items()}
    if isinstance(tree, list):
        return [rounded_up(value) for value in tree]
    if isinstance(tree, float) and tree:
        unit = 10.0 ** (math.floor(math.log10(tree)) - 1)
        return float(f"{math.ceil(tree / unit) * unit:.1e}")
    return tree


def growing(rows: Any) -> Any:
    """Moves of rows in time, none smaller than an earlier one."""
    if isinstance(rows, dict):
        return {key: growing(value) for key, value in rows.items()}
    if isinstance(rows, list):
        found: list[Any] = []
        for row in rows:
            found.append(golden.further_moves(found[-1] if found else None, row))
        return found
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", default=golden.names())
    parser.add_argument("--draws", type=int, default=DRAWS, help="on each processor")
    parser.add_argument("--seeds", type=int, nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.seeds:
        print(json.dumps(moves(given.names[0], given.seeds)))
        return
    for name in given.names:
        path: Path = golden.sensitivity_of(name)
        path.parent.mkdir(exist_ok=True)
        found = {"runs": rounded_up(growing(measured(name, given.draws)))}
        path.write_text(golden.text(found) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
