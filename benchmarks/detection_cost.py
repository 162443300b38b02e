"""What detection of faults costs in a run, and what its solver would be in compiled code.

    python benchmarks/detection_cost.py

Runs of 30 s of the shipped ``thrusters_and_wheels``, in turn: without detection, with a block that
has the inputs, outputs and memory of the detector and only passes them on, and with detection; on
Drake and, without the second, compiled. Then the operations of one step of the solver, for one
hypothesis, and those of the whole loop of a control sample.
"""

import time
import warnings
from collections.abc import Callable

import numpy as np

from ffsm_drake import load_scenario, simulate
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.compiled.case import Case
from ffsm_drake.plugins.compiled.functions import functions_of, traced_function
from ffsm_drake.plugins.compiled.run import Run
from ffsm_drake.plugins.faults import box_squares, detection
from ffsm_drake.plugins.tape.arrays import inputs
from ffsm_drake.plugins.tape.numbers import Tape
from ffsm_drake.scenario import Scenario
from ffsm_drake.systems.reference import timed
from ffsm_drake.systems.sampled import Arrays, Now

MISSION, DURATION, ROUNDS = "thrusters_and_wheels", 30.0, 5
SIZES = ((11, 21), (44, 58))  # equations and unknowns: of a feature, and of a chain of slopes


class Passing(detection.Detector):
    """The detector's ports and memory without its work."""

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        known = {**inputs, "estimated_state": inputs["state"], "fault_detected": memory["codes"]}
        return {
            name: np.array(known.get(name, np.zeros(size))) for name, size in self.outputs.items()
        }, memory


def main() -> None:
    warnings.simplefilter("ignore")
    plain = load_scenario(MISSION, [f"duration={DURATION:g}"])
    detects = load_scenario(MISSION, [f"duration={DURATION:g}", "faults.detection={}"])
    samples = DURATION / plain.sample_time
    whole = detection.Detector
    kinds: dict[str, tuple[Scenario, str, type[detection.Detector]]] = {
        "Drake, without detection": (plain, "drake", whole),
        "Drake, inputs passed on": (detects, "drake", Passing),
        "Drake, detection": (detects, "drake", whole),
        "compiled, without detection": (plain, "compiled", whole),
        "compiled, detection": (detects, "compiled", whole),
    }
    times: dict[str, list[float]] = {kind: [] for kind in kinds}
    for at in range(ROUNDS):
        for kind, (scenario, engine, detector) in kinds.items():
            detection.Detector = detector  # type: ignore[misc]
            took = seconds(
                lambda scenario=scenario, engine=engine: simulate(scenario, engine=engine)
            )
            if at:  # the first round compiles
                times[kind].append(1e3 * took / samples)
        print(f"round {at + 1} of {ROUNDS}", flush=True)
    for kind, took in times.items():
        print(f"{kind}: {min(took):.3f} ms per control sample, median {np.median(took):.3f}")
    for engine in ("Drake", "compiled"):
        least, most = (
            min(times[f"{engine}, {kind}"]) for kind in ("without detection", "detection")
        )
        print(f"{engine}: detection is {100.0 * (1.0 - least / most):.0f} % of the run")
    for rows, unknowns in SIZES:
        print(f"a step of the solver, {rows} equations: {step_size(rows, unknowns)} operations")
    print(f"the loop of {MISSION}: {loop_size(plain)} operations")


def seconds(run: Callable[[], object]) -> float:
    """Processor time of a call, s."""
    start = time.process_time()
    run()
    return time.process_time() - start


def step_size(rows: int, unknowns: int) -> int:
    """Operations of one step of the solver for one problem."""
    tape = Tape()
    shapes = {"matrix": (rows, unknowns), "left": (rows,), "gap": ()}
    shapes |= dict.fromkeys(("x", "up", "down"), (unknowns,))
    given = {name: inputs(tape, name, (1, *shape)) for name, shape in shapes.items()}
    box_squares._advanced(**given)
    return len(tape.operations)


def loop_size(scenario: Scenario) -> int:
    """Operations of all functions of a compiled run."""
    mission = timed(Mission(scenario))
    run = Run(mission, Case(mission))
    functions = functions_of(run.blocks, steps=run.steps, begins=True).values()
    tapes = [traced_function(run.blocks, function).tape for function in functions]
    tapes += [loop.tape for tape in tapes for loop in tape.loops.values()]
    return sum(len(tape.operations) for tape in tapes)


if __name__ == "__main__":
    main()
