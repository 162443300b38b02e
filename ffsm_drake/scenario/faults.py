"""The section ``faults``: what breaks when."""

import math
from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import PerCoordinate, unitless

DRAWN = "any"  # in place of a unit or a kind


@dataclass
class Fault:
    """A unit of the spacecraft that breaks, for the rest of the run."""

    unit: str = unitless(
        DRAWN,
        "what breaks, such as thrusters.a_x, wheels.wheel_1, sensing.base_rotation_velocity, "
        "joints.joint_2; thrusters, wheels, sensing or joints: one of them, drawn; any: any",
    )
    kind: str = unitless(
        DRAWN,
        "how: a thruster is stuck_on, stuck_off, leaking or weak, a wheel stops, a sensor is "
        "frozen, biased or silent, a joint is jammed; any: drawn",
    )
    time: list[float] = setting(
        [0.0], "s", "when, from the next control sample on; of two numbers drawn between them",
        least=0, size=(1, 2),
    )  # fmt: skip
    size: float | None = setting(
        None,
        "1, rad, m, rad/s or m/s",
        "leaking: share of the thruster's force that leaks (null: 0.2); weak: share that is "
        "missing (null: 0.5); biased: the bias (null: 20 standard deviations of its noise, at "
        "least 0.01); without effect on other kinds",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """An interval that does not end before it begins."""
        if self.time != sorted(self.time):
            yield f"{key}.time", f"must not end before it begins, not {self.time}"


@dataclass
class Detection:
    """How the flight software looks for faults, and what it does."""

    threshold: float = unitless(
        8.0, "standard deviations of its noise, as measured, beyond which a residual is a fault",
        above=0,
    )  # fmt: skip
    disturbance: PerCoordinate | None = setting(
        None,
        "N m or N",
        "largest external force on each coordinate that is no fault, 0 where none is given; null: "
        "amplitudes and biases of ``disturbance``, and the orbit's forces",
        least=0,
    )
    band: float = setting(
        10.0, "rad/s", "highest frequency of the disturbance, in the search for broken thrusters",
        above=0,
    )  # fmt: skip
    payload_factor: float = unitless(
        2.0, "mass and inertia of the held payload are at most this many times the nominal ones, "
        "and at least as small a part of them", least=1,
    )  # fmt: skip
    isolation_valves: bool = unitless(
        True,
        "each thruster has a valve upstream, which is shut when it fails; without, the others "
        "cancel one that is stuck on",
    )


@dataclass
class Faults:
    """Faults of actuators, sensors and joints, and whether the flight software looks for them."""

    events: dict[str, Fault] = unitless({}, "faults, by any names")
    detection: Detection | None = unitless(
        None, "null: the flight software does not know of any fault"
    )
    seed: int | None = unitless(
        None, "of what is drawn; null: random_seed", least=0, most=2**31 - 1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Blocks whose parts have faults."""
        replaced = scenario.blocks.actuation is not None or "sensing" in scenario.blocks.sensing
        if self.events and replaced:
            yield key, "needs the scenario's own sensing and actuation (blocks replace them)"
        if scenario.undriven:
            yield key, "needs actuators of all coordinates (actuation.driven: all)"
        late = [n for n, each in self.events.items() if max(each.time) > scenario.duration]
        for name in late:
            if not math.isinf(scenario.duration):
                yield f"{key}.events.{name}.time", f"is after the run ({scenario.duration:g} s)"
