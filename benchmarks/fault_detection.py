"""What the detection of faults is worth: false alarms of healthy missions, and what it notices.

    python benchmarks/fault_detection.py --healthy 500 --faulty 300 --jams 40 --seed 0

Missions are drawn: arms at rest and in motion, approaches, solar panels, thrusters and wheels, the
shipped arms, examples/courier.urdf and those of ``--urdf``; frequency of the disturbance times
0.3 to 5, amplitude times 0.3 to 3, a true payload of 0.5 to 2 times the nominal one, up to 0.1 m
off its centre. ``--jams`` are of joints of the shipped ``thrusters_and_wheels``. With ``--only
healthy:17`` one mission is run alone.
"""

import argparse
import dataclasses
import json
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ffsm_drake.common.errors import FfsmError
from ffsm_drake.plugins.capture.supervisor import Cause
from ffsm_drake.plugins.faults.detection import KINDS
from ffsm_drake.plugins.new.asked import Asked
from ffsm_drake.plugins.new.first_scenario import new_scenario
from ffsm_drake.runs.phases import make_rollout
from ffsm_drake.scenario import Fault, Scenario, load_scenario
from ffsm_drake.spacecraft.craft import make_nominal_plant
from ffsm_drake.systems.faults import settle_faults

ROOT = Path(__file__).parents[1]
HORIZON = 8.0  # s, of a mission without an approach
BREAKS, WATCHED = (4.0, 5.0), 6.0  # s, when, and how much longer at most
MOVES = 1e-3  # rad/s of the plan from which on a jam shows
PANELS = {
    side: {"position": [0, y, 0], "direction": [0, y, 0], "mass": 8.0, "frequency": 0.25,
           "damping_ratio": 0.005}
    for side, y in (("port", 1), ("starboard", -1))
}  # fmt: skip
ASKED = (
    {"capture": "3deg/s", "sensors": "flight"},
    {"capture": "3deg/s", "sensors": "flight", "thrusters": "12x5N", "wheels": "4"},
    {"sensors": "flight", "thrusters": "12x5N", "wheels": "4", "panels": "2x5kg"},
)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--healthy", type=int, default=500)
    parser.add_argument("--faulty", type=int, default=300)
    parser.add_argument("--jams", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--urdf", type=Path, nargs="*", default=[], help="more arms")
    parser.add_argument("--log", type=Path, help="of outcomes; those that it has are not run again")
    parser.add_argument("--only", help="one mission, such as healthy:17")
    asked = parser.parse_args(arguments)
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        study = Study(asked.seed, own_missions(Path(folder), asked.urdf), asked.log)
        if asked.only:
            kind, _, index = asked.only.partition(":")
            print(study.run(kind, int(index)))
            return
        print(healthy_table(study.outcomes("healthy", asked.healthy)), flush=True)
        print(faulty_table(study.outcomes("faulty", asked.faulty)), flush=True)
        print(faulty_table(study.outcomes("jams", asked.jams)))


def own_missions(folder: Path, urdfs: Sequence[Path]) -> list[Path]:
    """What ``ffsm new`` makes of the arms: scenario files."""
    made = []
    for urdf in (
        ROOT / "examples" / "courier.urdf",
        ROOT / "models" / "urdf" / "servicer.urdf",
        *urdfs,
    ):
        for number, words in enumerate(ASKED):
            try:
                new = new_scenario(
                    urdf, folder / f"{urdf.stem}_{number}", asked=Asked.parsed(**words)
                )
            except FfsmError as error:
                print(f"{urdf.name}, {words}: {error}")
            else:
                made.append(new.scenario_file)
    return made


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a run showed."""

    mission: str
    alarms: dict[str, float]  # "unit kind" -> s
    gives_up: bool  # on the detection's request
    ends: float  # s
    unit: str = ""  # of the fault
    kind: str = ""
    time: float = 0.0
    shows: bool = True  # whether the fault can be seen

    @property
    def delay(self) -> float:
        """Until the unit is named, s; infinite: it is not."""
        at = [time for name, time in self.alarms.items() if name.split()[0] == self.unit]
        return min(at, default=np.inf) - self.time

    @property
    def accused(self) -> list[str]:
        """Units that work."""
        return [name for name in self.alarms if name.split()[0] != self.unit]


class Study:
    """Missions by kind and number."""

    def __init__(self, seed: int, own: Sequence[Path], log: Path | None = None) -> None:
        self.seed, self._own, self._log = seed, own, log
        lines = log.read_text().splitlines() if log is not None and log.exists() else []
        known = [Outcome(**json.loads(line)) for line in lines]
        self._known = {each.mission.split()[0]: each for each in known}

    def outcomes(self, kind: str, number: int) -> list[Outcome]:
        """Of the first missions."""
        found = []
        for index in range(number):
            outcome = self._known.get(f"{kind}:{index}")
            if outcome is None:
                outcome = self.run(kind, index)
                if self._log is not None:
                    with self._log.open("a") as file:
                        file.write(json.dumps(dataclasses.asdict(outcome)) + "\n")
            found.append(outcome)
        return found

    def run(self, kind: str, index: int) -> Outcome:
        """A mission, drawn by its number; one that cannot be built is drawn anew."""
        rng = np.random.default_rng([self.seed, len(kind), index])
        while True:
            jams = kind == "jams"
            name, scenario = jam(index) if jams else self.draw(rng, breaks=kind == "faulty")
            try:
                return fly(f"{kind}:{index} {name}", scenario)
            except FfsmError as error:
                print(f"{kind}:{index} {name}: {error}")

    def draw(self, rng: np.random.Generator, *, breaks: bool) -> tuple[str, Scenario]:
        """A scenario with detection and a supervisor."""
        base = str(rng.choice(["thrusters_and_wheels", "flight_sensors", "panels", "own"],
                              p=[0.35, 0.2, 0.2, 0.25]))  # fmt: skip
        file: str | Path = base
        more: list[Any] = []
        if base == "panels":
            file, more = "flexible_panels", ["actuation.limit={all: 50}"]
            if rng.random() < 0.5:
                file, more = "thrusters_and_wheels", [{"model": {"flexible": PANELS}}]
        elif base == "own":
            file = self._own[int(rng.integers(len(self._own)))]
        elif base == "flight_sensors":
            more = [f"controller={rng.choice(['tdc', 'asmc', 'aismc', 'tde_aismc'])}"]
        scenario = load_scenario(file, more)
        name = base if isinstance(file, str) else f"{file.stem}"
        is_capture = scenario.capture is not None and scenario.capture.approach is not None
        duration = HORIZON if not is_capture else 14.0
        duration = BREAKS[1] + WATCHED if breaks else duration
        settings: list[Any] = [
            {"supervisor": {}, "faults": {"detection": {}}},
            f"random_seed={rng.integers(1000)}",
            f"disturbance.frequency_scale={_between(rng, 0.3, 5.0):.3g}",
            f"disturbance.amplitude_scale={_between(rng, 0.3, 3.0):.3g}",
            f"duration={duration}",
        ]
        if breaks:
            time = rng.uniform(*BREAKS)
            part = rng.choice(_parts(scenario))
            event = {"unit": str(part), "time": [round(time, 2)]}
            seed = int(rng.integers(10**6))
            settings.append({"faults": {"seed": seed, "events": {"it": event}}})
        if is_capture:
            settings.append(f"capture.approach.duration={12 if not breaks else 10}")
        else:
            settings.append(f"reference.duration={rng.choice([10, 20, 40, 60])}")
        scenario = load_scenario(file, [*more, *settings])
        truth, nominal = scenario.payload.truth, scenario.payload.nominal
        ratio = _between(rng, 0.5, 2.0)
        truth = dataclasses.replace(
            truth,
            mass=ratio * nominal.mass,
            inertia=[ratio * each for each in nominal.inertia],
            center_of_mass=(
                np.array(nominal.center_of_mass) + 0.1 * rng.random() * _direction(rng)
            ).tolist(),
        )
        if not is_capture:
            payload = dataclasses.replace(scenario.payload, truth=truth)
            scenario = dataclasses.replace(scenario, payload=payload)
            if rng.random() < 0.35:
                rest = scenario.target_posture
                scenario, name = dataclasses.replace(scenario, initial_posture=rest), f"{name} rest"
        return name, scenario


def jam(index: int) -> tuple[str, Scenario]:
    """A jam in the shipped ``thrusters_and_wheels``: each joint in turn, at four times."""
    joint, time = 1 + index % 5, (4.5, 6.0, 9.0, 14.0)[index // 5 % 4]
    events = {"it": {"unit": f"joints.joint_{joint}", "kind": "jammed", "time": [time]}}
    settings: list[Any] = [
        {"supervisor": {}, "faults": {"detection": {}, "events": events}},
        f"random_seed={index}",
        f"controller={('tdc', 'asmc', 'tdc', 'tdc')[index // 5 % 4]}",
        f"duration={time + 5.0}",
    ]
    return "thrusters_and_wheels", load_scenario("thrusters_and_wheels", settings)


def _parts(scenario: Scenario) -> list[str]:
    """Where it breaks."""
    base = [n for n in ("thrusters", "wheels") if getattr(scenario.actuation, n) is not None]
    return ["joints", "sensing", *base, *base[:1]]


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Even in the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _direction(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def fly(mission: str, scenario: Scenario) -> Outcome:
    """Run it."""
    scenario = settle_faults(scenario, make_nominal_plant(scenario).coordinates)
    log = make_rollout(scenario).run()
    (part,) = (each for name, each in log.parts.items() if name == "sensing.detection")
    names, alarms = part.signals[0].components, dict[str, float]()
    for unit, codes in zip(names, log.series["fault_detected"].T, strict=True):
        for k in np.flatnonzero(np.diff(codes, prepend=0.0)):
            alarms[f"{unit} {KINDS[int(codes[k])]}"] = round(float(log.time[k]), 2)
    outcome = Outcome(
        mission=mission,
        alarms=alarms,
        gives_up=bool((log.series["mode_cause"] == Cause.REQUEST).any()),
        ends=float(log.time[-1]),
    )
    assert scenario.faults is not None
    for fault in scenario.faults.events.values():
        shows = _shows(log, fault)
        outcome = dataclasses.replace(
            outcome, unit=fault.unit, kind=fault.kind, time=fault.time[0], shows=shows
        )
    return outcome


def _shows(log: Any, fault: Fault) -> bool:
    """Whether the plan moved a joint as it jammed."""
    if fault.kind != "jammed":
        return True
    coordinates, name = log.coordinates, fault.unit.partition(".")[2]
    column = len(coordinates.position_names) + list(coordinates.names).index(name)
    rate = log.series["desired_state"][np.searchsorted(log.time, fault.time[0]), column]
    return bool(abs(rate) >= MOVES)


def healthy_table(outcomes: Sequence[Outcome]) -> str:
    """Alarms."""
    accused = [each for each in outcomes if each.alarms]
    lines = [
        f"{len(outcomes)} runs without a fault: {len(accused)} with an alarm, "
        f"{sum(each.gives_up for each in outcomes)} given up on it",
        *(f"  {each.mission}: {each.alarms}" for each in accused),
    ]
    return "\n".join(lines)


def faulty_table(outcomes: Sequence[Outcome]) -> str:
    """What is noticed, by kind."""
    lines = [
        f"{len(outcomes)} runs with a fault",
        "| fault | runs | noticed | within 1 s | median, s | latest, s | a working unit named |",
        "|---|---|---|---|---|---|---|",
    ]
    rows: dict[str, list[Outcome]] = {}
    for each in outcomes:
        part = each.unit.partition(".")[0]
        rate = "velocity " if each.unit.endswith("_velocity") else ""
        hidden = "" if each.shows else " at rest by plan"
        rows.setdefault(f"{part} {rate}{each.kind}{hidden}", []).append(each)
    for name, of in sorted(rows.items()):
        delays = np.array([each.delay for each in of])
        found = delays[np.isfinite(delays)]
        times = f"{np.median(found):.2f} | {found.max():.2f}" if found.size else "- | -"
        lines.append(
            f"| {name} | {len(of)} | {found.size} | {(delays <= 1.0).sum()} | {times} | "
            f"{sum(bool(each.accused) for each in of)} |"
        )
    for each in outcomes:
        if each.accused or (each.shows and not np.isfinite(each.delay)) or each.delay < 0:
            lines.append(
                f"  {each.mission}: {each.unit} {each.kind} at {each.time:.2f} s: {each.alarms}"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
