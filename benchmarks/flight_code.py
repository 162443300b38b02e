"""Exported laws: operations, code, stack, time of a sample, and what single precision loses.

    python benchmarks/flight_code.py [LAW ...] [--scenario postcapture] [--set KEY=VALUE ...]

Each law is compiled with gcc -O2 and replays the run of its scenario. The time is processor time of
law_step for the samples of the run, many times over. The loss is the largest difference of a force
in the replay, as a share of the largest force of its kind. The rows are those of a Markdown table.
"""

import argparse
import re
import subprocess
import tempfile
from pathlib import Path

from ffsm_drake import FfsmError, Scenario, export, load_scenario
from ffsm_drake.systems.controllers import controller_names

_TIMES = 20  # that the run is replayed
_TIMED = """#include <stdio.h>
#include <time.h>
#include "recording.h"
int main(void)
{
  const recording run = read_recording("replay.txt");
  law_state state;
  law_out out;
  double sum = 0.0;
  const clock_t begin = clock();
  for (int again = 0; again < TIMES; ++again) {
    law_start(&state);
    for (size_t k = 0; k < run.count; ++k) {
      (void)law_step(&run.samples[k].in, &LAW_GAINS, &state, &out);
      sum += (double)out.force[0];
    }
  }
  printf("%g %g", (double)(clock() - begin) / CLOCKS_PER_SEC / (TIMES * (double)run.count), sum);
  return 0;
}
"""


def run(folder: Path, *line: str) -> str:
    """What a command prints in a folder."""
    done = subprocess.run(line, cwd=folder, capture_output=True, text=True, timeout=600, check=True)
    return done.stdout


def of_double(scenario: Scenario, folder: Path) -> tuple[str, str, str, str]:
    """Operations; bytes of code and constants; of the stack of the largest function; microseconds
    of a sample.
    """
    lines = export(folder / "law.c", scenario, kit=True)
    operations = lines[1].partition(" operations")[0]
    (folder / "timed.c").write_text(_TIMED)
    flags = ("gcc", "-std=c99", "-O2", "-ffp-contract=off", f"-DTIMES={_TIMES}")
    run(folder, *flags, "-fstack-usage", "-c", "law.c")
    code = run(folder, "size", "law.o").splitlines()[1].split()[0]
    stack = max(int(row.split("\t")[1]) for row in (folder / "law.su").read_text().splitlines())
    run(folder, *flags, "timed.c", "recording.c", "law.o", "-lm", "-o", "timed")
    seconds = min(float(run(folder, "./timed").split()[0]) for _ in range(3))
    return operations, code, str(stack), f"{1e6 * seconds:.2f}"


def of_single(scenario: Scenario, folder: Path) -> str:
    """The loss of single precision."""
    lines = export(folder / "law.c", scenario, float32=True)
    (found,) = re.findall(r"by up to (.*) of the largest", "\n".join(lines))
    return str(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("laws", nargs="*", metavar="LAW")
    parser.add_argument("--scenario", default="postcapture")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    print("| law | operations | code, bytes | stack, bytes | µs a sample | loss of float32 |")
    print("|---|---|---|---|---|---|")
    for law in given.laws or controller_names():
        scenario = load_scenario(given.scenario, [*given.set, f"controller={law}"])
        with tempfile.TemporaryDirectory() as name:
            try:
                row = [*of_double(scenario, Path(name)), of_single(scenario, Path(name))]
            except FfsmError as error:
                row = [str(error)]
        print("|", " | ".join([f"`{law}`", *row]), "|", flush=True)


if __name__ == "__main__":
    main()
