"""The linearised sampled loop, as wired: the map from just before one control sample to just before
the next.

Its state is all state with feedback: the plant's (its attitude as a small rotation) with hidden
coordinates, the controller's and its estimator's, delays, actuators. Its columns are finite
differences on a context of the closed loop, so every controller, plant, and block with discrete
state is covered without a formula; a block with other state is refused. ``ControlLaw.held`` (gains
under adaptation, sign terms) is constant. Noise is an input. Limits have no derivative and are
omitted, and quantisation counts as white noise of its sawtooth's variance.

For speed, the update at a sample and the motion up to the next are differenced separately: the
motion depends only on the plant's state and a few held values. If a block updates less often than
the controller, the map covers their common period, and each kind of sample in it is differenced
once.
"""

import contextlib
import dataclasses
import functools
import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Self

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator
from pydrake.systems.framework import Context, Diagram, System
from pydrake.systems.primitives import RandomSource

from ffsm_drake.common.errors import BlockError, FfsmError, one_line
from ffsm_drake.common.guard import guarded
from ffsm_drake.common.lifetime import untie
from ffsm_drake.common.memo import content_of
from ffsm_drake.loop.blocks import FROM_ACTUATORS, is_rehearsed, parts_of, settle_faults
from ffsm_drake.loop.closed_loop import make_closed_loop
from ffsm_drake.plugins.actuators.drives import FRICTION
from ffsm_drake.plugins.actuators.mean import make_mean_actuation
from ffsm_drake.plugins.design.stability.linear_loop import (
    WARM_UP,
    LinearLoop,
    SampleMap,
)
from ffsm_drake.plugins.design.stability.linear_settings import without_limits
from ffsm_drake.plugins.design.stability.loop_state import Memory, PlantState, difference
from ffsm_drake.plugins.design.stability.planned_dynamics import PlannedDynamics, from_grasp
from ffsm_drake.scenario import MassProperties, Scenario
from ffsm_drake.spacecraft.coordinates import position_errors
from ffsm_drake.systems.controllers.law import ControlLaw
from ffsm_drake.systems.controllers.sampled import SampledController
from ffsm_drake.systems.reference import make_motion, timed
from ffsm_drake.systems.registry import Factory

# Fractions of the planned motion at which a loop is linearised.
POSTURES = (0.0, 0.25, 0.5, 0.75, 1.0)
# Step of a finite difference: rad, m, and per s; other states: relative to their size.
_STEP = 1e-7
# The first samples, without an estimate, throw a light coordinate off the plan. Where it still
# accelerates so much beside the plan (rad/s^2, m/s^2), the warm-up is so many times as long; the
# whole motion, if it is then so many times as far off.
_OFF, _LONGER, _FARTHER = 0.5, 4, 2.0
# Beyond these, an evaluation at one instant takes more than seconds, or much memory.
_MOST_STATES, _MOST_SAMPLES, _MOST_EVALUATIONS = 1000, 5000, 8000
# Longest period, in control samples, searched for user-supplied systems without a declared one, and
# the change of their map, relative to its rows, between different samples.
_LONGEST_PERIOD, _DIFFERENT = 12, 0.3
_COARSE = 1e3  # times the step, with which a smooth function has the same derivative
_ROUNDING = 1e-14  # rounding of numbers in memory, relative to the largest of a group
# Stretches of samples evaluated: a transient may hide the period in the first.
_TRIES = 3


class NotLinear(BlockError):
    """A loop with a block that cannot be linearised."""


class TooLarge(NotLinear):
    """A loop whose linearisation would take minutes, or fill the memory."""


