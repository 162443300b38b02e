"""What the first result of a fresh interpreter costs, as ratios to one that imports a bare plant.

    python benchmarks/startup.py [--repeats 9] [--against FOLDER]

Processor time of whole processes, which take turns, because a machine's speed changes from minute
to minute: minima of the repeats, and medians in brackets. ``--against`` measures the package in
another folder, such as an earlier checkout, beside this one, and prints the ratios to it. All
modules are compiled beforehand, as those of an installed package are.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

HERE = Path(__file__).parents[1]
PLANT = "import pydrake.multibody.plant"
FIRST = "import ffsm_drake as f; scenario = f.load_scenario('postcapture')"
PROGRAMS = {
    "ffsm --help": ["-m", "ffsm_drake", "--help"],
    "ffsm validate postcapture": ["-m", "ffsm_drake", "validate", "postcapture"],
    "ffsm run --no-report": ["-m", "ffsm_drake", "run", "--no-report"],
    "ffsm run": ["-m", "ffsm_drake", "run"],
    "first record": ["-c", f"{FIRST}; f.simulate(scenario).metrics"],
    "first labelled dataset": ["-c", f"{FIRST}; f.simulate(scenario).dataset"],
    "first rollout": ["-c", f"{FIRST}; f.Rollout(scenario).run().metrics"],
}


def processor_time(
    arguments: Sequence[str], package: Path, compiled: str, *, codes: Sequence[int] = (0,)
) -> float:
    """Of a fresh interpreter that ends with one of some exit codes, s; ``compiled`` is the folder
    for compiled modules and for what the program writes.
    """
    Path(compiled).mkdir(parents=True, exist_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    # of the package itself, not of an installed one
    environment = os.environ | {"PYTHONPATH": str(package), "PYTHONPYCACHEPREFIX": compiled}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, *arguments]
    done = subprocess.run(command, capture_output=True, env=environment, cwd=compiled)
    if done.returncode not in codes:
        done.check_returncode()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--repeats", type=int, default=9, help="of each program (default: 9)")
    parser.add_argument("--against", type=Path, help="folder of another ffsm_drake to compare with")
    arguments = parser.parse_args(argv)
    packages = [HERE, *([] if arguments.against is None else [arguments.against.resolve()])]
    contestants = {(PLANT, HERE): ["-c", PLANT]} | {
        (name, package): program for name, program in PROGRAMS.items() for package in packages
    }
    times: dict[tuple[str, Path], list[float]] = {key: [] for key in contestants}
    with tempfile.TemporaryDirectory() as compiled:
        for turn in range(arguments.repeats + 1):  # the first warms up and compiles
            for key, program in contestants.items():
                seconds = processor_time(program, key[1], compiled)
                if turn > 0:
                    times[key].append(seconds)

    def ratio(one: tuple[str, Path], other: tuple[str, Path]) -> str:
        a, b = times[one], times[other]
        return f"{min(a) / min(b):.2f} ({statistics.median(a) / statistics.median(b):.2f})"

    plant = (PLANT, HERE)
    print(f"{PLANT}: {min(times[plant]):.2f} s of processor time")
    for name in PROGRAMS:
        found = f"{min(times[name, HERE]):.2f} s, {ratio((name, HERE), plant)} of it"
        against = "".join(
            f"; {ratio((name, HERE), (name, package))} of what it takes with --against"
            for package in packages[1:]
        )
        print(f"{name}: {found}{against}")


if __name__ == "__main__":
    main()
