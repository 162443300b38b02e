"""The section ``faults``: which units fail, and when."""

import math
from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import PerCoordinate, unitless

DRAWN = "any"  # in place of a unit or a kind


@dataclass
class Fault:
    """A unit of the spacecraft that fails for the rest of the run."""

    unit: str = unitless(
        DRAWN,
        "failing unit, such as thrusters.a_x, wheels.wheel_1, sensing.base_rotation_velocity, "
        "joints.joint_2; thrusters, wheels, sensing or joints: one of that kind, drawn; any: "
        "drawn from all",
    )
    kind: str = unitless(
        DRAWN,
        "kind of fault: stuck_on, stuck_off, leaking or weak (thruster), stopped (wheel), frozen, "
        "biased or silent (sensor), jammed (joint); any: drawn",
    )
    time: list[float] = setting(
        [0.0], "s",
            "time of the fault, which begins at the next control sample; with two numbers, drawn "
            "between them",
        least=0, size=(1, 2),
    )  # fmt: skip
    size: float | None = setting(
        None,
        "1, rad, m, rad/s or m/s",
        "leaking: leaking share of the thrust (null: 0.2); weak: missing share (null: 0.5); "
        "biased: the bias (null: 20 standard deviations of the noise, at least 0.01); no effect "
        "on other kinds",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the interval does not end before it begins."""
        if self.time != sorted(self.time):
            yield f"{key}.time", f"must not end before it begins, not {self.time}"


@dataclass
class Detection:
    """Fault detection of the flight software, and its response."""

    threshold: float = unitless(
        8.0, "threshold of a residual, in standard deviations of its measured noise",
        above=0,
    )  # fmt: skip
    disturbance: PerCoordinate | None = setting(
        None,
        "N m or N",
        "largest external force on each coordinate in the absence of faults, 0 where none is "
        "given; null: amplitudes and biases of ``disturbance``, and the orbit's forces",
        least=0,
    )
    band: float = setting(
        10.0, "rad/s", "highest frequency of the disturbance, for the detection of thruster faults",
        above=0,
    )  # fmt: skip
    payload_factor: float = unitless(
        2.0,
            "largest ratio between mass or inertia of the held payload and the nominal values, "
            "either way", least=1,
    )  # fmt: skip
    isolation_valves: bool = unitless(
        True,
        "true: a valve upstream of each thruster isolates it when it fails; false: the other "
        "thrusters cancel one that is stuck on",
    )


@dataclass
class Faults:
    """Faults of actuators, sensors and joints, and their detection by the flight software."""

    events: dict[str, Fault] = unitless({}, "faults, by any names")
    detection: Detection | None = unitless(
        None, "fault detection; null: the flight software does not detect any fault"
    )
    seed: int | None = unitless(
        None, "seed of the drawn faults; null: random_seed", least=0, most=2**31 - 1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the faulty blocks declare faults."""
        replaced = scenario.blocks.actuation is not None or "sensing" in scenario.blocks.sensing
        if self.events and replaced:
            yield key, "needs the scenario's own sensing and actuation (blocks replace them)"
        if scenario.undriven:
            yield key, "needs actuators of all coordinates (actuation.driven: all)"
        late = [n for n, each in self.events.items() if max(each.time) > scenario.duration]
        for name in late:
            if not math.isinf(scenario.duration):
                yield f"{key}.events.{name}.time", f"is after the run ({scenario.duration:g} s)"
