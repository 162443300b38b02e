"""What one rollout costs, as ratios: against the bare plant, against the same loop on MuJoCo and on
Basilisk, by degrees of freedom.

    python benchmarks/rollout.py [--repeats 20] [--duration 20]

All times are processor time of this process, of all its threads. All compared runs take turns
within one process, and what is printed are medians of the repeats, because a machine's speed
changes from minute to minute; the minima, which other work on the machine disturbs less, stand in
brackets. The scenario is ``postcapture`` with the proposed controller: 20
s, or what is asked for, at 10 ms.

(a) the bare plant: the same plant, integrator and step under a constant generalized force,
AdvanceTo only; (b) our closed loop: AdvanceTo, with everything that a run records; (c) the same
closed loop written for MuJoCo: fourth-order Runge-Kutta at 10 ms, the law in NumPy, the mass matrix
of a
    second model with the nominal payload;
(d) the same on Basilisk, where it is installed (pip install bsk): its simulation of a MuJoCo model,
    the law of (c) as a module in Python, and a recorder of the state; ExecuteSimulation only;
(e) 1, 16 and 64 runs of (c) at once, which differ in their seed: an ``MjData`` each, the law on
    arrays. Its time is that of all, divided by their number.
(k) as many runs of our closed loop compiled, each with a seed of its own, per run, with their
    preparation, noise and log, where llvmlite is installed (pip install 'ffsm-drake[compiled]').
(n) as (k), prepared before: noise, machine code and log.

Then ``thrusters_and_wheels`` with its actuators, with its wheels alone, and with the thrusters of
``thrusters_only`` alone, over the same run with an ideal wrench: what allocation, modulation and
wheels cost. And ``flexible_panels`` over the same run with the panels locked: what hidden
coordinates cost.
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
from on_mujoco import Arm, MujocoBatch, MujocoLoop
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator

from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.engine import results_of
from ffsm_drake.plugins.compiled.kernel import Kernel, Step
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.runs.engine import find_engine
from ffsm_drake.runs.log import RunLog
from ffsm_drake.runs.rollout import Rollout
from ffsm_drake.runs.simulate import simulate
from ffsm_drake.scenario import Scenario, load_scenario
from ffsm_drake.spacecraft.mass_properties import set_payload
from ffsm_drake.spacecraft.plant import configuration, coordinates_of, make_plant

try:
    import on_basilisk
except ImportError as error:
    on_basilisk, WITHOUT_BASILISK = None, str(error)

JOINTS = (5, 7, 14)
AT_ONCE = (1, 16, 64)  # runs
COMPILED = "compiled"
ACTUATORS = {
    "ideal wrench": ("actuation.thrusters=null", "actuation.wheels=null"),
    "four wheels": ("actuation.thrusters=null",),
    "16 thrusters": ("actuation.wheels=null", "actuation.thrusters.layout=16x22N"),
    "12 thrusters, four wheels": (),
}
PANELS = {"locked": ("model.flexible={}",), "two panels": ()}


class BarePlant:
    """(a)."""

    def __init__(self, scenario: Scenario) -> None:
        self.end = scenario.num_control_periods * scenario.sample_time
        plant = make_plant(scenario.model)
        self.simulator = Simulator(plant)
        ApplySimulatorConfig(scenario.simulator_config, self.simulator)
        context = self.simulator.get_mutable_context()
        set_payload(plant, context, body=scenario.payload.body, properties=scenario.payload.truth)
        plant.SetPositions(
            context,
            configuration(coordinates_of(plant), scenario.initial_posture, key="initial_posture"),
        )
        force = np.full(plant.num_velocities(), 0.01)
        plant.get_applied_generalized_force_input_port().FixValue(context, force)
        self.start = context.Clone()

    def advance_time(self) -> float:
        """Processor time of one run, s."""
        self.simulator.get_mutable_context().SetTimeStateAndParametersFrom(self.start)
        self.simulator.Initialize()
        start = time.process_time()
        self.simulator.AdvanceTo(self.end)
        return time.process_time() - start


def arm_scenario(joints: int, folder: Path, *overrides: str) -> Scenario:
    """``postcapture`` with a generated arm; joints beyond the fifth stay at zero."""
    model, directives = folder / f"arm_{joints}.urdf", folder / f"arm_{joints}.dmd.yaml"
    model.write_text(Arm.of(joints).urdf())
    directives.write_text(f"directives:\n- add_model: {{name: arm, file: 'file://{model}'}}\n")
    arm = (
        f"model.directives={directives}",
        "model.end_effector=arm::payload",
        "payload.body=arm::payload",
    )
    return load_scenario("postcapture", (*arm, *overrides))


def sensor_noise(log: RunLog) -> np.ndarray:
    """What the sensors added to the velocities (n, nv)."""
    difference = log.series["measurement"] - log.series["state"]
    return difference[:, len(log.coordinates.position_names) :]


def timed(work: Callable[[], object]) -> float:
    """Processor time, s."""
    start = time.process_time()
    work()
    return time.process_time() - start


def advance_time(run: Callable[[], object]) -> float:
    """Processor time of Drake's AdvanceTo, with all that it calls, during a run, s."""
    advance, spent = Simulator.AdvanceTo, 0.0

    def timed_advance(*arguments: Any) -> Any:
        nonlocal spent
        start = time.process_time()
        try:
            return advance(*arguments)
        finally:
            spent += time.process_time() - start

    with mock.patch.object(Simulator, "AdvanceTo", timed_advance):
        run()
    return spent


