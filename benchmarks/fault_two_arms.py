"""Fault detection with two arms on one target: first reports in drawn captures.

    python benchmarks/fault_two_arms.py out/faults.jsonl --kind faulty --number 120
    python benchmarks/fault_two_arms.py out/faults.jsonl --kind healthy --number 200
    python benchmarks/fault_two_arms.py out/faults.jsonl --table

Captures of ``two_arms_capture``, half with flight sensors, thrusters and wheels, half with ideal
actuators; a third with a second hand that closes 1 to 2 s later. The target tumbles at up to
3 deg/s about each axis. Its true mass and inertia are 0.5 to 2 times the nominal ones, its centre
up to 0.1 m off. Disturbances are 0.3 to 3 times the shipped ones. Hand and encoders of the right
arm have errors of 1 mm and 1 mrad, and half of the wrists noise of 0.3 N and 0.02 N m. A fault of
any unit begins 2.5 to 4 s after the start and is watched for 4 s. Nothing reacts to detection.
Draws that the file has are not run again.
"""

import argparse
import collections
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from fault_records import fed, first_report, judged

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.scenario import Scenario, load_scenario

AWAY = {"right_1": 1.5, "right_2": 1.6, "right_3": -1.45, "right_4": 0.05, "right_5": -1.65}
FLIGHT = [
    "estimator={kind: kalman, walk: "
    "{base_position: 4.35e-4, base_rotation: 8.71e-5, joints: 1.96e-3}}",
    "sensing.position_noise={base_position: 1.0e-3, base_rotation: 5.0e-5, joints: 1.0e-5}",
    "sensing.velocity_noise={base_position: 1.0e-3, base_rotation: 1.5e-5, joints: 1.0e-4}",
    "controllers.tdc.k_d={base_position: 5.29, base_rotation: 35.9, joints: 36.7}",
    "controllers.tdc.k_p={base_position: 7.0, base_rotation: 322.0, joints: 337.0}",
    "actuation.thrusters.layout=12x5N",
]  # fmt: skip
AXES = ([1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1])
WHEELS = {
    f"w{k}": {"axis": axis, "inertia": 0.08, "torque_limit": 1.0, "speed_limit": 628.0}
    for k, axis in enumerate(AXES)
}
WIDE = "{position: 0.5, angle: 0.5, velocity: null, angular_velocity: null}"
WATCHED = 4.0  # s


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("log", type=Path, help="JSON lines of the draws")
    parser.add_argument("--kind", choices=["faulty", "healthy"], default="faulty")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--number", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--table", action="store_true", help="print only the table")
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    known = read(asked.log)
    for index in range(asked.first, asked.first + asked.number * (not asked.table)):
        if (asked.kind, asked.seed, index) in {(e["kind"], e["seed"], e["index"]) for e in known}:
            continue
        line = {"kind": asked.kind, "seed": asked.seed, "index": index}
        line |= told(drawn(asked.kind, asked.seed, index))
        with asked.log.open("a") as file:
            file.write(json.dumps(line) + "\n")
        print(json.dumps(line), flush=True)
    show(read(asked.log))


def read(path: Path) -> list[dict[str, Any]]:
    """The draws of a file, if it exists."""
    return list(map(json.loads, path.read_text().splitlines())) if path.exists() else []


