"""A sampled loop on contexts of its Drake diagram, linearised by finite differences.

Every controller, plant, and block with discrete state is covered without a formula; a block with
other state is refused. Limits have no derivative and are omitted, and quantisation counts as white
noise of its sawtooth's variance.

For speed, the update at a sample and the motion up to the next are differenced separately: the
motion depends only on the plant's state and a few held values. If a block updates less often than
the controller, the map covers their common period, and each kind of sample in it is differenced
once.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import RandomSource

from ffsm_drake.common.lifetime import untie
from ffsm_drake.common.memo import content_of
from ffsm_drake.loop.blocks import FROM_ACTUATORS
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.plugins.actuators.drives import FRICTION
from ffsm_drake.plugins.design.stability.linear_loop import (
    WARM_UP,
    NotLinear,
    SampleMap,
    TooLarge,
)
from ffsm_drake.plugins.design.stability.loop_state import Memory, PlantState, difference
from ffsm_drake.scenario import Grip, MassProperties, Scenario
from ffsm_drake.systems.controllers.law import ControlLaw, is_shipped
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.planned_motion import PlannedMotion
from ffsm_drake.systems.registry import Factory

# Step of a finite difference: rad, m, and per s; other states: relative to their size.
_STEP = 1e-7
# Beyond these, an evaluation at one instant takes more than seconds, or much memory.
_MOST_STATES, _MOST_SAMPLES, _MOST_EVALUATIONS = 1000, 5000, 8000
# Longest period, in control samples, searched for user-supplied systems without a declared one, and
# the change of their map, relative to its rows, between different samples.
_LONGEST_PERIOD, _DIFFERENT = 12, 0.3
_COARSE = 1e3  # times the step, with which a smooth function has the same derivative
_ROUNDING = 1e-14  # rounding of numbers in memory, relative to the largest of a group
# Stretches of samples evaluated: a transient may hide the period in the first.
_TRIES = 3


class Way(NamedTuple):
    """A run without noise."""

    known: Callable[[], np.ndarray]  # returns [q; v] at the present sample
    # goes on from a sample to the next; returns the controller's force until then
    go_on: Callable[[int], np.ndarray]


class DifferencedLoop:
    """A closed loop, built once, at one instant: just before the update at a control sample."""

    def __init__(
        self,
        scenario: Scenario,
        motion: PlannedMotion,
        grip: Grip,
        *,
        blocks: Mapping[str, Factory],
    ) -> None:
        """Args:
          scenario: the scenario, without what has no derivative.
          motion: its motion.
          grip: what holds the target.
          blocks: factories in place of its blocks.

        Raises the errors of ``add_closed_loop``; NotLinear for a block with continuous or abstract
        state.
        """
        self.scenario, self.motion = scenario, motion
        self.loop = make_closed_loop(scenario, blocks=blocks, grip=grip)
        self.coordinates, self.hidden = self.loop.coordinates, self.loop.split.names
        self.tracks_frame = self.loop.tracks_frame
        self._simulator = self._new_simulator()
        self._context = self._simulator.get_mutable_context()
        self._plant = PlantState(self.loop, self._context)
        leaves = list(_leaves(self.loop.diagram))
        self._initialize(leaves)
        self._start = self._context.Clone()
        self._find_law()
        self._find_memory(leaves)
        self._updates = dict[Hashable, tuple[_Update, ...]]()
        self._motions = dict[Hashable, np.ndarray]()
        self._own_period: int | None = None  # period of user-supplied systems, once it is known

    def _new_simulator(self, context: Context | None = None) -> Simulator:
        simulator = Simulator(self.loop.diagram, context)
        ApplySimulatorConfig(self.scenario.simulator_config, simulator)
        return simulator

    def _initialize(self, leaves: Sequence[System]) -> None:
        """Set the context to the run's start, without noise in a state that starts at random."""
        self.loop.initialize(self.loop.diagram, self._context)
        for leaf in leaves:
            if leaf is not self.loop.plant:
                leaf.SetDefaultContext(leaf.GetMyMutableContextFromRoot(self._context))
        for block in self.loop.blocks.values():
            context = block.GetMyMutableContextFromRoot(self._context)
            for port in map(block.GetInputPort, filter(block.HasInputPort, FROM_ACTUATORS)):
                if not port.HasValue(context):  # the actuators are ideal here
                    port.FixValue(context, np.zeros(port.size()))
        self.loop.set_blocks(self._context, self._plant.known())

    def _find_law(self) -> None:
        controller = self.loop.blocks["controller"]
        # None: a controller that is not a control law
        self.law: ControlLaw | None = getattr(controller, "law", None)
        self._held: Mapping[str, tuple[int, float | None]] = getattr(
            controller, "held_groups", dict
        )()
        self._force = controller.GetOutputPort("generalized_force")
        self._controller_context = controller.GetMyMutableContextFromRoot(self._context)
        self._start_of_controller = controller.GetMyContextFromRoot(self._start)

    def _find_memory(self, leaves: Sequence[System]) -> None:
        """Find the noise sources, and the discrete state that feeds back. Raises BlockError."""
        diagram, controller = self.loop.diagram, self.loop.blocks["controller"]
        noise = [leaf for leaf in leaves if isinstance(leaf, RandomSource)]
        # systems without a connected output only record
        connected = {output[0] for output in diagram.connection_map().values()}
        parts = [part for part in diagram.GetSystems() if part in connected]
        memory = [leaf for part in parts for leaf in _leaves(part) if leaf not in noise]
        for leaf in memory:
            known = leaf is self.loop.plant or leaf.get_name() == FRICTION
            if not known and leaf.num_continuous_states() + leaf.num_abstract_states():
                raise NotLinear(
                    f"{leaf.get_name()}: continuous or abstract state cannot be "
                    "linearised, only discrete"
                )
        held = {index for index, _ in self._held.values()}
        period = self.scenario.sample_time
        self._noise = Memory(noise, self._context, sample_time=period)
        self._memory = Memory(
            memory,
            self._context,
            sample_time=period,
            leave_out=lambda system, group: system is controller and group in held,
        )
        # width of the plant's part of x
        self._width = 2 * (len(self.loop.coordinates.names) + len(self.loop.split.names))
        self.size, self.num_noise = self._width + self._memory.size, self._noise.size
        self.noise = {
            source.get_name(): part
            for source, part in zip(self._noise.systems, self._noise.parts, strict=True)
        }
        self._check_cost()
        groups: Mapping[str, int] = getattr(controller, "memory_groups", dict)()
        # of a law that counts its samples
        self._count = groups.get("samples") if self.law and is_shipped(self.law) else None
        self.parts_of_memory = {
            name: slice(self._width + part.start, self._width + part.stop)
            for name, group in groups.items()
            if (part := self._memory.part_of(controller, group)) is not None
        }

    def _check_cost(self) -> None:
        """Raise TooLarge for a loop that is."""
        states, period = self._width + self._memory.size, self._memory.common_period
        short = range(min(period, _MOST_SAMPLES + 1))
        updates = len({self._memory.kind(index) for index in short})
        work = updates * (states + self._noise.size)
        if states > _MOST_STATES or period > _MOST_SAMPLES or work > _MOST_EVALUATIONS:
            raise TooLarge(
                f"the linear loop is too large: {states} states (limit {_MOST_STATES}), {period} "
                f"samples in its period (limit {_MOST_SAMPLES}), {work} evaluations "
                f"(limit {_MOST_EVALUATIONS}); shorten delays and periods"
            )

    def release(self) -> None:
        """Free the diagram, which Drake would otherwise keep."""
        untie(self.loop.diagram)

    def place(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Go to a control sample on the plan, with all memory as at the start of the run."""
        time = index * self.scenario.sample_time
        self._context.SetTimeStateAndParametersFrom(self._start)
        self._context.SetTime(time)
        self.loop.set_state(self._context, np.concatenate(self.motion.evaluate(time)[:2]))
        if self._count is not None:
            self._controller_context.SetDiscreteState(self._count, np.array([float(index)]))
        self._quiet(held)

    def save(self) -> Context:
        """The present instant, for ``load``."""
        return self._context.Clone()

    def load(self, instant: Context) -> None:
        """Go to a saved instant."""
        self._context.SetTimeStateAndParametersFrom(instant)

    @property
    def start(self) -> Context:
        """The instant of the run's start."""
        return self._start

    def known(self) -> np.ndarray:
        """[q; v] of the plant without hidden coordinates."""
        return self._plant.known()

    def from_start(self, held: Mapping[str, np.ndarray]) -> "Way":
        """The way from the start of the run on."""
        context = self._start.Clone()
        silent = _silence(self._noise.systems, self.loop.diagram, context)
        if silent:  # step as in a run, for speed
            simulator = self._new_simulator(context)
            context = simulator.get_mutable_context()
            simulator.Initialize()
        else:
            context = self._context
            context.SetTimeStateAndParametersFrom(self._start)
        controller, period = self.loop.blocks["controller"], self.scenario.sample_time
        controller_context = controller.GetMyMutableContextFromRoot(context)
        if isinstance(controller, SampledController):  # no sample counts as a first one here
            controller.remember_velocity(controller_context, self.motion.evaluate(0.0)[1])

        def go_on(index: int) -> np.ndarray:
            self._hold(controller_context, held)
            if silent:
                simulator.AdvanceTo((index + 1) * period)
            else:
                self._noise.write(np.zeros(self._noise.size))
                self._memory.update(index)
                self._move(index)
            force: np.ndarray = self._force.Eval(controller_context).copy()
            return force

        return Way(PlantState(self.loop, context).known, go_on)

    def _quiet(self, held: Mapping[str, np.ndarray]) -> None:
        """No noise at the next sample, and the controller's held memory at its values."""
        self._noise.write(np.zeros(self._noise.size))
        self._hold(self._controller_context, held)

    def _hold(self, controller_context: Context, held: Mapping[str, np.ndarray]) -> None:
        for name, (group, value) in self._held.items():
            starting = self._start_of_controller.get_discrete_state(group).value()
            given = starting if value is None else np.full_like(starting, value)
            controller_context.SetDiscreteState(group, held.get(name, given))

    def _move(self, index: int) -> None:
        """Advance from just after the update at the control sample ``index`` to just before the
        next.
        """
        # past the update: it is not made again
        self._context.SetTime((index + 1e-9) * self.scenario.sample_time)
        self._simulator.Initialize()
        # a period of their own may end a rounding error before the next sample
        short = 1e-9 if self.user_supplied else 0.0
        self._simulator.AdvanceTo((index + 1 - short) * self.scenario.sample_time)

    def go_on(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Advance from just before the update at a control sample to just before the next one."""
        self._memory.update(index)
        self._move(index)
        self._quiet(held)

    def samples(
        self,
        first: int,
        held: Mapping[str, np.ndarray],
        truth: MassProperties | None,
        before: Callable[[], Context],
    ) -> tuple[SampleMap, ...]:
        """The maps of one common period of all blocks.

        Args:
          first: control sample at which the warm-up begins on the plan.
          held: see ``Linearizer.at``.
          truth: likewise.
          before: returns the instant after the warm-up.
        """
        updates = self._updates_from(first, held, before)
        maps = {update: self._map(update, truth) for update in dict.fromkeys(updates)}
        return tuple(maps[update] for update in updates)

    def _updates_from(
        self, first: int, held: Mapping[str, np.ndarray], warmed_up: Callable[[], Context]
    ) -> tuple["_Update", ...]:
        key = content_of((first, held))
        if key not in self._updates:
            index = first + WARM_UP
            before, updates = warmed_up(), dict[Hashable, _Update]()
            self._context.SetTimeStateAndParametersFrom(before)
            own = self._find_own_period(index, held)
            indices = range(index, index + math.lcm(self._memory.common_period, own))
            kinds = [(self._memory.kind(each), each % own) for each in indices]
            for each, kind in zip(indices, kinds, strict=True):
                if kind not in updates:
                    self._context.SetTimeStateAndParametersFrom(before)
                    for earlier in range(index, index + (each - index) % own):
                        self.go_on(earlier, held)
                    self._context.SetTime(each * self.scenario.sample_time)
                    updates[kind] = self._update(each, first)
            self._updates[key] = tuple(updates[kind] for kind in kinds)
        return self._updates[key]

    @functools.cached_property
    def user_supplied(self) -> list[System]:
        """The user-supplied systems with memory, and the controller with a user-supplied law."""
        controller = self.loop.blocks["controller"]
        return [
            system
            for system in self._memory.systems
            if not is_shipped(self.law if system is controller and self.law else system)
            and system.GetMyContextFromRoot(self._context).num_discrete_state_groups()
        ]

    def _find_own_period(self, index: int, held: Mapping[str, np.ndarray]) -> int:
        """Control samples after which user-supplied systems repeat themselves, from a context just
        before the update at the control sample ``index``. Raises NotLinear where they do not.

        They may count samples in their state without a word of it.
        """
        if self._own_period is None and not self.user_supplied:
            self._own_period = 1
        for _ in range(_TRIES):
            if self._own_period is None:
                self._own_period = self._own_period_from(index, held)
                index += 2 * _LONGEST_PERIOD
        if self._own_period is None:
            names = ", ".join(system.get_name() for system in self.user_supplied)
            if self._depends_on_step(index):
                raise NotLinear(
                    f"{names}: has no derivative at small errors (sign, root or rounding); smooth "
                    "it, or make its factor a state and return 0 for it in held()"
                )
            raise NotLinear(
                f"{names}: differs from sample to sample, without a period of up to "
                f"{_LONGEST_PERIOD} samples"
            )
        return self._own_period

    def _own_period_from(self, index: int, held: Mapping[str, np.ndarray]) -> int | None:
        """The least period of the maps from a control sample on; None for maps without a period.

        Samples with equal behaviour of the shipped systems are compared, since a navigation with
        one output per second makes one map of a hundred differ; if no two are equal, all are
        compared.
        """
        indices = range(index, index + 2 * _LONGEST_PERIOD)
        maps, kept, kinds = [], [], [self._memory.kind(each) for each in indices]
        for each in indices:
            maps.append(self._map_of_errors(each))
            kept.append(self._memory.after(each))
            self.go_on(each, held)
        least = _DIFFERENT * np.abs(maps).max(axis=(0, 2))
        for part in self._memory.parts:  # small dependences are rounding
            rounding = _ROUNDING / _STEP * np.abs(kept)[:, part].max(initial=0.0)
            least[part] = np.maximum(least[part], rounding)
        for period in range(1, _LONGEST_PERIOD + 1):
            pairs = [(k, k + period) for k in range(len(maps) - period)]
            alike = [(a, b) for a, b in pairs if kinds[a] == kinds[b]]
            if all((np.abs(maps[b] - maps[a]) <= least[:, None]).all() for a, b in alike or pairs):
                return period
        return None

    def _depends_on_step(self, index: int) -> bool:
        """Whether the derivatives at a control sample depend on the step, as of a function that has
        none.
        """
        fine, coarse = (self._map_of_errors(index, step=k * _STEP) for k in (1.0, _COARSE))
        return bool((np.abs(fine - coarse) > _DIFFERENT * np.abs(fine).max()).any())

    def _map_of_errors(self, index: int, *, step: float = _STEP) -> np.ndarray:
        """Derivative of the memory after a control sample's update by the plant's state before."""
        state = self._plant.read()

        def update(change: np.ndarray) -> np.ndarray:
            self._plant.write(self._plant.moved(state, change))
            return self._memory.after(index)

        steps = np.full(self._width, step)
        found = _jacobian(update, [slice(0, self._width)], steps)
        self._plant.write(state)
        return found

    def _update(self, index: int, first: int) -> "_Update":
        """Difference and make the update at the control sample ``index``, from a context just
        before it, after a warm-up from the sample ``first``.
        """
        width, memory, state = self._width, self._memory.read(), self._plant.read()
        size = width + memory.size
        parts = [
            *self._memory.parts,
            *(slice(memory.size + p.start, memory.size + p.stop) for p in self._noise.parts),
        ]
        groups = [
            slice(0, width),
            *(slice(width + part.start, width + part.stop) for part in parts),
        ]
        memory_steps = _STEP * np.maximum(1.0, np.abs(memory))
        steps = np.concatenate([np.full(width, _STEP), memory_steps, np.ones(self._noise.size)])
        owner = np.repeat(np.arange(len(groups)), [group.stop - group.start for group in groups])
        written = np.zeros(steps.size)

        law = self._law_of_many(index)

        def update(x: np.ndarray) -> np.ndarray:
            """The memory after the sample's update, the controller's as ``law`` reads it; x is
            followed by the noise.

            Only changed groups are written, so that Drake computes only their consequences.
            """
            for k in set(owner[x != written].tolist()):
                if k == 0:
                    self._plant.write(self._plant.moved(state, x[:width]))
                elif k <= len(self._memory.parts):
                    self._memory.write_part(k - 1, memory[parts[k - 1]] + x[groups[k]])
                else:
                    self._noise.write_part(k - 1 - len(self._memory.parts), x[groups[k]])
            written[:] = x
            return self._memory.after(index) if law is None else law.read()

        jacobian = _jacobian(update, groups, steps, law)
        update(np.zeros(steps.size))
        self._memory.update(index)
        kept = [group for group in groups if group.stop <= size]
        return _Update(
            index=index,
            alike=None if self.user_supplied else (first, self._memory.phases(index)),
            after=self._context.Clone(),
            groups=kept,
            steps=steps[:size],
            jacobian=jacobian,
        )

    def _law_of_many(self, index: int) -> "_LawOfMany | None":
        """The controller's update at a control sample for many states, of a shipped law."""
        controller = self.loop.blocks["controller"]
        if not isinstance(controller, SampledController) or not is_shipped(controller.law):
            return None
        return _LawOfMany(
            controller, self._controller_context, self._memory, index=index, width=self._width
        )

    def _motion(self, update: "_Update", truth: MassProperties | None) -> np.ndarray:
        """Derivative, by the state after an update, of the plant's state at the next control sample
        and of the controller's force until then. It does not depend on gains and measurements:
        these change the held values, but not their effect.
        """
        nv, width, size = len(self.loop.coordinates.names), self._width, update.steps.size
        after = update.after
        self._context.SetTimeStateAndParametersFrom(after)
        if truth is not None:
            self.loop.set_payload(self._context, truth)
            after = self._context.Clone()
        state, updated = self._plant.read(), self._memory.read()

        def move(x: np.ndarray) -> np.ndarray:
            """The plant's state at the next sample, and the controller's force until then."""
            self._context.SetTimeStateAndParametersFrom(after)
            self._plant.write(self._plant.moved(state, x[:width]))
            self._memory.write(updated + x[width:])
            force = self._force.Eval(self._controller_context).copy()
            self._move(update.index)
            return np.concatenate([self._plant.read(), force])

        base = move(np.zeros(size))
        if not np.array_equal(self._memory.read(), updated):
            raise NotLinear(
                "a block updates between two control samples, which cannot be linearised"
            )

        def change(x: np.ndarray) -> np.ndarray:
            reached = move(x)
            return np.concatenate([difference(reached[:-nv], base[:-nv]), reached[-nv:]])

        return _jacobian(change, update.groups, update.steps)

    def _map(self, update: "_Update", truth: MassProperties | None) -> SampleMap:
        """The map of a control sample: its update and the motion up to the next."""
        nv, width, size = len(self.loop.coordinates.names), self._width, update.steps.size
        if truth is not None or update.alike is None:
            motion = self._motion(update, truth)
        else:
            if update.alike not in self._motions:
                self._motions[update.alike] = self._motion(update, None)
            motion = self._motions[update.alike]
        # From [x; w] to [x+; u], by way of the memory after the update.
        whole = motion[:, width:] @ update.jacobian
        whole[:, :width] += motion[:, :width]
        undriven = np.flatnonzero(~self.loop.coordinates.is_driven)
        whole[:, nv + undriven] = 0.0  # but for rounding
        if not self.loop.tracks_frame:
            whole[:, undriven] = 0.0  # likewise
            whole[undriven, undriven] = 1.0  # their drift adds up
        both = np.vstack([whole[:width], update.jacobian])
        force = whole[width:]
        return SampleMap(a=both[:, :size], b=both[:, size:], c=force[:, :size], d=force[:, size:])


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class _Update:
    """First-order map of a control sample's update, from [x; w], and the state after it."""

    index: int
    alike: Hashable | None  # equal for those with the same map of the motion; None: unknown
    after: Context
    groups: Sequence[slice]  # groups of x: the plant's state, then each group of the memory
    steps: np.ndarray  # steps of the differences of x
    jacobian: np.ndarray  # derivative of the memory after the update by [x; w]


class _LawOfMany:
    """The update at a control sample in two steps: first every block except the controller, and the
    controller's inputs; then the control law, for many states.
    """

    def __init__(
        self,
        controller: SampledController,
        context: Context,
        memory: Memory,
        *,
        index: int,
        width: int,
    ) -> None:
        """Args:
        controller: the controller.
        context: its context.
        memory: all memory.
        index: the control sample.
        width: the size of the plant's part of x.
        """
        self._controller, self._context = controller, context
        self._memory, self._index = memory, index
        self._inputs, self._own = dict[str, slice](), dict[str, slice]()
        end = memory.size
        for values, slots in zip(controller.read(context), (self._inputs, self._own), strict=True):
            for name, value in values.items():
                slots[name], end = slice(end, end + value.size), end + value.size
        groups = {"generalized_force": controller.force_group, **controller.memory_groups()}
        self._parts = {
            name: part
            for name, group in groups.items()
            if (part := memory.part_of(controller, group)) is not None
        }
        self._slots = {
            (width + part.start, width + part.stop): self._own[name]
            for name, part in self._parts.items()
            if name in self._own
        }

    def read(self) -> np.ndarray:
        """The memory after the update, without the controller's, and what the controller reads."""
        inputs, own = self._controller.read(self._context)
        others = self._memory.after(self._index, without=self._controller)
        return np.concatenate([others, *inputs.values(), *own.values()])

    def slot(self, group: slice, x: np.ndarray, *, change: np.ndarray) -> slice | None:
        """The place in ``read`` of a group of x that only the law reads; None for any other group.

        Args:
          group: the group.
          x: a trial of x.
          change: its change of ``read``.
        """
        slot = self._slots.get((group.start, group.stop))
        if slot is None:
            return None
        expected = np.zeros_like(change)
        expected[slot] = x[group]
        return slot if np.array_equal(expected != 0.0, change != 0.0) else None

    def step(self, read: np.ndarray) -> np.ndarray:
        """The memory after the update, from rows of ``read``, the first without a change."""
        found = read[:, : self._memory.size].copy()
        least, change = getattr(self._controller.law, "least_change", 0.0), read - read[0]
        larger = np.fmax(1.0, least / np.fmax(np.abs(change).max(axis=1, keepdims=True), 1e-12))
        if least:
            read = read[0] + larger * change
        made = [self._stepped(row) for row in read]
        for name, part in self._parts.items():
            values = np.stack([np.ravel(each[name]) for each in made])
            found[:, part] = values[0] + (values - values[0]) / larger if least else values
        return found

    def _stepped(self, row: np.ndarray) -> dict[str, np.ndarray]:
        """The force and the law's memory after the update, from a row of ``read``."""
        inputs, own = (
            {name: row[slot] for name, slot in slots.items()} for slots in (self._inputs, self._own)
        )
        force, after = self._controller.step(inputs, own)
        return {"generalized_force": force, **after}


def _jacobian(
    function: Callable[[np.ndarray], np.ndarray],
    groups: Sequence[slice],
    steps: np.ndarray,
    law: "_LawOfMany | None" = None,
) -> np.ndarray:
    """Finite differences of a function at zero by ``steps``, followed by a law's step; groups of
    its argument without effect are skipped.
    """
    rows, columns = [function(np.zeros(steps.size))], list[int]()
    for group in groups:
        trial = np.zeros(steps.size)
        trial[group] = steps[group] * np.linspace(1.0, 2.0, group.stop - group.start)
        found = function(trial)
        if np.array_equal(found, rows[0]):
            continue
        changes = np.zeros((group.stop - group.start, steps.size))
        changes[:, group] = np.diag(steps[group])
        columns += range(group.start, group.stop)
        slot = None if law is None else law.slot(group, trial, change=found - rows[0])
        if slot is None:
            rows += map(function, changes)
        else:  # nothing else reads it
            passed_on = np.tile(rows[0], (len(changes), 1))
            passed_on[:, slot] += changes[:, group]
            rows += list(passed_on)
    values = np.array(rows) if law is None else law.step(np.array(rows))
    jacobian = np.zeros((values.shape[1], steps.size))
    jacobian[:, columns] = ((values[1:] - values[0]) / steps[columns, None]).T
    return jacobian


def _silence(sources: Sequence[RandomSource], diagram: Diagram, context: Context) -> bool:
    """Fix the inputs connected to the sources to zero. False if one is not found, for example if a
    block's output is noise itself.
    """
    heard = list[System]()
    for part in _diagrams(diagram):
        for (system, number), (source, _) in part.connection_map().items():
            if source in sources:
                port = system.get_input_port(number)
                port.FixValue(system.GetMyMutableContextFromRoot(context), np.zeros(port.size()))
                heard.append(source)
    return all(source in heard for source in sources)


def _diagrams(system: System) -> Iterator[Diagram]:
    if isinstance(system, Diagram):
        yield system
        for part in system.GetSystems():
            yield from _diagrams(part)


def _leaves(system: System) -> Iterator[System]:
    if isinstance(system, Diagram):
        for part in system.GetSystems():
            yield from _leaves(part)
    else:
        yield system
