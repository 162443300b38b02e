"""What a step of a vector environment costs, compiled and on Drake.

    python benchmarks/vector_environments.py [--copies 64] [--steps 400] [--duration 2]

Prints processor time per step and copy in microseconds: of steps within episodes, and of whole
episodes of so many seconds with their ends and restarts; medians of ``--repeats``, which take
turns. Earlier versions of the package put all copies into one Drake diagram: to compare with one,
run this script there too.
"""

import argparse
import inspect
import statistics
import time

import numpy as np

from ffsm_drake.plugins.gymnasium.vector import MissionVectorEnv

KINDS = [
    (name, kind) for name in ("postcapture", "free_floating") for kind in ("force", "residual")
]


def cost(env: MissionVectorEnv, steps: int) -> float:
    """Processor time of a step and copy, microseconds."""
    actions = np.random.default_rng(0).uniform(-1e-3, 1e-3, env.action_space.shape)
    start = time.process_time()
    for _ in range(steps):
        env.step(actions)
    return 1e6 * (time.process_time() - start) / steps / env.num_envs


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--copies", type=int, default=64)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--duration", type=float, default=2.0)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    has_engines = "engine" in inspect.signature(MissionVectorEnv.__init__).parameters
    engines = [{"engine": each} for each in ("compiled", "drake")] if has_engines else [{}]
    for name, kind in KINDS:
        within, whole = ([list[float]() for _ in engines] for _ in range(2))
        for _ in range(given.repeats):
            for i, engine in enumerate(engines):
                long = MissionVectorEnv(given.copies, name, action=kind, **engine)
                long.reset(seed=1)
                cost(long, 5)
                # Drake is slow, and has no cost that comes seldom
                within[i].append(cost(long, given.steps if i == 0 else given.steps // 10))
                long.close()
                short = (f"duration={given.duration}",)
                env = MissionVectorEnv(given.copies, name, short, action=kind, **engine)
                env.reset(seed=1)
                whole[i].append(cost(env, round(given.duration / 0.01) + 1))  # of 10 ms
                env.close()
        for i, engine in enumerate(engines):
            a, b = statistics.median(within[i]), statistics.median(whole[i])
            label = engine.get("engine", "one diagram")
            print(f"{name} {kind} {label}: {a:.2f} us within episodes, {b:.2f} us in whole ones")


if __name__ == "__main__":
    main()
