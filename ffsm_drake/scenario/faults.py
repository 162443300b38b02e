"""The section ``faults``: which units fail, and when."""

import math
from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import PerCoordinate, unitless

DRAWN = "any"  # in place of a unit or a kind


@dataclass(frozen=True, kw_only=True)
class FaultKind:
    """A kind of fault of the units of a part, which declares it."""

    name: str
    effect: str  # for the documentation
    size: str = ""  # what the size of such a fault is; empty: it has none
    is_share: bool = False  # a size is at most 1
    default: float | None = None  # size of a fault without one
    at_random: bool = False  # the fault is there at a share ``size`` of the samples, at random


@dataclass
class Fault:
    """A unit of the spacecraft that fails: once or periodically, for a while or to the end."""

    unit: str = unitless(
        DRAWN,
        "unit that fails, such as thrusters.a_x, wheels.wheel_1, sensing.base_rotation_velocity or "
        "joints.joint_2; thrusters, wheels, sensing or joints: drawn among these; any: drawn "
        "among all units",
    )
    kind: str = unitless(DRAWN, "kind of fault; any: drawn among the kinds of the unit")
    time: list[float] = setting(
        [0.0], "s",
            "time of the fault, which begins at the next control sample; two numbers: drawn "
            "between "
            "them",
        least=0, size=(1, 2),
    )  # fmt: skip
    duration: float | None = setting(
        None,
        "s",
        "duration of the fault, rounded up to control samples; null: to the end of the run",
        above=0,
    )
    period: float | None = setting(
        None,
        "s",
        "time from one beginning of an intermittent fault to the next, rounded up to control "
        "samples; null: the fault begins once",
        above=0,
    )
    size: float | None = setting(
        None,
        "1, rad, m, rad/s or m/s",
        "size of a fault whose kind has one; null: the default of the kind",
        above=0,
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check that the interval does not end before it begins, and that the fault comes and goes
        in whole control samples.
        """
        if self.time != sorted(self.time):
            yield f"{key}.time", f"must not end before it begins, not {self.time}"
        if self.period is None:
            return
        step = scenario.sample_time
        if self.duration is None:
            yield f"{key}.period", f"needs a duration; set {key}.duration below {self.period:g} s"
        elif samples_of(self.duration, step) >= samples_of(self.period, step):
            problem = f"must exceed the duration, {self.duration:g} s, by a control sample"
            yield f"{key}.period", f"{problem}, not {self.period:g} s; omit it for a lasting fault"

    def in_words(self, sample_time: float) -> str:
        """A fault with a drawn unit, kind and time: what fails, how, and at which samples."""
        begin, lasts, every = (
            math.inf if given is None else sample_time * samples_of(given, sample_time)
            for given in (self.time[0], self.duration, self.period)
        )
        what = f"{self.unit}: {self.kind}"
        if math.isinf(lasts):
            return f"{what} since {begin:.2f} s"
        if math.isinf(every):
            return f"{what} from {begin:.2f} s to {begin + lasts:.2f} s"
        return f"{what} since {begin:.2f} s, for {lasts:.3g} s every {every:.3g} s"


def samples_of(duration: float, sample_time: float) -> int:
    """Control samples in a duration, rounded up."""
    return math.ceil(duration / sample_time - 1e-9)


@dataclass
class Detection:
    """Fault detection in the flight software, and its response."""

    threshold: float = unitless(
        8.0,
        "residual at which a fault of a sensor is detected, in standard deviations of its noise",
        above=0,
    )  # fmt: skip
    disturbance: PerCoordinate | None = setting(
        None,
        "N m or N",
        "largest external force on each coordinate without faults; 0 for coordinates that are not "
        "given; null: the amplitudes and biases of ``disturbance`` and the forces of the orbit",
        least=0,
    )
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
        for name, fault in self.events.items():
            if max(fault.time) > scenario.duration:
                end = f"is after the end of the run, {scenario.duration:g} s"
                yield f"{key}.events.{name}.time", end
