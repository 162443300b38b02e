"""The main job: stabilize the spacecraft that has just captured a piece of debris, and show how well it went.

python examples/postcapture.py                        the proposed controller, exact physics
python examples/postcapture.py --all-controllers      the paper's four, overlaid
python examples/postcapture.py --scenario paper       the paper's own simulation
python examples/postcapture.py --set disturbance.amplitude_scale=3 --set controllers.tde_aismc.k_s_max=90
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from ffsm_drake import FfsmError, RunRecord, Scenario, load_scenario, override_scenario, simulate
from ffsm_drake.block_diagram import closed_loop_dot, write_diagram
from ffsm_drake.errors import warnings_as_lines
from ffsm_drake.plotting import save_figures
from ffsm_drake.scenario import CONTROLLER_NAMES
from ffsm_drake.visualization import set_stage, start_meshcat, write_recording

EXIT_GOOD, EXIT_BAD_INPUT, EXIT_DIVERGED, EXIT_INTERRUPTED = 0, 2, 3, 130


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="postcapture", metavar="NAME_OR_FILE", help="default: %(default)s")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--controller", choices=CONTROLLER_NAMES, help="default: the one that the scenario names")
    which.add_argument("--all-controllers", action="store_true", help="run all four and overlay them")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a scenario value")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: out/SCENARIO")
    parser.add_argument("--meshcat", action="store_true", help="watch the run live in the browser, at real time")
    parser.add_argument("--no-recording", action="store_true", help="write no recording.html")
    parser.add_argument("--graphviz", action="store_true", help="print the block diagram as Graphviz text and exit")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the example; returns the exit code."""
    options = parse_arguments(arguments)
    try:
        with warnings_as_lines():
            return run(options)
    except FfsmError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT


def run(options: argparse.Namespace) -> int:
    chosen = [f"controller={options.controller}"] if options.controller else []
    scenario = load_scenario(options.scenario, [*options.set, *chosen])
    if options.graphviz:
        print(closed_loop_dot(scenario))
        return EXIT_GOOD
    directory = options.out or Path("out") / Path(options.scenario).stem
    names = CONTROLLER_NAMES if options.all_controllers else (scenario.controller,)

    records = []
    for name in names:
        record = run_one(override_scenario(scenario, [f"controller={name}"]), live=options.meshcat)
        # A run of several gets a folder each; their figures are overlaid one level up.
        record.save(directory / name if options.all_controllers else directory)
        records.append(record)
        if record.outcome.status == "interrupted":
            break
    print_table(records)

    written = save_figures(records, directory)
    if not options.no_recording:
        shown = records[-1]  # the proposed controller, when all have run
        write_recording(shown, directory / "recording.html")
        written.append(directory / "recording.html")
    remark = write_diagram(closed_loop_dot(scenario), directory / "block_diagram.dot")
    written.append(directory / "block_diagram.dot")
    kept = "one folder per controller" if options.all_controllers else "record.nc, metrics.json, manifest.json"
    print(f"\nWritten to {directory}: {kept}, {', '.join(path.name for path in written)}")
    if remark:
        print(remark)
    statuses = {record.outcome.status for record in records}
    if "interrupted" in statuses:
        return EXIT_INTERRUPTED
    return EXIT_DIVERGED if "diverged" in statuses else EXIT_GOOD


def run_one(scenario: Scenario, *, live: bool) -> RunRecord:
    meshcat = None
    if live:
        meshcat = start_meshcat()
        set_stage(meshcat, scenario)
        print(f"Open {meshcat.web_url()} and press Enter to start.", flush=True)
        sys.stdin.readline()
        scenario = override_scenario(scenario, ["simulator_config.target_realtime_rate=1"])
    progress = Progress(scenario.controller)
    record = simulate(scenario, meshcat=meshcat, progress=progress)
    progress.close(record)
    return record


class Progress:
    """One line that fills up on a terminal; a plain line every five simulated seconds elsewhere."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.terminal = sys.stdout.isatty()

    def __call__(self, time: float, duration: float) -> None:
        text = f"{self.name}: {time:4.0f} of {duration:g} s"
        if self.terminal:
            print(f"\r{text}", end="", flush=True)
        elif round(time) % 5 == 0:
            print(text, flush=True)

    def close(self, record: RunRecord) -> None:
        wall = record.wall_time["advance_to"]
        text = f"{record.outcome.message}; simulated in {wall:.2f} s, {record.realtime_factor:.0f} times real time"
        print(f"\r{text}" if self.terminal else text, flush=True)


def print_table(records: Sequence[RunRecord]) -> None:
    print(
        f"\n{'controller':<12}{'ITAE':>11}{'ISV':>11}{'peak error':>24}{'final error':>24}{'peak force':>12}"
        f"{'peak torque':>21}\n{'':<12}{'':>11}{'':>11}{'rad':>12}{'m':>12}{'rad':>12}{'m':>12}{'base, N':>12}"
        f"{'base, N m':>11}{'joints':>10}"
    )
    for record in records:
        m = record.metrics
        peak, final, effort = m["peak_error"], m["final_error"], m["peak_effort"]
        mark = "" if record.outcome.completed else f"  ({record.outcome.status} at {record.outcome.time:.2f} s)"
        print(
            f"{record.scenario.controller:<12}{m['itae']:>11.4g}{m['isv']:>11.5g}"
            f"{max(peak['base_rotation'], peak['joints']):>12.3g}{peak['base_position']:>12.3g}"
            f"{max(final['base_rotation'], final['joints']):>12.3g}{final['base_position']:>12.3g}"
            f"{effort['base_position']:>12.3g}{effort['base_rotation']:>11.3g}{effort['joints']:>10.3g}{mark}"
        )


if __name__ == "__main__":
    sys.exit(main())
