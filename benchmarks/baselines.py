"""Every law on spacecraft built at random: what is said of it before, and how the run ends.

    python benchmarks/baselines.py --missions 3 --seed 51 -c mpc -c slotine_li

The missions are those of ``built_missions``, each law with its default gains in place of the law
that was drawn. A row says what was said (by the linear loop and a rehearsed run), the linear loop
alone, and how the run ends. A miss is a run that diverges, grows or leaves its limits without a
warning; a false alarm is a warning of a run that settles.
"""

import argparse
import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any

import verdicts

from ffsm_drake.common.time_limit import TimeLimit, time_limit
from ffsm_drake.systems.controllers import PAPER_LAWS, complete_gains

BASELINES = (
    "super_twisting", "terminal_sliding_mode", "fixed_time", "prescribed_performance",
    "fixed_time_observer", "slotine_li", "coordinated", "mpc", "nmpc",
)  # fmt: skip
LAWS = (*PAPER_LAWS, "pd_plus", "computed_torque", *BASELINES)
SEED = 51


def results(
    laws: tuple[str, ...], *, missions: int, seconds: float, seed: int = SEED
) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Number of the mission, law, and result as ``verdicts.make_result`` gives it."""
    for number in range(missions):
        mission, drawn, _ = verdicts.drawn("built", number, seed)
        for law in laws:
            scenario = dataclasses.replace(drawn, controller=law, controllers={})
            scenario = complete_gains(scenario)
            predicted = verdicts.Predicted(unknown="not asked")
            try:
                with time_limit(seconds), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    predicted = verdicts.predict(scenario)
                    end = verdicts.fly(scenario)
            except TimeLimit as error:
                end = verdicts.End(kind="interrupted", time=0.0, message=str(error))
            except Exception as error:
                end = verdicts.End(
                    kind="failed", time=0.0, message=f"{type(error).__name__}: {error}"
                )
            found = dataclasses.asdict(mission)
            yield number, law, verdicts.make_result(found, predicted=predicted, end=end)


def main() -> None:
    """Print a row for each law and mission, then the misses."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-c", "--controller", action="append", choices=LAWS)
    parser.add_argument("--missions", type=int, default=3)
    parser.add_argument("--seed", type=int, default=SEED, help="another seed draws others")
    parser.add_argument("--seconds", type=float, default=300.0, help="longest time of a mission")
    given = parser.parse_args()
    misses, alarms, beyond, cut = list[str](), list[str](), list[str](), list[str]()
    laws = tuple(given.controller or LAWS)
    for number, law, result in results(
        laws, missions=given.missions, seconds=given.seconds, seed=given.seed
    ):
        end = result["end"]
        row = f"{number:3d}  {law:22} {result['verdict']['said']:10} "
        row += f"{result['verdict']['linear']:12} {end['kind']:12}"
        print(f"{row} {end['time']:6.2f} s  {end['message'][:60]}", flush=True)
        if end["kind"] == "diverged" and result["verdict"]["linear"] == "stable":
            beyond.append(row)
        if end["kind"] == "interrupted":
            cut.append(row)
        if verdicts.is_miss(result):
            misses.append(row)
        if verdicts.is_false_alarm(result):
            alarms.append(f"{row} {'; '.join(result['verdict']['warnings'])}")
    print(f"\nbad ends of which nothing was said: {len(misses)}", *misses, sep="\n")
    print(f"diverged though the linear loop is stable: {len(beyond)}", *beyond, sep="\n")
    print(f"warnings of runs that settled: {len(alarms)}", *alarms, sep="\n")
    print(f"cut by the time limit (--seconds): {len(cut)}", *cut, sep="\n")


if __name__ == "__main__":
    main()
