"""Two arms on one target: the internal force under four laws, and what a run costs.

``python benchmarks/two_arms.py --seeds 20`` prints the tables of
``docs/validation/missions.md``; costs are processor time.
"""

import argparse
import dataclasses
import time

import numpy as np

from ffsm_drake import RunRecord, Scenario, load_scenario, simulate
from ffsm_drake.systems.controllers import PAPER_LAWS

ENCODERS = f"sensing.position_bias={{{', '.join(f'right_{k}: 1e-3' for k in range(1, 7))}}}"
CALIBRATION = (ENCODERS, "contacts.right.position_error=[1e-3, 0, 0]")
WRISTS = ("contacts.right.force_noise=1", "contacts.right.moment_noise=0.05")
ERRORS = {
    "none": (),
    "1 mrad, 1 mm": CALIBRATION,
    "1 mrad, 1 mm; wrist 1 N, 0.05 N m": (*CALIBRATION, *WRISTS),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--laws", nargs="*", default=PAPER_LAWS)
    parser.add_argument("--repeats", type=int, default=5, help="of the runs whose cost is taken")
    given = parser.parse_args()
    print(
        "| law | in the chain | calibration error | runs | ended | force N | moment N m | "
        "base rad | base m |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for law in given.laws:
        for chain, seeds in (("plain", 1), ("minimal, force: null", 1), ("minimal", given.seeds)):
            for errors, overrides in ERRORS.items():
                if "wrist" in errors and chain != "minimal":  # nothing else measures the wrench
                    continue
                print(_row(law, chain, errors, overrides, seeds), flush=True)
    for name, seconds, ratio in _costs(given.repeats):
        print(f"{name}: {seconds:.3f} s, {ratio:.2f} times the one-armed run")


def _row(law: str, chain: str, errors: str, overrides: tuple[str, ...], seeds: int) -> str:
    """The largest figures over the seeds."""
    kind, _, force = chain.partition(", ")
    more = ["chain.force=null"] if force else []
    runs = [
        simulate(
            load_scenario(
                "two_arms",
                [
                    f"controller={law}",
                    f"chain.law={kind}",
                    f"random_seed={seed}",
                    *more,
                    *overrides,
                ],
            ),
            check_stability=False,
        )
        for seed in range(seeds)
    ]
    rows = np.array([_figures(run) for run in runs]).max(axis=0)
    ended = sum(run.outcome.status == "completed" for run in runs)
    figures = " | ".join(f"{each:.2g}" if each < 1e3 else f"{each:.0f}" for each in rows)
    return f"| {law} | {chain} | {errors} | {seeds} | {ended} | {figures} |"


def _figures(run: RunRecord) -> list[float]:
    """Largest force and moment at the second contact; largest error of the base's attitude and
    position.
    """
    error = np.abs(run.dataset["error"].values)
    contacts = run.metrics["contacts"]
    return [contacts["force"], contacts["moment"], error[:, :3].max(), error[:, 3:6].max()]


def _costs(repeats: int) -> list[tuple[str, float, float]]:
    """The least processor time of a run: with the target in one hand, and in both."""
    both = load_scenario("two_arms")
    plain = dataclasses.replace(both, chain=dataclasses.replace(both.chain, law="plain"))
    runs: dict[str, Scenario] = {
        "one hand": dataclasses.replace(both, contacts={}),
        "both hands, plain": plain,
        "both hands, minimal": both,
    }
    least = dict.fromkeys(runs, np.inf)
    for _ in range(repeats):
        for name, scenario in runs.items():
            begin = time.process_time()
            simulate(scenario, check_stability=False)
            least[name] = min(least[name], time.process_time() - begin)
    return [(name, each, each / least["one hand"]) for name, each in least.items()]


if __name__ == "__main__":
    main()
