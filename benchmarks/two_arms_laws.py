"""Every law with two hands on the target and errors of calibration: what acts at the second hand.

``python benchmarks/two_arms_laws.py`` prints the table of ``docs/validation/missions.md``. Each
joint of the right arm reads 1 mrad too much, and its hand holds 1 mm beside its place. The hand
bears no share of the load (``chain.force.share: 0``, no preload), so that its whole wrench is
internal.
"""

import argparse

import numpy as np
from scipy import stats
from two_arms import CALIBRATION

from ffsm_drake import RunRecord, load_scenario, simulate_many
from ffsm_drake.systems.controllers import controller_names

FORCE, MOMENT, GAP = 1.0, 2.0, 1e-9  # N, N m, rad or m
_LAST = 100  # control samples, one second
_OWN = 12  # coordinates of the base and of the left arm, in which the laws compute


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--laws", nargs="*", default=controller_names())
    given = parser.parse_args()
    print(
        "| law | runs within the limits | force N | moment N m | gap | error of base and left arm "
        "| error of the right arm | engine |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for law in given.laws:
        print(_row(law, given.seeds), flush=True)


def _row(law: str, seeds: int) -> str:
    """How many runs keep the limits, with the interval at 95 %, and the largest figures."""
    settings = [f"controller={law}", "chain.force.share=0", *CALIBRATION]
    missions = [load_scenario("two_arms", [*settings, f"random_seed={k}"]) for k in range(seeds)]
    runs = simulate_many(missions, engine="compiled")
    rows = np.array([_figures(run) for run in runs])
    ended = np.array([run.outcome.status == "completed" for run in runs])
    kept = int((ended & (rows[:, :3] <= (FORCE, MOMENT, GAP)).all(axis=1)).sum())
    low, high = stats.binomtest(kept, seeds).proportion_ci(0.95, method="wilson")
    figures = " | ".join(f"{each:.2g}" for each in rows.max(axis=0))
    engine = runs[0].engine.split(" ")[0]
    return f"| `{law}` | {kept} of {seeds} ({low:.0%} to {high:.0%}) | {figures} | {engine} |"


def _figures(run: RunRecord) -> list[float]:
    """Largest force, moment and gap of the run; largest errors of the last second."""
    error = np.abs(run.dataset["error"].values[-_LAST:])
    contacts = run.metrics["contacts"]
    own, follows = error[:, :_OWN].max(), error[:, _OWN:].max()
    return [contacts["force"], contacts["moment"], contacts["gap"], float(own), float(follows)]


if __name__ == "__main__":
    main()
