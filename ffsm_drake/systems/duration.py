"""The shortest duration in which a planned motion keeps the limits, with the nominal payload."""

import bisect
import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from ffsm_drake.common.errors import LimitError, ScenarioError
from ffsm_drake.common.numbers import number
from ffsm_drake.mission import Mission
from ffsm_drake.spacecraft.limits import FORCE, POSITION, RATE, Limit
from ffsm_drake.spacecraft.nominal import PlantModel
from ffsm_drake.systems.mission_limits import limits_of

if TYPE_CHECKING:
    from ffsm_drake.systems.planned_motion import PlannedMotion

_LONGEST = 1000.0  # s
_GROWTH = 1.15  # ratio of successive trial durations
_INSTANTS = 101  # samples of a motion, or of the part that an input shaper copies
# first trial duration, as a multiple of the input shaper's part
_LEAST_SHAPED = 1.05


def shortest_duration(
    mission: Mission, motion_in: Callable[[float], "PlannedMotion"], *, shaped_by: float = 0.0
) -> float:
    """Return the shortest duration, in s and whole control samples, of a motion within every limit.

    The limits are forces (actuators and URDFs), joint velocities (URDFs and drives) and wrenches of
    contacts, less ``reference.reserve``, and the URDFs' joint positions. The force comes from
    inverse dynamics with the nominal payload.

    Args:
      motion_in: duration, s -> the motion.
      shaped_by: duration, s, added by an input shaper.

    Raises:
      ScenarioError: there are no limits.
      LimitError: no duration keeps all limits; the error names the violated one.
    """
    scenario = mission.scenario
    key, free = "reference.duration", 1.0 - scenario.reference.reserve
    model, limits = mission.craft.nominal(), limits_of(mission)
    if not any(np.isfinite(each.upper).any() for each in limits if each.quantity in (FORCE, RATE)):
        raise ScenarioError(
            key,
            "auto needs a limit of force or velocity: give actuation.limit, actuators that have "
            "one, or a number of seconds",
        )
    worst = _worst_of(model, motion_in, limits, free=free, shaped_by=shaped_by)
    sample_time, least = scenario.sample_time, (math.inf, "", 0.0)
    before = samples = math.floor(_LEAST_SHAPED * shaped_by / sample_time) + 1
    while samples * sample_time <= _LONGEST:
        share, name = worst(samples * sample_time)
        if share <= 1.0:
            break
        least = min(least, (share, name, samples * sample_time))
        before, samples = samples, max(samples + 1, math.ceil(_GROWTH * samples))
    else:
        share, name, duration = least
        raise LimitError(
            key,
            f"auto: no duration up to {_LONGEST:g} s keeps the limits; nearest is {duration:.3g} "
            f"s, where the {name} takes {number(100.0 * share, 3)} % of its limit within "
            "reference.reserve",
            limit=name,
        )
    between = range(before + 1, samples)  # the last too short and the first sufficient one
    found = bisect.bisect(between, 0, key=lambda n: worst(n * sample_time)[0] <= 1.0)
    return (before + 1 + found) * sample_time


def _worst_of(
    model: PlantModel,
    motion_in: Callable[[float], "PlannedMotion"],
    limits: Iterable[Limit],
    *,
    free: float,
    shaped_by: float,
) -> Callable[[float], tuple[float, str]]:
    """Duration, s -> the largest fraction of a limit used by its motion, and that limit's name; the
    share ``free`` of forces and rates is usable.
    """
    usable = [
        each
        if each.quantity == POSITION
        else dataclasses.replace(each, upper=free * each.upper, lower=free * each.lower)
        for each in limits
    ]

    def worst(duration: float) -> tuple[float, str]:
        motion = motion_in(duration)
        instants = math.ceil(_INSTANTS * duration / (duration - shaped_by))
        found = motion.demand(model, motion.instants(instants))
        shares = list[tuple[float, str]]()
        for limit in usable:
            if limit.quantity in found:
                most = limit.used(found[limit.quantity]).max(axis=0)
                shares.append((float(most.max()), limit.told(int(most.argmax()))))
        return max(shares)

    return worst
