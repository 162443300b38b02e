"""Faults: the possible ones, declared by the spacecraft's parts, and those of a run."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ffsm_drake.common.errors import ScenarioError, choices
from ffsm_drake.scenario import Fault, FaultKind, Scenario
from ffsm_drake.scenario.faults import DRAWN, samples_of
from ffsm_drake.spacecraft.coordinates import Coordinates
from ffsm_drake.systems.parts.part import Part
from ffsm_drake.systems.registry import section_kinds

FOREVER = 2**53  # control samples
_DRAWN_AT_ONCE = 4096  # samples whose random numbers are drawn together
Known = Mapping[str, Mapping[str, FaultKind]]  # unit, such as "thrusters.a_x" -> its kinds


def fault_kinds() -> dict[str, dict[str, FaultKind]]:
    """Return the kinds of faults that the installed parts declare, by part and name."""
    return {
        each.fails_as: {kind.name: kind for kind in each.fault_kinds}
        for each in section_kinds()
        if each.fault_kinds
    }


def kind_names() -> list[str]:
    """Return the values of ``kind`` of a fault."""
    return [*dict.fromkeys(name for kinds in fault_kinds().values() for name in kinds), DRAWN]


def settle_faults(scenario: Scenario, coordinates: Coordinates) -> Scenario:
    """Return the scenario with every unit, kind and time of its faults drawn.

    Raises ScenarioError: nothing of a name can break, or not so.
    """
    if scenario.faults is None:
        return scenario
    known = {
        f"{each.fails_as}.{unit}": {kind.name: kind for kind in each.fault_kinds}
        for each in section_kinds()
        for unit in each.failing_units(scenario, coordinates)
    }
    events = {
        name: _settled(fault, known, _seed(scenario, index), f"faults.events.{name}")
        for index, (name, fault) in enumerate(scenario.faults.events.items())
    }
    faults = dataclasses.replace(scenario.faults, events=events)
    return dataclasses.replace(scenario, faults=faults)


def faults_in_words(scenario: Scenario, coordinates: Coordinates) -> Iterator[str]:
    """The faults of a scenario, with the seed that draws their units, kinds or times."""
    given, settled = scenario.faults, settle_faults(scenario, coordinates).faults
    if given is None or settled is None:
        return
    for index, (name, fault) in enumerate(settled.events.items()):
        drawn = f", drawn with seed {_seed(scenario, index)[0]}" * (fault != given.events[name])
        yield f"fault {name}: {fault.in_words(scenario.sample_time)}{drawn}"


def _seed(scenario: Scenario, index: int) -> tuple[int, ...]:
    """Seed of the draws of a fault, by its place among the events."""
    assert scenario.faults is not None
    seed = scenario.faults.seed
    return scenario.random_seed if seed is None else seed, index


def _settled(fault: Fault, known: Known, seed: Sequence[int], key: str) -> Fault:
    """Draw the open choices of a fault evenly: first parts, then their kinds, then units."""
    share = np.random.default_rng(seed).random(4)

    def drawn(among: Iterable[str], at: int) -> str:
        each = list(among)
        return each[int(share[at] * len(each))]

    units = [unit for unit in known if fault.unit in (DRAWN, unit, unit.partition(".")[0])]
    if not units:
        fitting = [unit for unit in known if fault.kind in known[unit]] or known
        problem = f"no '{fault.unit}' breaks here; choose one of {choices(fault.unit, fitting)}"
        raise ScenarioError(f"{key}.unit", problem)
    possible = {kind: None for unit in units for kind in known[unit]}
    units = [unit for unit in units if fault.kind == DRAWN or fault.kind in known[unit]]
    if not units:
        among = choices(fault.kind, [*possible, DRAWN])
        problem = f"'{fault.kind}' is no fault of {fault.unit}; choose one of {among}"
        raise ScenarioError(f"{key}.kind", problem)
    part = drawn(dict.fromkeys(unit.partition(".")[0] for unit in units), 0)
    units = [unit for unit in units if unit.startswith(f"{part}.")]
    kinds = {name: kind for unit in units for name, kind in known[unit].items()}
    name = drawn(kinds, 1) if fault.kind == DRAWN else fault.kind
    unit = drawn((unit for unit in units if name in known[unit]), 2)
    time = fault.time[0] + float(share[3]) * (fault.time[-1] - fault.time[0])
    size = _size(fault, kinds[name], f"{key}.size")
    return dataclasses.replace(fault, unit=unit, kind=name, time=[time], size=size)


def _size(fault: Fault, kind: FaultKind, key: str) -> float | None:
    """The size of a fault. Raises ScenarioError: its kind, if given, cannot have this size."""
    size = fault.size
    if size is None:
        return None
    if fault.kind == DRAWN:
        fits = bool(kind.size)
        return (min(size, 1.0) if kind.is_share else size) if fits else None
    if not kind.size:
        raise ScenarioError(key, f"'{kind.name}' has no size; omit it")
    if kind.is_share and size > 1.0:
        raise ScenarioError(key, f"must be a share from 0 to 1, not {size:g}")
    return size


@dataclasses.dataclass(frozen=True, kw_only=True)
class Occurrence:
    """When a fault is there: functions of the control sample, of one or of many."""

    first: int  # control sample at which it begins
    samples: int  # for how many
    period: int  # samples from one beginning to the next
    share: float = 1.0  # of these samples, drawn at random
    seed: tuple[int, ...] = ()

    @classmethod
    def of(cls, fault: Fault, sample_time: float, **random: Any) -> "Occurrence":
        """Return the control samples of a fault whose time is drawn."""
        given = fault.duration, fault.period
        samples, period = (FOREVER if t is None else samples_of(t, sample_time) for t in given)
        first = samples_of(fault.time[0], sample_time)
        return cls(first=first, samples=samples, period=period, **random)

    def at(self, sample: Any) -> Any:
        """Whether the fault is there."""
        is_there = (sample >= self.first) & ((sample - self.first) % self.period < self.samples)
        if self.share < 1.0:
            is_there = is_there & (_draws(self.seed, sample) < self.share)
        return is_there


def _draws(seed: tuple[int, ...], sample: Any) -> Any:
    """Random numbers from 0 to 1 of control samples."""
    if np.ndim(sample) == 0:
        return _block(seed, sample // _DRAWN_AT_ONCE)[sample % _DRAWN_AT_ONCE]
    blocks = range(int(np.max(sample, initial=0)) // _DRAWN_AT_ONCE + 1)
    return np.concatenate([_block(seed, block) for block in blocks])[sample]


@functools.lru_cache(maxsize=256)
def _block(seed: tuple[int, ...], block: int) -> np.ndarray:
    # beside the draws of units, kinds and times, which have a seed of two numbers
    return np.random.default_rng([*seed, block + 1]).random(_DRAWN_AT_ONCE)


class Hit(NamedTuple):
    """A fault of a unit, in a run."""

    unit: str  # without the part's name
    kind: Any  # FaultKind, as its part declares it
    size: Any  # a number; None: the kind has none, or an own default
    occurs: Occurrence


def hits(scenario: Scenario, part: str) -> list[Hit]:
    """Return the faults of a part of a settled scenario."""
    found, kinds = list[Hit](), fault_kinds()
    events = {} if scenario.faults is None else scenario.faults.events
    for index, fault in enumerate(events.values()):
        of, _, unit = fault.unit.partition(".")
        if of == part:
            kind = kinds[part][fault.kind]
            size = kind.default if fault.size is None else fault.size
            random = {"share": size, "seed": _seed(scenario, index)} if kind.at_random else {}
            occurs = Occurrence.of(fault, scenario.sample_time, **random)
            found.append(Hit(unit, kind, size, occurs))
    return found


def detects(scenario: Scenario) -> bool:
    """Whether the flight software looks for faults."""
    return scenario.faults is not None and scenario.faults.detection is not None


class BreakingPart(Part):
    """Base class of parts whose system is affected by faults."""

    @classmethod
    def of(cls, scenario: Scenario) -> "BreakingPart | None":
        """None if all work."""
        events = () if scenario.faults is None else scenario.faults.events.values()
        breaks = any(fault.unit.partition(".")[0] == cls.fails_as for fault in events)
        return cls() if breaks else None
