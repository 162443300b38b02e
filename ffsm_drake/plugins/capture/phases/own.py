"""Phases before an approach (``phases``, ``blocks.phases``)."""

import dataclasses
import functools
import re

import numpy as np

from ffsm_drake.common.errors import BlockError, ScenarioError
from ffsm_drake.common.guard import calling
from ffsm_drake.mission import Mission, planned
from ffsm_drake.plugins.capture.displacement import Joined
from ffsm_drake.plugins.capture.floating import before
from ffsm_drake.runs.phases import Phase
from ffsm_drake.scenario import EMPTY, Scenario
from ffsm_drake.systems.planned_motion import InTurn, PlannedMotion
from ffsm_drake.systems.registry import call_factory, find_factory
from ffsm_drake.systems.setup import BlockSetup

_OF_A_CAPTURE = re.compile(r"(approach|closing|retreat)(_\d+)?|stop")
_INSTANTS = 100  # instants of a motion, checked
_JUMP = 1e-6  # rad, m, and per s; a motion may miss the begin of the next by this


class _Rest(PlannedMotion):
    """Rest where another motion begins."""

    def __init__(self, then: PlannedMotion, *, duration: float, sample_time: float) -> None:
        self._row = np.zeros_like(then.row(0.0))
        places = len(then.coordinates.position_names)
        self._row[:places] = then.row(0.0)[:places]
        super().__init__(coordinates=then.coordinates, sample_time=sample_time, end=duration)

    def rows(self, times: np.ndarray) -> np.ndarray:
        return np.tile(self._row, (times.size, 1))


@planned
def phases_before(mission: Mission) -> dict[str, Phase]:
    """The phases of a mission before its approach, by name, as their factories return them.

    Raises ScenarioError or BlockError: a factory is unknown, fails, or returns something else.
    """
    scenario, found = mission.scenario, dict[str, Phase]()
    for name, given in scenario.blocks.phases.items():
        key = _key(scenario, name)
        if _OF_A_CAPTURE.fullmatch(name):
            raise ScenarioError(key, f"'{name}' is a phase of every capture; rename it")
        factory = find_factory("phases", given.system, key=key, python_path=scenario.python_path)
        nominal = mission.craft.nominal(EMPTY)
        setup = BlockSetup(name=name, mission=mission, nominal=nominal, settings=given.settings)
        phase = call_factory(factory, setup, place=f"{key} '{given.system}'")
        if not isinstance(phase, Phase):
            raise BlockError(f"{key} '{given.system}' must be a Phase, not {type(phase).__name__}")
        plain = Phase(motion=phase.motion, blocks=phase.blocks, joins=phase.joins)
        for field in dataclasses.fields(Phase):
            if getattr(phase, field.name) is not getattr(plain, field.name):
                raise BlockError(f"{key}: its {field.name} follows from its place; leave that out")
        if "reference" in phase.blocks:
            raise BlockError(f"{key}: give its motion in place of a block 'reference'")
        if phase.joins and scenario.undriven:
            problem = "moves the base, on which no force acts; remove it, or set actuation.driven:"
            raise ScenarioError(key, f"{problem} [all]")
        if phase.joins and scenario.approach is not None and scenario.approach.start == "clear":
            problem = f"must be given, because the approach begins where {key} ends"
            raise ScenarioError("capture.approach.start", problem)
        found[name] = phase
    return found


def with_phases(mission: Mission, approach: PlannedMotion) -> PlannedMotion:
    """An approach with the motions of the phases before it. Undriven coordinates keep the momentum
    of the approach. Raises the errors of ``phases_before``, and BlockError for a motion that does
    not end where the next begins.
    """
    found, scenario = phases_before(mission), mission.scenario
    period, begin = scenario.sample_time, scenario.grasp_time
    begin -= approach.end
    motions = [(begin, approach)]
    for name, phase in reversed(found.items()):
        lasts, then = scenario.blocks.phases[name].duration, motions[0][1]
        motion = phase.motion or _Rest(then, duration=lasts, sample_time=period)
        key = _key(scenario, name)
        if phase.joins and then is not approach:
            raise BlockError(f"{key}: must be the last one before the approach")
        if phase.joins:
            then = Joined(approach, motion.row(lasts), sample_time=period)
            motions[0] = begin, then
        if scenario.undriven:
            led = functools.partial(before, motion, then.row(0.0), mission, duration=lasts)
            motion = calling(f"{key}: its motion", led)
        _check(key, motion, lasts, then)
        begin -= lasts
        motions.insert(0, (begin, motion))
    return InTurn(motions, begin=0.0, end=scenario.grasp_time, sample_time=period)


def _key(scenario: Scenario, name: str) -> str:
    return f"{'phases' if scenario.phases else 'blocks.phases'}.{name}"


def _check(key: str, motion: PlannedMotion, lasts: float, then: PlannedMotion) -> None:
    """Raise BlockError for a motion that fails, or does not lead to where another begins."""
    names, first = then.coordinates, then.row(0.0)
    times = np.linspace(0.0, lasts, _INSTANTS)
    rows = calling(f"{key}: its motion", lambda: np.asarray(motion.rows(times)))
    if rows.shape != (times.size, first.size):
        wanted = f"({times.size}, {first.size}) at {times.size} times"
        raise BlockError(f"{key}: its motion must have rows {wanted}, not {rows.shape}")
    places = len(names.position_names)
    turned = np.abs(np.linalg.norm(rows[:, :4], axis=1) - 1.0) > _JUMP
    if (bad := turned | ~np.isfinite(rows).all(axis=1)).any():
        raise BlockError(
            f"{key}: its motion must be finite, with unit quaternions, and is not at "
            f"{times[bad.argmax()]:.3g} s"
        )
    gap = np.abs(rows[-1] - first)[: places + len(names.names)]
    if gap.max() > _JUMP:
        worst = int(gap.argmax())
        labels = [*names.position_names, *(f"velocity of {name}" for name in names.names)]
        raise BlockError(
            f"{key}: its motion must end where the next begins, at {labels[worst]} "
            f"{first[worst] + 0.0:.6g}, not {rows[-1, worst]:.6g}"
        )
