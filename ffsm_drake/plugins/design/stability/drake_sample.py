"""A control sample of a closed loop on its Drake diagram, with finite differences."""

import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import TypeVar

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import RandomSource

from ffsm_drake.common.lifetime import untie
from ffsm_drake.loop.blocks import READ_BY_FORCES
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.mission import Mission
from ffsm_drake.plugins.actuators.drives import FRICTION
from ffsm_drake.plugins.design.stability.discrete_groups import Groups
from ffsm_drake.plugins.design.stability.linear_loop import NotLinear, TooLarge
from ffsm_drake.scenario import Grip, MassProperties
from ffsm_drake.systems.controllers.law import ControlLaw, is_shipped
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.registry import Factory

# Beyond these, an evaluation at one instant takes more than seconds, or much memory.
_MOST_STATES, _MOST_SAMPLES, _MOST_EVALUATIONS = 1000, 5000, 8000
_JUST_AFTER = 1e-9  # control samples
# Step of a finite difference: rad, m, and per s; other states: relative to their size.
STEP = 1e-7
_T = TypeVar("_T")


class DrakeSample:
    """A control sample of a scenario's loop, which is not the first of a run.

    Its state (n) has the plant's [q; v] at ``known`` and ``hidden``, and then all discrete state
    with feedback: the law's memory at ``memory``, and of it at ``held`` what a linearisation holds,
    with its value (None: that at the start). ``noise`` has the parts of its noise (m), white of
    deviation 1.
    """

    def __init__(
        self,
        mission: Mission,
        motion: PlannedMotion,
        grip: Grip,
        *,
        blocks: Mapping[str, Factory],
    ) -> None:
        """Args:
          mission: the mission, without what has no derivative.
          motion: its motion.
          grip: what holds the target.
          blocks: factories in place of its blocks.

        Raises the errors of ``add_closed_loop``; NotLinear for a block with continuous or abstract
        state, and TooLarge.
        """
        scenario = mission.scenario
        self.motion, self.sample_time = motion, scenario.sample_time
        self.loop = make_closed_loop(mission, blocks=blocks, grip=grip)
        self.blocks, self._fastest = set(self.loop.blocks), scenario.divergence_speed
        self.coordinates, self.hidden_names = self.loop.coordinates, self.loop.split.names
        self._controller = self.loop.blocks["controller"]
        self._force = self._controller.GetOutputPort("generalized_force")
        # None: a controller that is not a control law
        self.law: ControlLaw | None = getattr(self._controller, "law", None)
        self.tracks_frame = self.loop.tracks_frame
        self._simulator = Simulator(self.loop.diagram)
        ApplySimulatorConfig(scenario.simulator_config, self._simulator)
        self._context = self._simulator.get_mutable_context()
        leaves = list(_leaves(self.loop.diagram))
        self._initialize(leaves)
        self._find_state(leaves)
        self._beginning = self._context.Clone()

    def _initialize(self, leaves: list[System]) -> None:
        """Set the context to the run's start, without a state that starts at random."""
        self.loop.initialize(self.loop.diagram, self._context)
        for leaf in leaves:
            if leaf is not self.loop.plant:
                leaf.SetDefaultContext(leaf.GetMyMutableContextFromRoot(self._context))
        for block in self.loop.blocks.values():
            context = block.GetMyMutableContextFromRoot(self._context)
            for port in map(block.GetInputPort, filter(block.HasInputPort, READ_BY_FORCES)):
                if not port.HasValue(context):  # the actuators are ideal here
                    port.FixValue(context, np.zeros(port.size()))
        state = self.loop.whole_state(self._context)
        self.loop.set_blocks(self._context, self.loop.split.known_part(state))

    def _find_state(self, leaves: list[System]) -> None:
        """Find the noise sources, and the discrete state that feeds back."""
        diagram, split, plant = self.loop.diagram, self.loop.split, self.loop.plant
        noise = [leaf for leaf in leaves if isinstance(leaf, RandomSource)]
        # systems without a connected output only record
        connected = {output[0] for output in diagram.connection_map().values()}
        parts = [part for part in diagram.GetSystems() if part in connected]
        memory = [leaf for part in parts for leaf in _leaves(part) if leaf not in noise]
        for leaf in memory:
            known = leaf is plant or leaf.get_name() == FRICTION
            if not known and leaf.num_continuous_states() + leaf.num_abstract_states():
                raise NotLinear(
                    f"{leaf.get_name()}: continuous or abstract state cannot be "
                    "linearised, only discrete"
                )
        self._own = plant.GetMyMutableContextFromRoot(self._context)
        self._plant = plant.num_multibody_states()
        entries = np.arange(self._plant)
        self.known = split.known_part(entries).tolist()
        self.hidden = split.hidden_part(entries).tolist() if split.names else []
        self._memory = Groups(memory, self._context, first=self._plant)
        self._noise = Groups(noise, self._context, first=self._plant + self._memory.size)
        self.size, self.num_noise = self._plant + self._memory.size, self._noise.size
        every = np.arange(self.size + self.num_noise)
        self._noise.write(np.zeros(every.size), every)
        self._written: np.ndarray | None = None  # state and noise in the context, if known
        self.start = self._read()
        groups, own = self._memory.parts, self._controller
        self.noise = {
            source.get_name(): slice(part.start - self.size, part.stop - self.size)
            for (source, _), part in self._noise.parts.items()
        }
        named: Mapping[str, int] = getattr(own, "memory_groups", dict)()
        self.memory = {name: groups[own, each] for name, each in named.items()
                       if (own, each) in groups}  # fmt: skip
        held: Mapping[str, tuple[int, float | None]] = getattr(own, "held_groups", dict)()
        self.held = {name: (groups[own, each], value) for name, (each, value) in held.items()}
        fixed = [part for part, _ in self.held.values()]
        # groups of the memory, counted from its beginning, that are not held
        self.groups = tuple(
            slice(part.start - self._plant, part.stop - self._plant)
            for part in groups.values()
            if part not in fixed
        )
        self._find_updates(memory)

    def _find_updates(self, memory: list[System]) -> None:
        """Find when systems update, and how often that repeats. Raises TooLarge."""
        self._updates = list[tuple[System, Context, float, float]]()
        for system in memory:
            timing = system.GetUniquePeriodicDiscreteUpdateAttribute()
            if timing is not None:
                times = (
                    timing.period_sec() / self.sample_time,
                    timing.offset_sec() / self.sample_time,
                )
                context = system.GetMyMutableContextFromRoot(self._context)
                self._updates.append((system, context, *times))
        # A system may behave differently from sample to sample: it says how by ``phase`` and
        # ``phase_period``.
        self._phased = [system for system in memory if hasattr(system, "phase_period")]
        self.period = math.lcm(
            *(max(1, round(period)) for _, _, period, _ in self._updates),
            *(system.phase_period for system in self._phased),
        )
        # an actuator's state has the phase of the sample before
        acting = [each for each in self._phased if getattr(getattr(each, "block", 0), "acts", 0)]
        self.latched_period = math.lcm(*(each.phase_period for each in acting))
        own = self._context
        self.user_supplied = [
            system
            for system in memory
            if not is_shipped(self.law if system is self._controller and self.law else system)
            and system.GetMyContextFromRoot(own).num_discrete_state_groups()
        ]
        states = self.size - sum(part.stop - part.start for part, _ in self.held.values()) - 1
        kinds = len({self.kind(index) for index in range(min(self.period, _MOST_SAMPLES + 1))})
        work = kinds * (states + self.num_noise)
        if states > _MOST_STATES or self.period > _MOST_SAMPLES or work > _MOST_EVALUATIONS:
            raise TooLarge(
                f"the linear loop is too large: {states} states (limit {_MOST_STATES}), "
                f"{self.period} samples in its period (limit {_MOST_SAMPLES}), {work} evaluations "
                f"(limit {_MOST_EVALUATIONS}); shorten delays and periods"
            )

    def release(self) -> None:
        """Free the diagram, which Drake would otherwise keep."""
        untie(self.loop.diagram)

    def kind(self, index: int) -> Hashable:
        """A key that is equal for control samples with the same updates."""
        return self._due(index), tuple(system.phase(index) for system in self._phased)

    def _due(self, index: int) -> tuple[bool, ...]:
        """Whether each system updates at a control sample."""
        times = ((index - offset) / period for _, _, period, offset in self._updates)
        return tuple(time > -1e-6 and abs(time - round(time)) < 1e-6 for time in times)

    def placed(self, known: np.ndarray) -> np.ndarray:
        """The state of the run's start with another [q; v], which was measured before too (n)."""
        self._written = None
        self._context.SetTimeStateAndParametersFrom(self._beginning)
        self.loop.set_state(self._context, known)
        return self._read()

    def after(self, index: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state before the next sample (n), and the controller's force until then (nv), without
        noise; NaN where the loop has diverged.

        Args: the control sample, and the state before it.

        Raises NotLinear: a block updates between two samples; and the errors of blocks.
        """

        def advanced() -> tuple[np.ndarray, np.ndarray]:
            memory = self._updated(index, np.concatenate([state, np.zeros(self.num_noise)]))
            moved = self._moved(index, np.concatenate([state[: self._plant], memory]), None)
            return np.concatenate([moved[: self._plant], memory]), moved[self._plant :]

        unknown = np.full(self.size, np.nan), np.full(self.coordinates.num_velocities, np.nan)
        return self._unless_lost(state, advanced, unknown)

    def derivative(
        self,
        index: int,
        state: np.ndarray,
        truth: MassProperties | None,
        directions: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The state before the next sample (n), and derivatives of it and of the force (nv) by
        directions (k), by finite differences; NaN where the loop has diverged.

        Update and motion are differenced apart: the motion depends on the plant's state and a few
        held values alone.

        Args:
          index: of the control sample.
          state: before it.
          truth: true mass properties of the payload in the motion, in place of the scenario's.
          directions: of the state and of its noise (n + m, k).

        Raises: as ``after``.
        """
        count, columns = self._plant, np.flatnonzero(directions[: self._plant].any(axis=0))

        def differenced() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            memory, of_memory = self.update_slope(index, state, directions)
            updated = np.concatenate([state[:count], memory])
            move = functools.partial(self._moved, index, truth=truth)
            acting = self._acting(move, updated)
            own = np.zeros((self.size, columns.size + acting.size))
            own[:count, : columns.size] = directions[:count, columns]
            own[acting, np.arange(columns.size, own.shape[1])] = 1.0
            moved, of_moved = _slopes(move, updated, own, self._steps(updated, own))
            found = of_moved[:, columns.size :] @ of_memory[acting - count]
            found[:, columns] += of_moved[:, : columns.size]
            after = np.concatenate([moved[:count], memory])
            return after, np.vstack([found[:count], of_memory]), found[count:]

        nan = np.full((self.size + self.coordinates.num_velocities, directions.shape[1]), np.nan)
        unknown = np.full(self.size, np.nan), nan[: self.size], nan[self.size :]
        return self._unless_lost(state, differenced, unknown)

    def update_slope(
        self, index: int, state: np.ndarray, directions: np.ndarray, step: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The memory after the update at a control sample, and its derivative as of
        ``derivative``; ``step``: of the differences.
        """
        before = np.concatenate([state, np.zeros(self.num_noise)])
        steps = (
            self._steps(before, directions) if step is None else np.full(len(directions.T), step)
        )
        return _slopes(functools.partial(self._updated, index), before, directions, steps)

    def _steps(self, at: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Steps of differences by directions (k): relative to their largest entries."""
        largest = np.abs(directions).argmax(axis=0)
        least = max(STEP, getattr(self.law, "least_change", 0.0))
        return np.where(largest < self.size, least * np.maximum(1.0, np.abs(at[largest])), 1.0)

    def _acting(self, move: Callable[[np.ndarray], np.ndarray], updated: np.ndarray) -> np.ndarray:
        """The entries of the memory, of whole groups, that act on the motion."""
        base, found = move(updated), [np.empty(0, dtype=int)]
        for part in self._memory.parts.values():
            trial, size = updated.copy(), part.stop - part.start
            trial[part] += STEP * np.maximum(1.0, np.abs(trial[part])) * np.linspace(1.0, 2.0, size)
            if size and not np.array_equal(move(trial), base):
                found.append(np.arange(part.start, part.stop))
        return np.concatenate(found)

    def _unless_lost(self, state: np.ndarray, function: Callable[[], _T], unknown: _T) -> _T:
        """The result of a function of a state; ``unknown`` where the loop has diverged."""
        if not np.isfinite(state).all():
            return unknown
        try:
            return function()
        except (Exception, SystemExit):  # Drake refuses numbers that are not finite by SystemExit
            self._written = None
            if not np.abs(self.loop.plant.GetVelocities(self._own)).max() <= self._fastest:
                return unknown  # for NaN too
            raise

    def _updated(self, index: int, before: np.ndarray) -> np.ndarray:
        """The memory after the update at a control sample, from the state and the noise."""
        self._write(index * self.sample_time, before)
        found, groups = before[self._plant : self.size].copy(), self._memory.parts
        for (system, context, _, _), is_due in zip(self._updates, self._due(index), strict=True):
            if is_due:
                values = system.EvalUniquePeriodicDiscreteUpdate(context)
                for group in range(values.num_groups()):
                    part = groups[system, group]
                    found[part.start - self._plant : part.stop - self._plant] = values.value(group)
        return found

    def _moved(self, index: int, updated: np.ndarray, truth: MassProperties | None) -> np.ndarray:
        """The plant's state at the next control sample and the force until then, from the state
        just after the update at a control sample.
        """
        self._written = None
        # past the update: it is not made again
        self._write((index + _JUST_AFTER) * self.sample_time, updated)
        self._written = None
        if truth is not None:
            self.loop.set_payload(self._context, truth)
        force = self._force.Eval(self._controller.GetMyContextFromRoot(self._context)).copy()
        self._simulator.Initialize()
        # a period of their own may end a rounding error before the next sample
        short = _JUST_AFTER if self.user_supplied else 0.0
        self._simulator.AdvanceTo((index + 1 - short) * self.sample_time)
        if not np.array_equal(self._memory.read(), updated[self._plant :]):
            raise NotLinear(
                "a block updates between two control samples, which cannot be linearised"
            )
        return np.concatenate([self.loop.whole_state(self._context), force])

    def _write(self, time: float, state: np.ndarray) -> None:
        """Set the context to a time, and to a state without or with noise. Only what has changed is
        written, so that Drake computes only its consequences.
        """
        if self._written is None or self._context.get_time() != time:
            self._context.SetTimeStateAndParametersFrom(self._beginning)
            self._context.SetTime(time)
            self._written = np.full(self.size + self.num_noise, np.nan)
        changed = np.flatnonzero(self._written[: state.size] != state)
        self._written[: state.size] = state
        if changed.size and changed[0] < self._plant:
            self.loop.plant.SetPositionsAndVelocities(self._own, state[: self._plant])
        self._memory.write(state, changed)
        self._noise.write(state, changed)

    def _read(self) -> np.ndarray:
        """The state (n) in the context."""
        return np.concatenate([self.loop.whole_state(self._context), self._memory.read()])


def _slopes(
    function: Callable[[np.ndarray], np.ndarray],
    at: np.ndarray,
    directions: np.ndarray,
    steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """A function (m) at a point (n), and its finite differences (m, k) by directions (n, k) with
    steps (k).
    """
    base = function(at)
    slopes = np.zeros((base.size, steps.size))
    for k in np.flatnonzero(directions.any(axis=0)):
        slopes[:, k] = (function(at + steps[k] * directions[:, k]) - base) / steps[k]
    return base, slopes


def _leaves(system: System) -> Iterator[System]:
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            yield from _leaves(part)
    else:
        yield system
