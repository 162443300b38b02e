"""The main job: stabilize the spacecraft that has just captured a piece of debris, and show how
well it went.

python examples/postcapture.py
python examples/postcapture.py --scenario flight_sensors --set controller=aismc --out out/mine

The command 'ffsm run' does the same with more choices; this script is the Python side of it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import ffsm_drake
from ffsm_drake.common.errors import warnings_as_lines
from ffsm_drake.plugins.diagrams.block_diagram import closed_loop_dot, write_diagram
from ffsm_drake.show.tables import results_table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the example; returns the exit code: 0 good, 2 bad input, 3 diverged, 130 interrupted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenario", default="postcapture", help="name or file")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: out/SCENARIO")
    options = parser.parse_args(arguments)
    directory = options.out or Path("out") / Path(options.scenario).stem
    try:
        with warnings_as_lines():
            return run(options.scenario, options.set, directory)
    except ffsm_drake.FfsmError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def run(name: str, overrides: Sequence[str], directory: Path) -> int:
    scenario = ffsm_drake.load_scenario(name, overrides)
    record = ffsm_drake.simulate(scenario, progress=show_progress)
    record.save(directory)
    print(f"{record.outcome.message}; {record.realtime_factor:.0f} times real time\n")
    print(results_table([record]))

    written = ffsm_drake.write_outputs([record], directory)
    write_diagram(closed_loop_dot(scenario), directory / "block_diagram.dot")
    print(f"\nWritten to {directory}: record.nc, metrics.json, manifest.json, block_diagram.dot,")
    print(", ".join(path.name for path in written))
    print(f"Open {directory / 'report.html'}.")
    return {"completed": 0, "diverged": 3, "interrupted": 130}[record.outcome.status]


def show_progress(time: float, duration: float) -> None:
    if round(time) % 5 == 0:
        print(f"{time:4.0f} of {duration:g} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