class Timing(NamedTuple):
    """Seconds."""

    median: float
    minimum: float

    def over(self, other: "Timing") -> str:
        """The ratio to another, of medians and in brackets of minima."""
        return f"{self.median / other.median:.2f} ({self.minimum / other.minimum:.2f})"

    def __str__(self) -> str:
        return f"{1e3 * self.median:7.1f} ms ({1e3 * self.minimum:7.1f})"


def interleaved(contestants: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, Timing]:
    """Each contestant's times, all taking turns, after one round to warm up."""
    times: dict[str, list[float]] = {name: [] for name in contestants}
    for turn in range(repeats + 1):
        for name, contestant in contestants.items():
            seconds = contestant()
            if turn > 0:
                times[name].append(seconds)
    return {name: Timing(statistics.median(values), min(values)) for name, values in times.items()}


class Contest(NamedTuple):
    """(a) to (d) of one scenario, or to (c) without Basilisk."""

    rollout: Rollout
    contestants: dict[str, Callable[[], float]]  # seconds
    differences: dict[str, np.ndarray]  # (n, nv) between the errors of (b) and those of (c) and (d)


def contest(scenario: Scenario) -> Contest:
    rollout = Rollout(scenario)
    log = rollout.run()
    if not log.outcome.completed:
        raise SystemExit(log.outcome.message)
    bare, loop, noise = (
        BarePlant(scenario),
        MujocoLoop(scenario, log.coordinates),
        sensor_noise(log),
    )
    contestants = {
        "a": bare.advance_time,
        "b": lambda: advance_time(rollout.run),
        "c": lambda: timed(lambda: loop.run(noise)),
    }
    differences = {"c": log.error - loop.run(noise)}
    if on_basilisk is not None:
        module = on_basilisk.BasiliskLoop(scenario, log.coordinates)
        contestants["d"] = lambda: module.run(noise)[0]
        differences["d"] = log.error - module.run(noise)[1]
    return Contest(rollout, contestants, differences)


class AtOnce(NamedTuple):
    """Several runs at once of one scenario, which differ in their seed. Names have the number of
    runs behind the letter.
    """

    contestants: dict[str, Callable[[], float]]  # seconds per run
    differences: dict[str, float]  # largest between their errors and those of (b), seed by seed


