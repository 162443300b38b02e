"""Decides on recorded runs: what detection is fed is kept on disk, so that a change is judged fast.

    python benchmarks/fault_records.py record out/fed --kind faulty --number 300
    python benchmarks/fault_records.py decide out/fed

The missions are those of ``fault_detection.py`` with another generator: the fault is at any time
from 3.5 to 8 s, the mass ratio is even from 0.5 to 2, and the joints end up to 0.2 rad elsewhere.
Nothing reacts to detection. A run counts up to its first report, which ``decide`` prints with the
processor time of detection per control sample.
"""

import argparse
import collections
import dataclasses
import json
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from fault_detection import Study, _direction, jam, own_missions

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.faults import detection
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Grip, Scenario, scenario_from_dict, scenario_to_dict
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.faults import settle_faults
from ffsm_drake.systems.sampled import Arrays, Now
from ffsm_drake.systems.setup import BlockSetup

KINDS = ("faulty", "healthy", "jams")
LONGER = 1e3  # s


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("action", choices=["record", "decide"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--kind", choices=KINDS, default="faulty")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--number", type=int, default=300)
    parser.add_argument("--seed", type=int, default=7, help="of the generator")
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    if asked.action == "decide":
        decide(asked.folder)
        return
    study = Others(asked.seed, arms(asked.folder))
    for index in range(asked.first, asked.first + asked.number):
        path = asked.folder / f"{asked.kind}_{index:03d}.npz"
        if not path.exists() and (kept := record(study, asked.kind, index)) is not None:
            write(path, kept)
            print(kept["mission"], kept["fault"], flush=True)


def write(path: Path, kept: dict[str, Any]) -> None:
    """Write what ``fed`` returns: arrays, and the rest as JSON text."""
    plain = {name: kept[name] for name in ("mission", "fault")}
    plain["scenario"] = scenario_to_dict(kept["scenario"])
    plain["grips"] = [dataclasses.asdict(leg["grip"]) for leg in kept["legs"]]
    arrays = {
        f"{leg}.{name}": values
        for leg, each in enumerate(kept["legs"])
        for name, values in each["fed"].items()
    }
    whole = path.with_suffix(".part")
    with whole.open("wb") as file:
        np.savez_compressed(file, plain=np.array(json.dumps(plain)), **arrays)
    whole.rename(path)


def read(path: Path) -> dict[str, Any]:
    """Return what ``write`` was given."""
    with np.load(path) as arrays:
        kept = json.loads(str(arrays["plain"]))
        legs = [{"grip": Grip(**grip), "fed": {}} for grip in kept.pop("grips")]
        for key in arrays.files:
            leg, _, name = key.partition(".")
            if name:
                legs[int(leg)]["fed"][name] = arrays[key]
    # a drawn run may end before its approach does, which a scenario file may not
    plain = kept["scenario"] | {"duration": kept["scenario"]["duration"] + LONGER}
    return kept | {"scenario": scenario_from_dict(plain), "legs": legs}


def arms(folder: Path) -> list[Path]:
    """Scenario files of ``ffsm new``, made once for a folder."""
    listed = folder / "arms.json"
    if not listed.exists():
        folder.mkdir(parents=True, exist_ok=True)
        made = own_missions(folder.resolve(), [])
        listed.write_text(json.dumps([str(path) for path in made]))
    return [Path(each) for each in json.loads(listed.read_text())]


class Others(Study):
    """Missions that the detector was not designed with."""

    def draw(self, rng: np.random.Generator, *, breaks: bool) -> tuple[str, Scenario]:
        """See Study."""
        name, scenario = super().draw(rng, breaks=breaks)
        assert scenario.faults is not None
        for key, fault in scenario.faults.events.items():
            at = round(float(rng.uniform(3.5, 8.0)), 2)
            faults = dataclasses.replace(
                scenario.faults, events={key: dataclasses.replace(fault, time=[at])}
            )
            scenario = dataclasses.replace(scenario, faults=faults, duration=at + 6.0)
        if scenario.capture is not None and scenario.capture.approach is not None:
            return name, scenario
        nominal, ratio = scenario.payload.nominal, float(rng.uniform(0.5, 2.0))
        centre = np.array(nominal.center_of_mass) + 0.1 * rng.random() * _direction(rng)
        truth = dataclasses.replace(
            scenario.payload.truth,
            mass=ratio * nominal.mass,
            inertia=[ratio * each for each in nominal.inertia],
            center_of_mass=centre.tolist(),
        )
        payload = dataclasses.replace(scenario.payload, truth=truth)
        posture = scenario.target_posture
        moved = {
            joint: float(angle) + float(rng.uniform(-0.2, 0.2))
            for joint, angle in posture.joints.items()
        }
        if not name.endswith("rest"):
            posture = dataclasses.replace(posture, joints=moved)
        return name, dataclasses.replace(scenario, payload=payload, target_posture=posture)


class Listening(detection.Detector):
    """A detector that keeps what it is fed and changes nothing."""

    all_of: ClassVar[list["Listening"]] = []

    def __init__(self, setup: BlockSetup) -> None:
        super().__init__(setup)
        self.grip, self.fed, self.begins = setup.grip, list[dict[str, np.ndarray]](), np.inf
        Listening.all_of.append(self)

    def step(self, inputs: Arrays, memory: Arrays, now: Now) -> tuple[Arrays, Arrays]:
        """See Sampled."""
        self.begins = min(self.begins, float(now.time))
        self.fed.append({name: np.array(value, float) for name, value in inputs.items()})
        same = {"estimated_state": inputs["state"], **inputs, "fault_detected": memory["codes"]}
        return {
            name: np.array(same.get(name, np.zeros(size))) for name, size in self.outputs.items()
        }, memory


def record(study: Study, kind: str, index: int) -> dict[str, Any] | None:
    """What detection is fed in a drawn mission; one that cannot be built is drawn anew."""
    rng = np.random.default_rng([study.seed, len(kind), index])
    for _ in range(6):
        try:
            drawn = jam(index) if kind == "jams" else study.draw(rng, breaks=kind == "faulty")
            return fed(f"{kind}:{index} {drawn[0]}", drawn[1])
        except FfsmError as error:
            print(f"{kind}:{index}: {error}")
    return None


def fed(mission: str, scenario: Scenario) -> dict[str, Any]:
    """Fly it."""
    scenario = settle_faults(scenario, make_nominal_plant(scenario).coordinates)
    Listening.all_of.clear()
    plain, detection.Detector = detection.Detector, Listening  # type: ignore[misc]
    try:
        make_rollout(scenario).run()
    finally:
        detection.Detector = plain  # type: ignore[misc]
    assert scenario.faults is not None
    faults = [dataclasses.asdict(each) for each in scenario.faults.events.values()]
    legs = [
        {"grip": of.grip, "fed": {name: np.array([e[name] for e in of.fed]) for name in of.fed[0]}}
        for of in sorted(Listening.all_of, key=lambda of: of.begins)
        if of.fed
    ]
    return {
        "mission": mission, "scenario": scenario, "fault": faults[0] if faults else None,
        "legs": legs,
    }  # fmt: skip


def decide(folder: Path) -> None:
    """The first report of each record, and a table; of right ones also whether the kind is right,
    and the median and 90 % of the times from fault to report.
    """
    table = collections.Counter[tuple[str, str]]()
    times = collections.defaultdict[str, list[float]](list)
    for path in sorted(folder.glob("*.npz")):
        kept = read(path)
        begins = time.process_time()
        found, samples = first_report(kept)
        each = 1e3 * (time.process_time() - begins) / samples
        result, fault = judged(kept["fault"], found), kept["fault"]
        of = "" if fault is None else f"{fault['unit']} {fault['kind']} {fault['time'][0]}"
        part = of.partition(".")[0]
        table[(part, result)] += 1
        if result == "right":
            ((when, _, kind),) = found
            table[(part, "right, kind " + ("right" if kind == fault["kind"] else kind))] += 1
            times[part].append(when - fault["time"][0])
        print(f"{kept['mission']}: {of}: {result} {found} {each:.2f} ms", flush=True)
    for (part, result), count in sorted(table.items()):
        print(f"| {part or 'healthy'} | {result} | {count} |")
    for part, each in sorted(times.items()):
        median, most = np.quantile(each, [0.5, 0.9])
        print(f"| {part} | from fault to report | {median:.2f} s, 90 % {most:.2f} s |")


def stepped(kept: dict[str, Any]) -> Iterator[tuple[detection.Detector, Arrays, float]]:
    """The detector, its memory after each recorded sample, and when it reports that, s."""
    mission, memory, sample = Mission(kept["scenario"]), None, 0
    step = kept["scenario"].sample_time
    for leg in kept["legs"]:
        nominal, fed = mission.craft.nominal(leg["grip"]), leg["fed"]
        detector = detection.Detector(
            BlockSetup(name="detection", mission=mission, nominal=nominal, settings={})
        )
        memory = detector.start(fed["state"][0]) if memory is None else memory
        for row in range(len(fed["state"])):
            inputs = {name: values[row] for name, values in fed.items()}
            _, memory = detector.step(inputs, memory, Now(sample * step))
            sample += 1
            yield detector, memory, sample * step


def first_report(kept: dict[str, Any]) -> tuple[list[tuple[float, str, str]], int]:
    """Times, units and kinds of the first report, and the samples up to it."""
    found, samples = list[tuple[float, str, str]](), 0
    for detector, memory, now in stepped(kept):
        samples += 1
        for index in np.flatnonzero(memory["codes"]):
            kind = detection.KINDS[int(memory["codes"][index])]
            found.append((round(now, 2), detector.units[index], kind))
        if found:
            break
    return found, samples


def judged(fault: dict[str, Any] | None, found: Sequence[tuple[float, str, str]]) -> str:
    """Right, one of several, wrong, false (before the fault) or missed; of no fault: alarm."""
    if fault is None:
        return "alarm" if found else "quiet"
    if not found:
        return "missed"
    if found[0][0] < fault["time"][0]:
        return "false"
    if fault["unit"] not in [unit for _, unit, _ in found]:
        return "wrong"
    return "right" if len(found) == 1 else "one of"


if __name__ == "__main__":
    main()
