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
        "unit that fails, such as thrusters.a_x, wheels.wheel_1, sensing.base_rotation_velocity or "
        "joints.joint_2; thrusters, wheels, sensing or joints: drawn among these; any: drawn "
        "among all units",
    )
    kind: str = unitless(
        DRAWN,
        "kind of fault: stuck_on, stuck_off, leaking or weak for a thruster; stops for a wheel; "
        "frozen, biased or silent for a sensor; jammed for a joint; any: drawn",
    )
    time: list[float] = setting(
        [0.0], "s",
            "time of the fault, which begins at the next control sample; two numbers: drawn "
            "between "
            "them",
        least=0, size=(1, 2),
    )  # fmt: skip
    size: float | None = setting(
        None,
        "1, rad, m, rad/s or m/s",
        "size of the fault. leaking: share of the thrust that leaks (null: 0.2); weak: share that "
        "is missing (null: 0.5); biased: the bias (null: 20 standard deviations of the noise, at "
        "least 0.01)",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the interval does not end before it begins."""
        if self.time != sorted(self.time):
            yield f"{key}.time", f"must not end before it begins, not {self.time}"


@dataclass
class Detection:
    """Fault detection in the flight software, and its response."""

    threshold: float = unitless(
        8.0, "residual at which a fault is detected, in standard deviations of its measured noise",
        above=0,
    )  # fmt: skip
    disturbance: PerCoordinate | None = setting(
        None,
        "N m or N",
        "largest external force on each coordinate without faults; 0 for coordinates that are not "
        "given; null: the amplitudes and biases of ``disturbance`` and the forces of the orbit",
        least=0,
    )
    band: float = setting(
        10.0,
        "rad/s",
        "highest frequency of the disturbance, used to detect thruster faults",
        above=0,
    )  # fmt: skip
    payload_factor: float = unitless(
        2.0,
            "largest factor between true and nominal mass or inertia of the held payload, in both "
            "directions", least=1,
    )  # fmt: skip
    isolation_valves: bool = unitless(
        True,
        "true: a valve closes a thruster that fails; false: the other thrusters cancel the "
        "force of "
        "a thruster that is stuck on",
    )


@dataclass
class Faults:
    """Faults of actuators, sensors and joints, and their detection."""

    events: dict[str, Fault] = unitless({}, "faults, by any name")
    detection: Detection | None = unitless(
        None, "fault detection of the flight software; null: no fault is detected"
    )
    seed: int | None = unitless(
        None, "seed of the faults that are drawn; null: ``random_seed``", least=0, most=2**31 - 1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the faulty blocks declare faults."""
        replaced = scenario.blocks.actuation is not None or "sensing" in scenario.blocks.sensing
        if self.events and replaced:
            yield (
                key,
                "needs built-in sensing and actuation; remove blocks.sensing.sensing and "
                "blocks.actuation",
            )
        if scenario.undriven:
            yield key, "needs all coordinates driven; set actuation.driven: [all]"
        late = [n for n, each in self.events.items() if max(each.time) > scenario.duration]
        for name in late:
            if not math.isinf(scenario.duration):
                end = f"is after the end of the run, {scenario.duration:g} s"
                yield f"{key}.events.{name}.time", end