def at_once(rollout: Rollout, runs: int) -> AtOnce:
    """Every loop that takes several runs at once is a contestant here."""
    mission = rollout.loop.mission
    seeds = [mission.flown_by(random_seed=seed) for seed in range(runs)]
    logs = [rollout.run(seed) for seed in seeds]
    compiled = find_engine(COMPILED) if find_spec("llvmlite") else None
    noise = np.stack([sensor_noise(log) for log in logs], axis=1)
    errors = np.stack([log.error for log in logs], axis=1)
    batch = MujocoBatch(mission.scenario, logs[0].coordinates, runs)
    found = {"e": batch.run(noise)}
    contestants: dict[str, Callable[[], float]] = {
        "e": lambda: timed(lambda: batch.run(noise)) / runs,
    }
    if compiled is not None:
        found["k"] = np.stack([log.error for log in compiled.run_all(seeds)], axis=1)
        contestants["k"] = lambda: timed(lambda: compiled.run_all(seeds)) / runs
        prepared = [Run(seed) for seed in seeds]
        contestants["n"] = lambda: timed(lambda: run_prepared(prepared)) / runs
        found["n"] = np.stack([log.error for log in run_prepared(prepared)], axis=1)
    return AtOnce(
        contestants={f"{name}{runs}": work for name, work in contestants.items()},
        differences={
            f"{name}{runs}": float(np.abs(errors - own).max()) for name, own in found.items()
        },
    )


def run_prepared(runs: Sequence[Run]) -> list[RunLog]:
    """The logs of prepared runs with the same code, with their noise drawn anew."""
    for run in runs:
        vars(run.case).pop("noise", None)
    return [log for log in results_of(runs, alone=len(runs) == 1) if isinstance(log, RunLog)]


def compile_times(scenario: Scenario) -> list[str]:
    """What code of runs costs that is not kept yet, and code with derivatives."""
    run, told = Run(Mission(scenario)), list[str]()
    how: dict[str, Any] = {"steps": run.steps, "key": run.key_on_disk}
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.dict(os.environ, XDG_CACHE_HOME=folder),
    ):
        told.append(f"{timed(lambda: Kernel(run.blocks, **how, alone=False)):.2f} s")
        told.append(f"{timed(lambda: Step(run.blocks, **how, slopes=True)):.2f} s")
    return told


def variant_times(
    scenario: str, variants: Mapping[str, Sequence[str]], repeats: int, duration: str
) -> dict[str, Timing]:
    """AdvanceTo of a shipped scenario with the overrides of its variants."""
    rollouts = {
        name: Rollout(load_scenario(scenario, (duration, *overrides)))
        for name, overrides in variants.items()
    }
    return interleaved(
        {
            name: lambda rollout=rollout: advance_time(rollout.run)
            for name, rollout in rollouts.items()
        },
        repeats,
    )


def print_contest(times: Mapping[str, Timing], contest: Contest, samples: int) -> None:
    a, b, c = (times[name] for name in "abc")
    print(f"  (a) bare plant         {a}")
    print(f"  (b) closed loop        {b}   b/a {b.over(a)}")
    print(f"  (c) same on MuJoCo     {c}   b/c {b.over(c)}")
    if "d" in times:
        print(
            f"  (d) same on Basilisk   {times['d']}   b/d {b.over(times['d'])}   bsk "
            f"{on_basilisk.VERSION}"
        )
    else:
        print(f"  (d) same on Basilisk   skipped, needs 'pip install bsk': {WITHOUT_BASILISK}")
    print(
        f"  (b) - (a) per control sample: {(b.median - a.median) / samples * 1e6:.0f} us", end=" "
    )
    print(f"({(b.minimum - a.minimum) / samples * 1e6:.0f})")
    for name, difference in contest.differences.items():
        print(
            f"  final error, largest difference (b) - ({name}): {np.abs(difference[-1]).max():.1e}"
        )
        print(f"  error of the whole run, likewise:          {np.abs(difference).max():.1e}")
    for name, label in (
        ("build", "Rollout(scenario)"),
        ("run", "run() and its metrics"),
        ("simulate", "simulate()"),
    ):
        print(f"  {label:22s} {times[name]}   {times[name].over(b)} of (b)")