class Linearizer:
    """A closed loop that is built once and linearised at many instants, within a ``with`` block."""

    @guarded
    def __init__(
        self,
        scenario: Scenario,
        *,
        blocks: Mapping[str, Factory] | None = None,
        approach: bool = False,
    ) -> None:
        """Args:
          scenario: the scenario.
          blocks: factories in place of its blocks.
          approach: use its approach, the servicer alone before the grasp, in place of the motion
            from the grasp on.

        Raises the errors of ``add_closed_loop``; NotLinear for a block with continuous or abstract
        state.
        """
        # with limits
        self.given = timed(_up_to_grasp(scenario) if approach else from_grasp(scenario))
        self.scenario = without_limits(self.given)
        factories = dict(blocks or {})
        if is_rehearsed(self.given):
            factories = {"actuation": make_mean_actuation, **factories}
        for name, part in parts_of(self.scenario, factories).items():
            factories[name] = part.linear()
        self._choices = self.given.blocks.choices()
        self.loop = make_closed_loop(self.scenario, blocks=factories)
        settle_faults(self.given, self.loop.coordinates)  # the loop has none; names are checked
        self.motion = make_motion(self.scenario, self.loop.coordinates)
        self.begin, self.end = self.motion.begin, self.motion.end  # s
        if approach:  # its last instant is before the grasp
            self.end = max(0.0, self.end - WARM_UP * self.scenario.sample_time)
        self._simulator = self._new_simulator()
        self._context = self._simulator.get_mutable_context()
        self._plant = PlantState(self.loop, self._context)
        leaves = list(_leaves(self.loop.diagram))
        self._initialize(leaves)
        self._start = self._context.Clone()
        self._find_law()
        self._find_memory(leaves)
        self._updates = dict[Hashable, tuple[_Update, ...]]()
        # held memory -> control sample -> context after a warm-up
        self._warm = dict[Hashable, dict[int, Context]]()
        # held memory, and first control sample of a warm-up -> sample at which it has diverged
        self._lost = dict[Hashable, int]()
        self._motions = dict[Hashable, np.ndarray]()
        self._loops = dict[Hashable, LinearLoop]()
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
        self._check_cost()
        groups: Mapping[str, int] = getattr(controller, "memory_groups", dict)()
        self._parts_of_memory = {
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        untie(self.loop.diagram)  # which Drake would otherwise keep

    def at(
        self,
        time: float,
        *,
        held: Mapping[str, np.ndarray] | None = None,
        truth: MassProperties | None = None,
    ) -> LinearLoop:
        """The loop near an instant of the planned motion, with the plant on it.

        The result is cached: the same arguments give the same object. The update at the sample is
        cached too: the same instant with another true payload costs only its motion, from the state
        of the scenario's own payload. At rest this changes a spectral radius by about 1e-5.

        Args:
          time: s; a control sample is taken.
          held: values of held memory (``ControlLaw.held``) by name, in place of its own.
          truth: true mass properties of the payload, in place of the scenario's.

        Raises NotLinear: a block fails, or changes between two control samples.
        """
        first = round(time / self.scenario.sample_time)
        if truth is not None:
            return self._linearized(first, held or {}, truth)
        key = content_of((first, held or {}))
        if key not in self._loops:
            self._loops[key] = self._linearized(first, held or {}, None)
        return self._loops[key]

    def _linearized(
        self, first: int, held: Mapping[str, np.ndarray], truth: MassProperties | None
    ) -> LinearLoop:
        """The loop after a warm-up that begins on the plan at a control sample."""
        try:
            with guarded, np.errstate(over="ignore", invalid="ignore"):
                updates = self._updates_from(first, held)
                maps = {update: self._map(update, truth) for update in dict.fromkeys(updates)}
                samples = tuple(maps[update] for update in updates)
        except FfsmError as error:
            # a user-supplied block may fail because the loop has diverged
            if not isinstance(error, BlockError) or not self._has_diverged(self._plant):
                raise
            samples = self._unknown()
        except (Exception, SystemExit) as error:
            # Drake refuses some numbers that are not finite by SystemExit
            if not self._has_diverged(self._plant):
                reason = f"{type(error).__name__}: {one_line(error)}"
                named = [f"blocks.{name} '{each.system}'" for name, each in self._choices.items()]
                suspects = " or ".join([*named, self.scenario.controller])
                raise NotLinear(f"{suspects}: the loop cannot be linearised: {reason}") from error
            samples = self._unknown()
        return LinearLoop(
            coordinates=self.loop.coordinates,
            time=(first + WARM_UP) * self.scenario.sample_time,
            sample_time=self.scenario.sample_time,
            samples=samples,
            hidden=self.loop.split.names,
            tracks_frame=self.loop.tracks_frame,
            memory=self._parts_of_memory,
            noise={
                source.get_name(): part
                for source, part in zip(self._noise.systems, self._noise.parts, strict=True)
            },
        )

    def _has_diverged(self, plant: PlantState) -> bool:
        """Whether the plant moves as no motion does, or its state is none: numbers that overflow in
        a user-supplied block may still be finite here.
        """
        velocity = plant.known()[len(self.loop.coordinates.position_names) :]
        return not np.abs(velocity).max() <= self.scenario.divergence_speed  # true for NaN too

    def refuse_marginal(self, loop: LinearLoop) -> None:
        """Raise NotLinear where small errors near a loop of this linearizer, at rest, neither grow
        nor decay, and a user-supplied system may be the cause.
        """
        if not (self.user_supplied and loop.is_marginal):
            return
        systems = ", ".join(system.get_name() for system in self.user_supplied)
        if names := loop.kept_memory:
            held = ", ".join(f'"{name}": None' for name in names)
            raise NotLinear(
                f"{systems}: its state {', '.join(names)} is constant at rest, like an adapted "
                f"gain or estimate; return {{{held}}} from held() to hold it in the analysis"
            )
        raise NotLinear(
            f"{systems}: errors neither grow nor decay at rest, as if the block acted at few "
            "samples; declare its period"
        )

    def _unknown(self) -> tuple[SampleMap, ...]:
        """The map of a loop that diverged within the warm-up."""
        states = self._width + self._memory.size
        forces, noises = len(self.loop.coordinates.names), self._noise.size
        shapes = {"a": (states, states), "b": (states, noises)}
        shapes |= {"c": (forces, states), "d": (forces, noises)}
        return (SampleMap(**{name: np.full(shape, np.nan) for name, shape in shapes.items()}),)

    def along(
        self,
        shares: Sequence[float] = POSTURES,
        *,
        held: Mapping[str, np.ndarray] | None = None,
    ) -> tuple[LinearLoop, ...]:
        """The loops at fractions of the planned motion. Arguments and errors: see ``at``."""
        return tuple(self.at(self.part(share), held=held) for share in shares)

    def part(self, share: float) -> float:
        """The time at which a fraction (0 to 1) of the motion has passed, s."""
        return self.begin + share * (self.end - self.begin)

    def follow(
        self, *, held: Mapping[str, np.ndarray] | None = None, samples: int | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The run without noise: true error at the samples and force from each to the next (n, nv),
        NaN after a failure or divergence, as in a run.

        Args:
          held: see ``at``.
          samples: number from the start; None: all.
        """
        count = self.scenario.num_control_periods if samples is None else samples
        nv, period = len(self.loop.coordinates.names), self.scenario.sample_time
        states, force = np.full((count, nv + 1), np.nan), np.full((count, nv), np.nan)
        desired = self.motion.rows(np.arange(count) * period)[:, : nv + 1]
        context = self._start.Clone()
        silent = _silence(self._noise.systems, self.loop.diagram, context)
        if silent:  # step as in a run, for speed
            simulator = self._new_simulator(context)
            context = simulator.get_mutable_context()
            simulator.Initialize()
        else:
            context = self._context
            context.SetTimeStateAndParametersFrom(self._start)
        plant = PlantState(self.loop, context)
        controller = self.loop.blocks["controller"]
        controller_context = controller.GetMyMutableContextFromRoot(context)
        if isinstance(controller, SampledController):  # no sample counts as a first one here
            controller.remember_velocity(controller_context, self.motion.evaluate(0.0)[1])
        with self._until_divergence(plant), guarded, np.errstate(over="ignore", invalid="ignore"):
            for index in range(count):
                states[index], velocity = np.split(plant.known(), [nv + 1])
                if not np.abs(velocity).max() <= self.scenario.divergence_speed:
                    states[index] = np.nan
                    break
                self._hold(controller_context, held or {})
                if silent:
                    simulator.AdvanceTo((index + 1) * period)
                else:
                    self._noise.write(np.zeros(self._noise.size))
                    self._memory.update(index)
                    self._move(index)
                force[index] = self._force.Eval(controller_context)
        return position_errors(desired, states), force

    @contextlib.contextmanager
    def _until_divergence(self, plant: PlantState) -> Iterator[None]:
        """End the block when the loop has diverged. Raises BlockError: a user-supplied block fails
        before that.
        """
        try:
            yield
        except BlockError:
            if not self._has_diverged(plant):
                raise
        except (Exception, SystemExit):
            pass

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

    def _updates_from(self, first: int, held: Mapping[str, np.ndarray]) -> tuple["_Update", ...]:
        """The updates of one common period after a warm-up that begins on the plan at a control
        sample.
        """
        key = content_of((first, held))
        if key not in self._updates:
            index = first + WARM_UP
            before, updates = self._warmed_up(index, held), dict[Hashable, _Update]()
            self._context.SetTimeStateAndParametersFrom(before)
            own = self._find_own_period(index, held)
            indices = range(index, index + math.lcm(self._memory.common_period, own))
            kinds = [(self._memory.kind(each), each % own) for each in indices]
            for each, kind in zip(indices, kinds, strict=True):
                if kind not in updates:
                    self._context.SetTimeStateAndParametersFrom(before)
                    for earlier in range(index, index + (each - index) % own):
                        self._go_on(earlier, held)
                    self._context.SetTime(each * self.scenario.sample_time)
                    updates[kind] = self._update(each, first)
            self._updates[key] = tuple(updates[kind] for kind in kinds)
        return self._updates[key]

    def _warmed_up(self, index: int, held: Mapping[str, np.ndarray]) -> Context:
        """A context just before the update at a control sample, after the shortest warm-up with
        the plant on the plan at its end, or the longest without leading it away.

        A warm-up begins on the plan or, if a former one ended there on the way, goes on from it.
        One from where the motion begins comes last: at rest the first samples do little harm.
        """
        start, count, least = round(self.begin / self.scenario.sample_time), WARM_UP, math.inf
        former, found = self._warm.setdefault(content_of(held), {}), self._start
        while True:
            first = max(min(start, index - WARM_UP), index - count)
            known = max((each for each in former if first <= each < index), default=None)
            is_short = count == WARM_UP
            if known is None or is_short:
                self._context.SetTimeStateAndParametersFrom(self._start)
                self._context.SetTime(first * self.scenario.sample_time)
                planned = self.motion.evaluate(first * self.scenario.sample_time)[:2]
                self.loop.set_state(self._context, np.concatenate(planned))
                self._quiet(held)
            else:
                self._context.SetTimeStateAndParametersFrom(former[known])
                first = start = known
            way = content_of((held, first))
            if not is_short and index >= self._lost.get(way, index + 1):
                if first <= start:
                    return found
                count = index - start
                continue
            with contextlib.nullcontext() if is_short else self._until_divergence(self._plant):
                for earlier in range(first, index):
                    before = self._off_plan(earlier)
                    self._go_on(earlier, held)
            off = np.abs(self._off_plan(index) - before) / self.scenario.sample_time
            largest = float(off[self.loop.coordinates.is_driven].max(initial=0.0))
            diverged = self._has_diverged(self._plant)
            if diverged:
                self._lost[way] = index
            stays = largest <= _FARTHER * least and not diverged
            if stays or is_short:
                found, least = self._context.Clone(), min(least, largest)
            if stays and (largest <= _OFF or self.loop.tracks_frame):
                former[index] = found
                return found
            if first <= start or self.loop.tracks_frame:
                return found
            count = count * _LONGER if stays else index - start

    def _off_plan(self, index: int) -> np.ndarray:
        """The velocity beside the plan's at a control sample (nv)."""
        v_d = self.motion.evaluate(index * self.scenario.sample_time)[1]
        velocity: np.ndarray = self._plant.known()[-len(v_d) :] - v_d
        return velocity

    def _go_on(self, index: int, held: Mapping[str, np.ndarray]) -> None:
        """Advance from just before the update at a control sample to just before the next one."""
        self._memory.update(index)
        self._move(index)
        self._quiet(held)

    @functools.cached_property
    def planned(self) -> PlannedDynamics:
        """The scenario's dynamics along its planned motion. Raises the errors of
        PlannedDynamics.
        """
        return PlannedDynamics(self.given)

    @functools.cached_property
    def lightest(self) -> list[float]:
        """The times, s, of its motion at which a driven coordinate is lightest."""
        return self.planned.lightest(self.begin, self.end)

    @functools.cached_property
    def user_supplied(self) -> list[System]:
        """The user-supplied systems with memory, and the controller with a user-supplied law."""
        controller = self.loop.blocks["controller"]
        return [
            system
            for system in self._memory.systems
            if not _is_shipped(self.law if system is controller and self.law else system)
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
            self._go_on(each, held)
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
        """The controller's update at a control sample for many states at once, of a shipped law."""
        controller = self.loop.blocks["controller"]
        if not isinstance(controller, SampledController) or not _is_shipped(controller.law):
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
    controller's inputs; then the control law, for many states at once for speed.
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
        inputs, own = (
            {name: read[:, slot] for name, slot in slots.items()}
            for slots in (self._inputs, self._own)
        )
        force, after = self._controller.step(inputs, own)
        for name, part in self._parts.items():
            values = {"generalized_force": force, **after}[name]
            found[:, part] = values[0] + (values - values[0]) / larger if least else values
        return found


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


def _up_to_grasp(scenario: Scenario) -> Scenario:
    """The scenario up to its grasp."""
    return dataclasses.replace(scenario, holds=False, duration=scenario.grasp_time)


def _is_shipped(system: object) -> bool:
    """Whether the class of a system or a law, and of the steps that a law consists of, is Drake's
    or this package's.
    """
    parts = vars(system).values() if dataclasses.is_dataclass(system) else ()
    return type(system).__module__.split(".")[0] in ("pydrake", "ffsm_drake") and all(
        _is_shipped(part) for part in parts if hasattr(part, "step")
    )


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
