"""Faults: the possible ones, declared by the spacecraft's parts, and those of a run."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from ffsm_drake.common.errors import ScenarioError, did_you_mean
from ffsm_drake.scenario import Fault, Scenario
from ffsm_drake.scenario.faults import DRAWN
from ffsm_drake.systems.parts.part import Part

Known = Mapping[str, Sequence[str]]  # unit, such as "thrusters.a_x" -> the kinds of its faults


def settled(scenario: Scenario, known: Known) -> Scenario:
    """Return the scenario with every unit, kind and time of its faults drawn.

    Raises ScenarioError: nothing of a name can break, or not so.
    """
    if scenario.faults is None:
        return scenario
    seed = scenario.random_seed if scenario.faults.seed is None else scenario.faults.seed
    events = {}
    for index, (name, fault) in enumerate(scenario.faults.events.items()):
        generator = np.random.default_rng([seed, index])
        events[name] = _settled(fault, known, generator, f"faults.events.{name}")
    faults = dataclasses.replace(scenario.faults, events=events)
    return dataclasses.replace(scenario, faults=faults)


def _settled(fault: Fault, known: Known, generator: np.random.Generator, key: str) -> Fault:
    """Draw the open choices of a fault evenly: first parts, then their kinds, then units."""
    share = generator.random(4)

    def drawn(among: Sequence[str], at: int) -> str:
        return among[int(share[at] * len(among))]

    units = [unit for unit in known if fault.unit in (DRAWN, unit, unit.partition(".")[0])]
    if not units:
        choice = ", ".join(known) or "none"
        problem = f"no '{fault.unit}' breaks here; there are: {choice}"
        raise ScenarioError(f"{key}.unit", problem + did_you_mean(fault.unit, known))
    units = [unit for unit in units if fault.kind == DRAWN or fault.kind in known[unit]]
    if not units:
        raise ScenarioError(f"{key}.kind", f"'{fault.kind}' is no fault of {fault.unit}")
    part = drawn(list(dict.fromkeys(unit.partition(".")[0] for unit in units)), 0)
    units = [unit for unit in units if unit.startswith(f"{part}.")]
    kinds = {kind: None for unit in units for kind in known[unit]}
    kind = drawn(list(kinds), 1) if fault.kind == DRAWN else fault.kind
    unit = drawn([unit for unit in units if kind in known[unit]], 2)
    time = fault.time[0] + float(share[3]) * (fault.time[-1] - fault.time[0])
    return dataclasses.replace(fault, unit=unit, kind=kind, time=[time])


def hits(scenario: Scenario, part: str) -> list[tuple[str, Fault]]:
    """Unit, without the part's name, and fault of all that hit a part of a settled scenario."""
    events = [] if scenario.faults is None else scenario.faults.events.values()
    each = ((*fault.unit.partition(".")[::2], fault) for fault in events)
    return [(unit, fault) for of, unit, fault in each if of == part]


def detects(scenario: Scenario) -> bool:
    """Whether the flight software looks for faults."""
    return scenario.faults is not None and scenario.faults.detection is not None


def first_sample(fault: Fault, sample_time: float) -> int:
    """First control sample with a fault."""
    return math.ceil(fault.time[0] / sample_time - 1e-9)


class BreakingPart(Part):
    """Base class of parts whose system is affected by faults."""

    hit_as: ClassVar[str]  # before the point of a unit's name

    @classmethod
    def of(cls, scenario: Scenario) -> "BreakingPart | None":
        """None if all work."""
        return cls() if hits(scenario, cls.hit_as) else None