def print_at_once(times: Mapping[str, Timing], together: Sequence[AtOnce]) -> None:
    labels = {"e": "MuJoCo", "k": f"ours, {COMPILED}", "n": "prepared before"}
    for each in together:
        for name, difference in each.differences.items():
            letter, runs = name[0], name[1:]
            others = [other for other in (*"abcd", f"e{runs}") if other in times]
            against = "   ".join(
                f"{letter}/{other[0]} {times[name].over(times[other])}"
                for other in others
                if other != name
            )
            label = f"({letter}) {runs} at once, {labels[letter]}, each"
            print(f"  {label:38s} {times[name]}   {against}")
            print(f"  error of all runs, largest difference (b) - ({letter}): {difference:.1e}")
    if not any(name.startswith("k") for name in times):
        print("  (k) skipped, needs 'pip install ffsm-drake[compiled]'")


def print_variants(times: Mapping[str, Timing], samples: int) -> None:
    """All against the first."""
    first, base = next(iter(times.items()))
    for name, timing in times.items():
        added = (timing.median - base.median) / samples * 1e6
        print(f"  {name:26s} {timing}   {timing.over(base)} of {first}, {added:+.0f} us")


def print_arms(times: Mapping[str, Timing], arms: Mapping[int, Contest]) -> None:
    for joints, arm in arms.items():
        own = {name: times[f"{name}{joints}"] for name in arm.contestants}
        b = own["b"]
        print(f"  {joints:2d}: " + "  ".join(f"({name}) {timing}" for name, timing in own.items()))
        print("      " + "  ".join(f"b/{name} {b.over(own[name])}" for name in own if name != "b"))
        finals = {
            name: np.abs(difference[-1]).max() for name, difference in arm.differences.items()
        }
        print(
            "      final error, "
            + ", ".join(f"(b) - ({name}): {final:.1e}" for name, final in finals.items())
        )
    degrees = np.log([joints + 6 for joints in arms])
    exponents = {
        name: np.polyfit(degrees, np.log([times[f"{name}{joints}"].minimum for joints in arms]), 1)[
            0
        ]
        for name in own
    }
    print(
        "  minima ~ (degrees of freedom)^p: "
        + ", ".join(f"({name}) p = {p:.2f}" for name, p in exponents.items())
    )


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument(
        "--repeats", type=int, default=20, help="repeats of each measurement (default: 20)"
    )
    parser.add_argument(
        "--duration", type=float, default=20.0, help="simulated time of a run, s (default: 20)"
    )
    arguments = parser.parse_args(argv)
    repeats, duration = arguments.repeats, f"duration={arguments.duration:g}"
    fewer = min(repeats, max(5, repeats // 4))

    scenario = load_scenario("postcapture", [duration])
    shipped = contest(scenario)
    together = [at_once(shipped.rollout, runs) for runs in AT_ONCE]
    times = interleaved(
        shipped.contestants
        | {name: work for each in together for name, work in each.contestants.items()}
        | {
            "build": lambda: timed(lambda: Rollout(scenario)),
            "run": lambda: timed(lambda: shipped.rollout.run().metrics),
            "simulate": lambda: timed(lambda: simulate(scenario, check_stability=False).dataset),
        },
        repeats,
    )
    print(
        f"postcapture, tde_aismc, {arguments.duration:g} s: medians of {repeats} interleaved "
        "repeats (minima)"
    )
    print_contest(times, shipped, scenario.num_control_periods)
    print_at_once(times, together)

    for name, variants in (("thrusters_and_wheels", ACTUATORS), ("flexible_panels", PANELS)):
        print(f"{name}, medians of {fewer} (minima), and per control sample what is added")
        print_variants(variant_times(name, variants, fewer, duration), scenario.num_control_periods)

    with tempfile.TemporaryDirectory() as folder:
        arms = {joints: contest(arm_scenario(joints, Path(folder), duration)) for joints in JOINTS}
        # All arms take turns, too: a machine whose speed changes would show in the exponents.
        times = interleaved(
            {
                f"{name}{joints}": work
                for joints, arm in arms.items()
                for name, work in arm.contestants.items()
            },
            fewer,
        )
        print(f"cost against joints, generated arms, medians of {fewer} (minima)")
        print_arms(times, arms)
        if find_spec("llvmlite"):
            for joints, arm in arms.items():
                runs, slopes = compile_times(arm.rollout.loop.scenario)
                print(
                    f"  {joints:2d} joints, traced and compiled: runs {runs}, derivatives {slopes}"
                )


if __name__ == "__main__":
    main()
