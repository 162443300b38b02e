"""The section ``supervisor``: when the loop abandons its plan, and its response."""

from dataclasses import dataclass
from typing import Any

from ffsm_drake.common.settings import Problems, setting
from ffsm_drake.scenario.fields import PerCoordinate, unitless

_STEP = 0.5  # largest product of damping and sample time; see the page on the supervisor


@dataclass
class Supervisor:
    """Rate damping, then a new plan or a retreat, if the plan cannot be followed."""

    saturated_time: float = setting(
        0.5,
        "s",
        "damping begins when a saturation timer exceeds this. The timer counts up while a command "
        "is beyond a limit, and down to 0 otherwise.",
        above=0,
    )
    error: PerCoordinate | None = setting(
        None, "rad or m", "measured error above which damping begins; null: no limit", above=0
    )
    rate: PerCoordinate | None = setting(
        None,
        "rad/s or m/s",
        "rate of a measured error above which damping begins; null: no limit",
        above=0,
    )
    damping: float = setting(
        2.0, "1/s", "rate kappa of the damping force tau = -sigma kappa Hhat v", above=0
    )
    filter_time: float = setting(
        0.5,
        "s",
        "time constant of the low-pass filter of the damping force, for the end of damping",
        above=0,
    )
    end_share: float = unitless(
        0.1,
        "share of every force limit within which the filtered damping force must stay at the end "
        "of damping; it must be larger than the disturbance as a share of the limit",
        above=0,
        most=1,
    )
    end_time: float = setting(
        0.3,
        "s",
        "damping ends when the filtered damping force has stayed within ``end_share`` of every "
        "limit for this time",
        above=0,
    )
    plan_share: float = unitless(
        0.4, "largest share of every force limit that a new plan uses", above=0, most=1
    )
    retry_factor: float = unitless(
        0.8, "factor on ``plan_share`` for each further plan of a run", above=0, most=1
    )
    tries: int = setting(
        3, "1", "largest number of times that a hand with ``contacts.NAME.closes`` closes", least=1
    )

    def check(self, key: str, scenario: Any) -> Problems:
        """Check for a loop that can be damped and planned for."""
        if self.damping * scenario.sample_time > _STEP:
            most = _STEP / scenario.sample_time
            yield f"{key}.damping", f"must be at most {most:g} 1/s at this sample_time"
