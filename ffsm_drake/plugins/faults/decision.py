"""One decision on the faulty unit, from the votes of all windows."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from ffsm_drake.plugins.actuators.thruster_faults import LEAKING, STUCK_OFF, STUCK_ON, WEAK
from ffsm_drake.plugins.faults.hypotheses import MARGIN, Vote
from ffsm_drake.plugins.faults.known import Memory

WHOLE = 0.75  # least share of a complete fault of a thruster
_EXCLUDED = 1.5 * MARGIN  # squares, summed up over time, that exclude a unit
_MOST = 1e3  # squares in one look
_APART = 20  # blocks after which a sum begins anew
_LOOKS, _TOGETHER = 3, 3  # looks that agree, at most so many blocks apart
_DOUBTS, _UNITS = 40, 3  # looks with the same units, and how many these are at most


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
      memory: ``against`` (rows, units), ``voted`` (rows), ``agreed`` (3), ``doubted`` (units + 1).
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
    if named.size == 1:
        return _agreed(votes, memory, int(named[0]), now)
    if named.size <= _UNITS:
        return _doubted(memory, all_name, named)
    return None


def _agreed(
    votes: Mapping[int, tuple[int, Vote]], memory: Memory, unit: int, now: float
) -> Found | None:
    """A single unit."""
    is_again = memory.agreed[1] == unit and now - memory.agreed[2] <= _TOGETHER
    looks = memory.agreed[0] + 1.0 if is_again else 1.0
    memory.agreed[:] = looks, unit, now
    if looks < _LOOKS:
        return None
    # windows that began before the fault see a part of it
    clearest = max((each for _, each in votes.values()), key=lambda each: float(each.share[unit]))
    whole, some = (STUCK_ON, LEAKING) if clearest.gives_more[unit] else (STUCK_OFF, WEAK)
    kind = whole if clearest.share[unit] > WHOLE else some
    return Found(units=np.array([unit]), kind=kind.name)


def _doubted(memory: Memory, all_name: np.ndarray, named: np.ndarray) -> Found | None:
    """Several units that the data cannot tell apart."""
    is_again = bool((memory.doubted[1:] == all_name).all())
    memory.doubted[0] = memory.doubted[0] + 1.0 if is_again else 1.0
    memory.doubted[1:] = all_name
    return Found(units=named) if memory.doubted[0] >= _DOUBTS else None
