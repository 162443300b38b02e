"""Which user-supplied block a run failed in."""

import dataclasses
from collections.abc import Iterator, Mapping

import numpy as np
from pydrake.systems.framework import Diagram, System

from ffsm_drake.common.errors import BlockError
from ffsm_drake.common.guard import failure
from ffsm_drake.loop.blocks import kind_of
from ffsm_drake.loop.closed_loop import ClosedLoop
from ffsm_drake.runs.monitor import Monitor

# Signals of each kind of block, and whether they are states [q; v].
_OUTPUTS = {
    "reference": {"desired_state": True, "desired_acceleration": False},
    "sensing": {"measurement": True},
    "actuation": {"applied_force": False},
    "forces": {"disturbance_force": False},  # or its own
}
_UNIT = 0.1  # a quaternion's norm may differ from 1 by this


@dataclasses.dataclass(frozen=True, kw_only=True)
class BadOutput:
    """What a user-supplied block gave at a control sample that cannot be used."""

    sample: int
    problem: str


def failure_of(
    error: BaseException, loop: ClosedLoop, suspects: Mapping[str, str], time: float
) -> BlockError:
    """The error that names the block in which an exception arose at a time, s.

    Args:
      error: the exception.
      loop: the closed loop that ran.
      suspects: its user-supplied blocks, in words by name.
      time: s.
    """
    systems = {id(system): name for name in suspects for system in _systems(loop.blocks.get(name))}
    found, place = None, error.__traceback__
    while place is not None:
        first = place.tb_frame.f_code.co_varnames[:1]
        owner = place.tb_frame.f_locals.get(first[0]) if first else None
        found = systems.get(id(owner), found)
        place = place.tb_next
    return failure(error, suspects[found] if found else " or ".join(suspects.values()), time)


def _systems(block: System | None) -> Iterator[System]:
    """A block's system, and those within it."""
    if block is not None:
        yield block
    if isinstance(block, Diagram):
        for part in block.GetSystems():
            yield from _systems(part)


def bad_output(
    monitor: Monitor, series: Mapping[str, np.ndarray], suspects: Mapping[str, str]
) -> BadOutput | None:
    """The first output of a user-supplied block, other than the controller, that cannot be used
    though the state is within bounds; None: there is none.

    Args:
      monitor: knows the bounds.
      series: the signals at the control samples.
      suspects: as for ``failure_of``.
    """
    sound, found = monitor.bounded(series["state"]), []
    for name, block in suspects.items():
        kind, own = kind_of(name), f"force_{name.partition('.')[2]}"
        for signal, is_state in _OUTPUTS.get(kind, {}).items():
            values = series.get(own, series[signal])
            finite = np.isfinite(values).all(axis=1)
            norm = np.linalg.norm(values[:, :4], axis=1) if is_state else np.ones(len(values))
            right = finite & (np.abs(norm - 1.0) <= _UNIT)
            if kind == "actuation":  # of a force that is finite
                right |= ~np.isfinite(series["generalized_force"]).all(axis=1)
            bad = np.flatnonzero(sound & ~right)
            if bad.size:
                k = int(bad[0])
                what = f"has a quaternion of norm {norm[k]:.3g}" if finite[k] else "is not finite"
                wanted = "finite, [q; v] with a unit quaternion" if is_state else "finite"
                problem = f"{block}: its {signal} {what}; it must be {wanted}"
                found.append(BadOutput(sample=k, problem=problem))
    return min(found, key=lambda each: each.sample, default=None)
