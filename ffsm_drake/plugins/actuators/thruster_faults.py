"""Faults of thrusters, and what they do to the force."""

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from ffsm_drake.scenario import FaultKind
from ffsm_drake.systems.faults import Hit


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThrusterFault(FaultKind):
    """A kind of fault of a thruster."""

    is_open: bool  # it gives at least the share ``size`` of its force; else this share is missing


STUCK_ON = ThrusterFault(name="stuck_on", effect="full thrust", is_open=True, default=1.0)
LEAKING = ThrusterFault(
    name="leaking",
    effect="at least the share `size` of the full thrust",
    size="share of the thrust that leaks",
    is_share=True,
    default=0.2,
    is_open=True,
)
STUCK_OFF = ThrusterFault(name="stuck_off", effect="no thrust", is_open=False, default=1.0)
WEAK = ThrusterFault(
    name="weak",
    effect="the share `size` of the thrust is missing",
    size="share of the thrust that is missing",
    is_share=True,
    default=0.5,
    is_open=False,
)
THRUSTER_FAULTS = (STUCK_ON, STUCK_OFF, LEAKING, WEAK)


def gains_and_floors(names: Sequence[str], faults: Iterable[Hit]) -> tuple[np.ndarray, np.ndarray]:
    """Effect of faults on thrusters: the factor on the force, and the least share of it; (n)
    each.
    """
    gain, floor = np.ones(len(names)), np.zeros(len(names))
    for unit, kind, size, _ in faults:
        at = names.index(unit)
        if kind.is_open:
            floor[at] = size
        else:
            gain[at] = 1.0 - size
    return gain, floor
