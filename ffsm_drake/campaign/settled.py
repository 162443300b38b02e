"""The criterion for a settled run: its tracking error stays within tolerances until the end."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ffsm_drake.campaign.distributions import check_keys, number
from ffsm_drake.campaign.errors import CampaignError
from ffsm_drake.spacecraft.coordinates import GROUPS

DEFAULT_HOLD = 2.0  # s
DEFAULT_TOLERANCE = dict.fromkeys(GROUPS, 1e-3)  # rad and m


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settled:
    """Every coordinate's |e| is within its group's tolerance throughout the last ``hold`` seconds of the run."""

    hold: float  # s; 0: the last sample alone
    tolerance: Mapping[str, float]  # rad or m, by group

    def time(self, time: np.ndarray, error: np.ndarray, group_of: Sequence[str]) -> float | None:
        """The time (s) from which the error stays within the tolerances; None when the run is not settled.

        Args:
          time: control samples (n,), s.
          error: tracking error (n, nv), rad or m.
          group_of: the group of each coordinate (nv).
        """
        bound = np.array([self.tolerance[group] for group in group_of])
        outside = np.flatnonzero(~(np.abs(error) <= bound).all(axis=1))  # NaN is outside
        first = 0 if outside.size == 0 else int(outside[-1]) + 1
        if first == time.size:
            return None
        since = float(time[first])
        # Half a nanosecond: samples are multiples of the period only to rounding.
        return since if since <= max(float(time[-1]) - self.hold, 0.0) + 5e-10 else None


def parse_settled(data: Any, *, place: str) -> Settled:
    """The criterion of a specification. Raises CampaignError for an unknown key or a value out of range."""
    if not isinstance(data, Mapping):
        raise CampaignError(f"{place}: must be a mapping with hold and tolerance")
    check_keys(data, ("hold", "tolerance"), place=place)
    hold = number(data.get("hold", DEFAULT_HOLD), place=f"{place}.hold")
    if hold < 0.0:
        raise CampaignError(f"{place}.hold: must be >= 0 s, not {hold:g}")
    given = data.get("tolerance", {})
    if not isinstance(given, Mapping):
        raise CampaignError(f"{place}.tolerance: must be a mapping by group: {', '.join(GROUPS)}")
    check_keys(given, GROUPS, place=f"{place}.tolerance")
    tolerance = DEFAULT_TOLERANCE | {
        group: number(value, place=f"{place}.tolerance.{group}") for group, value in given.items()
    }
    for group, value in tolerance.items():
        if value <= 0.0:
            raise CampaignError(f"{place}.tolerance.{group}: must be > 0, not {value:g}")
    return Settled(hold=hold, tolerance=tolerance)
