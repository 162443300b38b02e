"""The section ``supervisor``: when the loop abandons its plan, and its response."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import PerCoordinate, unitless

_STEP = 0.5  # largest product of damping and sample time; see the page on the supervisor


@dataclass
class Supervisor:
    """Rate damping, replanning or a retreat if the plan cannot be followed."""

    saturated_time: float = setting(
        0.5,
        "s",
        "damping begins when the time with a command beyond a limit, less the time without, "
        "exceeds this",
        above=0,
    )
    error: PerCoordinate | None = setting(
        None, "rad or m", "damping begins when a measured error exceeds this; null: never", above=0
    )
    rate: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "damping begins when the rate of a measured error exceeds this; null: never",
        above=0,
    )
    damping: float = setting(2.0, "1/s", "kappa of tau = -sigma kappa Hhat v", above=0)
    filter_time: float = setting(
        0.5, "s", "time constant of the low-pass filter for the end of damping", above=0
    )
    end_share: float = unitless(
        0.1,
        "damping ends when the filtered kappa Hhat v stays within this share of every limit; must "
        "exceed the disturbance's share",
        above=0,
        most=1,
    )
    end_time: float = setting(0.3, "s", "for so long", above=0)
    plan_share: float = unitless(
        0.4, "largest share of every limit that the new plan uses", above=0, most=1
    )
    retry_factor: float = unitless(
        0.8, "factor on plan_share at each further plan of a run", above=0, most=1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for a loop that can be damped and planned for."""
        if self.damping * scenario.sample_time > _STEP:
            most = _STEP / scenario.sample_time
            yield f"{key}.damping", f"must be at most {most:g} 1/s at this sample_time"
        if scenario.undriven:
            yield key, "needs actuators of all coordinates (actuation.driven: all)"
        if scenario.reference.frame is not None:
            yield key, "plans postures, and cannot go with reference.frame"
