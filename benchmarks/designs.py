"""What ``ffsm design`` makes of a dozen pairs of scenario and law: is it nowhere worse than it was?

    python benchmarks/designs.py [--time 60] [--seeds 3] [--only WORD] [--out out/designs.json]

Each pair is designed as the command does it; the given and the chosen gains then run with the same
seeds. The table shows, chosen over given, the largest ratio of a group's rms error (after the first
5 s, from the grasp on) in the prediction and over the runs, that of the effort, and the least
ratio of a margin; beside them the processor time of the design, s. A pair is dominated where an
error, the effort or a margin is worse by more than 2 %.
"""

import argparse
import dataclasses
import json
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake import Scenario, load_scenario
from ffsm_drake.common.files import write_text
from ffsm_drake.plugins.design.gains import Design, design
from ffsm_drake.plugins.design.verdict import verdict
from ffsm_drake.runs.phases import make_rollout

PAIRS = (
    ("postcapture", "tdc"),
    ("postcapture", "aismc"),
    ("paper", "asmc"),
    ("flight_sensors", "tde_aismc"),
    ("flight_sensors", "computed_torque"),
    ("flexible_panels", "tdc"),
    ("thrusters_and_wheels", "tdc"),
    ("thrusters_and_wheels", "tde_aismc"),
    ("thrusters_only", "asmc"),
    ("tumbling_capture", "tde_aismc"),
    ("free_floating", "tdc"),
    ("slow_navigation", "tdc"),
)
TOLERANCE = 1.02
_SETTLED_AFTER = 5.0  # s, from the grasp on


def figures(scenario: Scenario, seed: int) -> dict[str, float]:
    """The rms error of every driven group (rad or m) and the effort (ISV) of a run; infinite where
    it does not complete.
    """
    rollout = make_rollout(dataclasses.replace(scenario, random_seed=seed))
    try:
        log = rollout.run()
    finally:
        rollout.release()
    counted = log.time > scenario.grasp_time
    late = log.time > scenario.grasp_time + _SETTLED_AFTER
    groups = log.coordinates.driven_groups
    if not log.outcome.completed:
        return dict.fromkeys([*groups, "effort"], np.inf)
    found = {name: rms(log.error[late, part]) for name, part in groups.items()}
    force = log.generalized_force[counted]
    return {**found, "effort": float((force**2).sum() * scenario.sample_time)}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def compare(name: str, law: str, *, seconds: float, seeds: int) -> dict[str, Any]:
    """The row of one pair."""

    def predict_mission(candidate: Scenario) -> str:
        found = verdict(candidate)
        return found.warnings[0] if found.is_alarm else ""

    begin = time.process_time()
    scenario = load_scenario(name, [f"controller={law}"])
    found = design(scenario, time_limit=seconds, predict_mission=predict_mission)
    row: dict[str, Any] = {
        "pair": f"{name}, {law}",
        "seconds": time.process_time() - begin,
        "cut": found.ended_by,
        "kept": found.kept,
        "given": found.requirement.violated(found.given),
        "predicted": predicted(found),
        "effort": found.chosen.prediction.isv / found.given.prediction.isv,
        "margin": min((after / was for was, after in found.margins.values() if was < np.inf),
                      default=np.nan),
        "runs": [],
    }  # fmt: skip
    for seed in range(0 if found.kept else seeds):
        before, after = (figures(each.scenario, seed) for each in (found.given, found.chosen))
        row["runs"].append({key: after[key] / was for key, was in before.items()})
    return row


def predicted(found: Design) -> float:
    """The largest ratio of a group's predicted error."""
    before = found.given.prediction.by_group()
    return max(after / before[name] for name, after in found.chosen.prediction.by_group().items())


def table_row(row: dict[str, Any]) -> str:
    """One line of the table."""
    changed = "was no good" if row["given"] else "changed"
    outcome = "kept" if row["kept"] else changed
    errors = max((v for run in row["runs"] for k, v in run.items() if k != "effort"), default=1.0)
    effort = max((run["effort"] for run in row["runs"]), default=1.0)
    worst = max(row["predicted"], errors, row["effort"], effort, 1.0 / row["margin"], key=_number)
    dominated = "dominated" if worst > TOLERANCE and outcome == "changed" else ""
    cut = "cut" if row["cut"] else "ended"
    return (
        f"{row['pair']:<32} {outcome:<12} {cut:<6} {row['seconds']:5.0f} "
        f"{row['predicted']:10.3f} {errors:10.3f} {row['effort']:10.3f} {effort:10.3f} "
        f"{row['margin']:8.3f}  {dominated}"
    )


def _number(value: float) -> float:
    return 0.0 if np.isnan(value) else value


def main() -> None:
    parser = argparse.ArgumentParser(description="Designs against what they were given.")
    parser.add_argument(
        "--time", type=float, default=60.0, help="limit of each design, s of wall time"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--only", default="", help="pairs that contain this")
    parser.add_argument("--out", type=Path, default=Path("out/designs.json"))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    head = ("pair", "", "search", "s", "predicted", "runs", "effort", "of runs", "margin")
    print("{:<32} {:<12} {:<6} {:>5} {:>10} {:>10} {:>10} {:>10} {:>8}".format(*head))
    rows = []
    for name, law in PAIRS:
        if options.only in f"{name}, {law}":
            rows.append(compare(name, law, seconds=options.time, seeds=options.seeds))
            print(table_row(rows[-1]), flush=True)
            write_text(options.out, json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