def drawn(kind: str, seed: int, index: int) -> Scenario:
    """A capture."""
    random = np.random.default_rng([seed, kind == "healthy", index])
    is_flight, is_late = bool(index % 2), index % 3 == 2
    begin = round(float(random.uniform(2.5, 4.0)), 2)
    ratio, amplitude = random.uniform(0.5, 2.0), 10 ** random.uniform(-0.52, 0.48)
    centre = random.normal(size=3)
    centre *= 0.1 * random.random() / np.linalg.norm(centre)
    rate = np.deg2rad(random.uniform(-3.0, 3.0, 3)).round(5).tolist()
    given: list[Any] = [
        f"duration={begin + WATCHED}", "reference.duration=6", f"random_seed={index}",
        f"capture.rate={rate}", f"disturbance.amplitude_scale={amplitude:.4f}",
        f"actuation.limit={{joints: {random.choice([20, 50])}}}", f"capture.envelope={WIDE}",
        "faults.detection={}",
    ]  # fmt: skip
    biases = {f"right_{k}": 1e-3 * float(random.choice([-1, 1])) for k in range(1, 7)}
    given.append({"sensing": {"position_bias": biases}})
    law = "tdc" if is_flight else str(random.choice(["tdc", "tde_aismc", "computed_torque"]))
    given += [f"controller={law}", *(FLIGHT if is_flight else [])]
    if is_flight:
        given.append({"actuation": {"wheels": {"units": WHEELS}}})
    right: dict[str, Any] = {"closes": round(float(random.uniform(1.0, 2.0)), 2)} if is_late else {
        "position_error": (1e-3 * random.choice([-1.0, 1.0], 3)).round(4).tolist()
    }  # fmt: skip
    if random.random() < 0.5:
        right |= {"force_noise": 0.3, "moment_noise": 0.02}
    given += [{"contacts": {"right": right}}]
    if is_late:
        given.append({"initial_posture": {"joints": AWAY}})
    if kind == "faulty":
        parts = ["sensing", "joints", *(["thrusters", "wheels"] if is_flight else [])]
        event = {"unit": str(random.choice(parts)), "time": [begin]}
        given.append({"faults": {"events": {"it": event}, "seed": int(random.integers(2**31))}})
    scenario = load_scenario("two_arms_capture", given)
    nominal = scenario.payload.nominal
    truth = {
        "mass": float(ratio * nominal.mass),
        "inertia": [float(ratio * each) for each in nominal.inertia],
        "center_of_mass": (np.array(nominal.center_of_mass) + centre).tolist(),
    }
    return scenario.replace(payload={"truth": truth})


def told(scenario: Scenario) -> dict[str, Any]:
    """What the first report of a mission is, and whether it is right."""
    try:
        kept = fed("", scenario)
        found, samples = first_report(kept)
    except FfsmError as error:
        return {"result": f"refused: {error}"}
    fault = kept["fault"]
    of = None if fault is None else [fault["unit"], fault["kind"], fault["time"][0]]
    seconds = samples * scenario.sample_time
    return {"fault": of, "result": judged(fault, found), "found": found, "seconds": seconds}


def show(lines: Sequence[dict[str, Any]]) -> None:
    """A table of results by part, with Wilson intervals of 95 %, and of times to the report."""
    groups = collections.defaultdict[str, list[dict[str, Any]]](list)
    for line in lines:
        if line["result"].startswith("refused"):
            groups["refused"].append(line)
            continue
        groups[line["kind"]].append(line)
        if line["fault"]:
            groups[line["fault"][0].partition(".")[0]].append(line)
    for name, of in groups.items():
        counts = collections.Counter("refused" if name == "refused" else e["result"] for e in of)
        for result, count in sorted(counts.items()):
            low, high = wilson(count, len(of))
            print(f"| {name} | {result} | {count} of {len(of)} | {low:.1%} to {high:.1%} |")
        times = [e["found"][0][0] - e["fault"][2] for e in of if e["result"] == "right"]
        if times:
            median, most = np.quantile(times, [0.5, 0.9])
            print(f"| {name} | from fault to report | {median:.2f} s, 90 % {most:.2f} s |")


def wilson(count: int, total: int) -> tuple[float, float]:
    """The interval of 95 % of a share."""
    z, share = 1.96, count / total
    middle = (share + z**2 / (2 * total)) / (1 + z**2 / total)
    half = z * np.sqrt(share * (1 - share) / total + z**2 / (4 * total**2)) / (1 + z**2 / total)
    return max(0.0, middle - half), min(1.0, middle + half)


if __name__ == "__main__":
    main()
