"""One decision on the faulty unit, from the votes of all windows."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.plugins.actuators.thruster_faults import LEAKING, STUCK_OFF, STUCK_ON, WEAK
from ffsm_drake.plugins.faults.hypotheses import MARGIN, Vote
from ffsm_drake.plugins.faults.memory import Memory

WHOLE = 0.75  # least share of a complete fault of a thruster
_EXCLUDED = 1.5 * MARGIN  # squares, summed up over time, that exclude a unit
_MOST = 1e3  # squares in one look
_APART = 20  # blocks after which a sum begins anew
_LOOKS, _TOGETHER = 3, 3  # looks that agree, at most so many blocks apart
_DOUBTS, _UNITS = 40, 3  # looks that all name some units, and how many these are at most


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """Units of which one is faulty."""

    units: np.ndarray  # indices: joints, then thrusters
    kind: str = ""  # of a thruster


def decided(
    votes: Mapping[int, tuple[int, Vote]], memory: Memory, is_possible: np.ndarray, now: float
) -> Found | None:
    """The units that all windows name, if they have done so for long enough.

    Args:
      votes: row of ``memory.against`` -> blocks of its window, and its vote.
      memory: ``against`` (rows, units), ``voted`` (rows), ``agreed`` (3), ``doubted`` (units + 2).
      is_possible: (units); not a joint that moves.
      now: blocks since the start.
    """
    sets = list[np.ndarray]()
    for row, (window, each) in votes.items():
        since, memory.voted[row] = now - memory.voted[row], now
        if since > _APART:
            memory.against[row] = 0.0
        memory.against[row] += np.minimum(each.worse, _MOST) * min(since, window) / window
        excluded = memory.against[row] - memory.against[row].min() > _EXCLUDED
        near = each.worse < MARGIN
        if not excluded[each.best]:
            near &= ~excluded
        near &= is_possible | (np.arange(near.size) == each.best)
        sets.append(near)
    if not sets:
        return None
    all_name = np.logical_and.reduce(sets)
    named = np.flatnonzero(all_name)
    if not is_possible[named].all() or not named.size:
        return None
    units = named if _agree(memory, named, now) else _common(memory, all_name, now)
    if not 0 < units.size <= _UNITS:
        return None
    return Found(units=units, kind=_kind(votes, int(units[0])))


def _kind(votes: Mapping[int, tuple[int, Vote]], unit: int) -> str:
    """Of a thruster's fault."""
    # windows that began before the fault see a part of it
    clearest = max((each for _, each in votes.values()), key=lambda each: float(each.share[unit]))
    whole, some = (STUCK_ON, LEAKING) if clearest.gives_more[unit] else (STUCK_OFF, WEAK)
    return (whole if clearest.share[unit] > WHOLE else some).name


def _agree(memory: Memory, named: np.ndarray, now: float) -> bool:
    """Whether looks name the same single unit."""
    if named.size > 1:
        return False
    is_again = memory.agreed[1] == named[0] and now - memory.agreed[2] <= _TOGETHER
    memory.agreed[:] = memory.agreed[0] + 1.0 if is_again else 1.0, named[0], now
    return bool(memory.agreed[0] >= _LOOKS)


def _common(memory: Memory, all_name: np.ndarray, now: float) -> np.ndarray:
    """The units that many looks have named, if there are enough looks; else none."""
    both = all_name & (memory.doubted[2:] > 0.0)
    is_again = now - memory.doubted[1] <= _APART and both.any()
    looks = memory.doubted[0] + 1.0 if is_again else 1.0
    memory.doubted[:2], memory.doubted[2:] = (looks, now), both if is_again else all_name
    return np.flatnonzero(memory.doubted[2:] * (looks >= _DOUBTS))
